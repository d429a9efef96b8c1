//! Files as written by other programs and people: each is read correctly, or refused with a helpful
//! message.

use crate::common::gltf::{Gltf, QUAD};

use picofarm_scene::{
    Aim, Scene, SceneError, Vec3,
    import::{Bounds, ImportOptions, fingerprint, read_scene_with},
};
use serde_json::{Value as Json, json};

/// The expected result of reading a file.
pub(crate) enum Expected {
    /// The bounding box of the last object's triangles in world space, their area, and a required
    /// note (or empty).
    Read([f32; 3], [f32; 3], f32, &'static str),
    /// A part of the error.
    Refused(&'static str),
}
use Expected::{Read, Refused};

pub(crate) fn read(files: &[(&str, &[u8])]) -> Result<Scene, SceneError> {
    let folder = tempfile::tempdir().expect("a folder");
    for (name, bytes) in files {
        std::fs::write(folder.path().join(name), bytes).expect("writes");
    }
    let options = ImportOptions {
        laser: Aim::grid(4),
        ..ImportOptions::default()
    };
    let path = folder.path().join(files[0].0);
    let _ = fingerprint(&path, &Bounds::default());
    read_scene_with(&path, &options, &Bounds::default())
}

pub(crate) fn check(name: &str, result: Result<Scene, SceneError>, expected: &Expected) {
    match (result, expected) {
        (Ok(scene), Read(lo, hi, area, note)) => {
            let object = scene.objects.last().expect("an object");
            let at = |v: u32| object.to_world.point(object.mesh.positions[v as usize]);
            let all: Vec<[Vec3; 3]> = object.mesh.triangles.iter().map(|t| t.map(at)).collect();
            let mut corners = all.iter().flatten().copied();
            let first = corners.next().expect("a corner");
            let (low, high) = corners.fold((first, first), |(l, h), p| (l.min(p), h.max(p)));
            let near = |a: Vec3, b: &[f32; 3]| (a - Vec3::from(*b)).length() < 1e-4;
            assert!(near(low, lo) && near(high, hi), "{name}: {low:?} {high:?}");
            let sum: f32 = all
                .iter()
                .map(|[a, b, c]| 0.5 * (*b - *a).cross(*c - *a).length())
                .sum();
            assert!((sum - area).abs() < 1e-3 * area, "{name}: area {sum}");
            let notes = &scene.provenance.notes;
            let key = format!("import.{note}");
            assert!(
                note.is_empty() || notes.contains_key(&key),
                "{name}: {notes:?}"
            );
        }
        (Err(error), Refused(part)) => {
            let said = error.to_string();
            assert!(said.contains(part), "{name}: {said}");
            assert!(said.len() < 2000, "{name}: {} letters", said.len());
        }
        (Ok(_), Refused(part)) => panic!("{name}: read, expected {part:?}"),
        (Err(error), Read(..)) => panic!("{name}: {error}"),
    }
}

const HEAD: &str = "element vertex 6\nproperty double x\nproperty double y\nproperty double z\nelement face 1\n\
                    property list uchar int vertex_indices\nend_header\n";
const L_FACE: &str = "6 1 2 3 4 5 0\n";

fn ply(face: &str, shift: f64) -> String {
    let mut text = format!("ply\nformat ascii 1.0\n{HEAD}");
    for (x, y) in [(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)] {
        text += &format!(
            "{} {} 0\n",
            f64::from(x) * 0.1 + shift,
            f64::from(y) * 0.1 + shift
        );
    }
    text + face
}

#[test]
fn meshes_in_ply() {
    let l = |note| Read([0.0; 3], [0.2, 0.2, 0.0], 0.03, note);
    let star = {
        let mut text = String::from(
            "ply\nformat ascii 1.0\nelement vertex 8\nproperty float x\nproperty float y\nproperty float z\n\
             element face 1\nproperty list uchar int vertex_index\nend_header\n",
        );
        for k in 0..8 {
            let (s, c) = direction(k);
            let r = if k % 2 == 0 { 1.0 } else { 0.25 };
            text += &format!("{} {} 0\n", r * c, r * s);
        }
        text + "8 0 1 2 3 4 5 6 7\n"
    };
    let star_area = 8.0 * 0.5 * 0.25 * std::f32::consts::FRAC_PI_4.sin();
    let cases: Vec<(&str, String, Expected)> = vec![
        ("concave", ply(L_FACE, 0.0), l("")),
        ("from another corner", ply("6 4 5 0 1 2 3\n", 0.0), l("")),
        ("clockwise", ply("6 5 4 3 2 1 0\n", 0.0), l("")),
        (
            "star",
            star,
            Read([-1.0, -1.0, 0.0], [1.0, 1.0, 0.0], star_area, ""),
        ),
        (
            "carriage returns",
            ply(L_FACE, 0.0).replace('\n', "\r"),
            l(""),
        ),
        (
            "both line ends",
            ply(L_FACE, 0.0).replace('\n', "\r\n"),
            l(""),
        ),
        (
            "blank lines",
            ply(L_FACE, 0.0).replace("end_header\n", "end_header\n\n"),
            l(""),
        ),
        (
            "far away",
            ply(L_FACE, 4_649_776.0),
            Read([-0.1, -0.1, 0.0], [0.1, 0.1, 0.0], 0.03, "origin"),
        ),
        (
            "stray vertex",
            ply("5 1 2 3 5 0\n", 0.0).replace("0.1 0.2 0\n", "1000000 0 0\n"),
            Read([0.0; 3], [0.2, 0.2, 0.0], 0.025, "stray_vertices"),
        ),
        (
            "whole numbers with a point",
            ply("6.0 1 2 3 4 5 0.0\n", 0.0),
            l(""),
        ),
        (
            "fractional index",
            ply("3 0 1.7 2.9\n", 0.0),
            Refused("row 0: property vertex_indices: 1.7 is no whole"),
        ),
        (
            "fractional length",
            ply("2.5 0 1\n", 0.0),
            Refused("2.5 is no whole number"),
        ),
        (
            "negative length",
            ply("-3 0 1 2\n", 0.0),
            Refused("-3 is no whole number"),
        ),
        (
            "negative index",
            ply("3 0 -1 2\n", 0.0),
            Refused("index -1"),
        ),
        (
            "index too large",
            ply("3 0 1 6\n", 0.0),
            Refused("index 6 points past 6"),
        ),
        (
            "too few numbers",
            ply("6 1 2 3 4 5\n", 0.0),
            Refused("line ends before property vertex_indices"),
        ),
        (
            "too many numbers",
            ply("3 0 1 2 3\n", 0.0),
            Refused("1 numbers more"),
        ),
        (
            "too many rows",
            ply("3 0 1 2\n3 0 2 3\n", 0.0),
            Refused("more rows than its header"),
        ),
        ("too few rows", ply("", 0.0), Refused("do not fit")),
        (
            "a word",
            ply("3 0 one 2\n", 0.0),
            Refused("expected a number"),
        ),
        ("crossing edges", ply("4 0 2 1 5\n", 0.0), Refused("cross")),
        (
            "length of a fraction",
            ply(L_FACE, 0.0).replace("list uchar", "list float"),
            Refused("whole-number type"),
        ),
        (
            "property twice",
            ply(L_FACE, 0.0).replace("double y\n", "double x\n"),
            Refused("stated twice"),
        ),
        (
            "strips",
            ply(L_FACE, 0.0).replace("element face", "element tristrips"),
            Refused("element tristrips: is not supported"),
        ),
        (
            "no faces",
            ply("", 0.0).replace("element face 1\n", "element face 0\n"),
            Refused("no point cloud"),
        ),
    ];
    for (name, text, expected) in &cases {
        check(name, read(&[("a.ply", text.as_bytes())]), expected);
    }
}

fn direction(k: u32) -> (f32, f32) {
    (k as f32 * std::f32::consts::FRAC_PI_4).sin_cos()
}

const L_OBJ: &str = "v 0 0 0\nv 2 0 0\nv 2 1 0\nv 1 1 0\nv 1 2 0\nv 0 2 0\nf 2 3 4 5 6 1\n";

fn xml(version: &str, sensor: &str, shape: &str) -> String {
    format!(
        "<scene version=\"{version}\">\n<sensor type=\"perspective\"><float name=\"fov\" value=\"60\"/>{sensor}</sensor>\n\
         <shape type=\"rectangle\" id=\"wall\"/>\n{shape}\n</scene>"
    )
}

#[test]
fn scenes_in_mitsubas_xml() {
    let cube = |inner: &str| format!("<shape type=\"cube\">{inner}</shape>");
    let place = |name: &str| {
        cube(&format!(
            "<transform name=\"{name}\"><scale value=\"0.5\"/><translate z=\"-2\"/></transform>"
        ))
    };
    let box_read = |note| Read([-0.5, -0.5, -2.5], [0.5, 0.5, -1.5], 6.0, note);
    let unit = |note| Read([-1.0; 3], [1.0; 3], 24.0, note);
    let cube_with = |inner: &str| xml("3.0.0", "", &cube(inner));
    let film = |inner: &str| {
        let film = format!("<film type=\"transient_hdr_film\">{inner}</film>");
        xml("3.0.0", &film, &cube(""))
    };
    let cases: Vec<(&str, String, Expected)> = vec![
        (
            "as of today",
            xml("3.0.0", "", &place("to_world")),
            box_read(""),
        ),
        (
            "toWorld of 0.6",
            xml("0.6.0", "", &place("toWorld")),
            box_read(""),
        ),
        (
            "toWorld of 0.5",
            xml("0.5.0", "", &place("toWorld")),
            box_read(""),
        ),
        (
            "toWorld of today",
            xml("3.0.0", "", &place("toWorld")),
            Refused(
                "line 4, <shape type=\"cube\">: property \"toWorld\" (line 4, <transform>) is not used by shape \"cube\"; did you mean \"to_world\"?",
            ),
        ),
        (
            "to_wold",
            xml("0.6.0", "", &place("to_wold")),
            Refused("did you mean \"to_world\"?"),
        ),
        (
            "fovAxis of 0.5",
            xml(
                "0.5.0",
                "<string name=\"fovAxis\" value=\"y\"/>",
                &place("to_world"),
            ),
            box_read(""),
        ),
        (
            "fovAxis of today",
            xml(
                "3.0.0",
                "<string name=\"fovAxis\" value=\"y\"/>",
                &place("to_world"),
            ),
            Refused("did you mean \"fov_axis\"?"),
        ),
        (
            "intIOR of 0.6",
            xml(
                "0.6.0",
                "",
                &cube("<bsdf type=\"dielectric\"><float name=\"intIOR\" value=\"1.5\"/></bsdf>"),
            ),
            unit(""),
        ),
        (
            "flipNormals of 0.6",
            xml(
                "0.6.0",
                "",
                &cube("<boolean name=\"flipNormals\" value=\"true\"/>"),
            ),
            unit(""),
        ),
        (
            "lookAt of 0.6",
            xml(
                "0.6.0",
                "<transform name=\"toWorld\"><lookAt origin=\"0,0,4\" target=\"0,0,0\"/></transform>",
                &cube(""),
            ),
            unit(""),
        ),
        (
            "an attribute that is not known",
            cube_with("<transform name=\"to_world\"><translate X=\"1\"/></transform>"),
            Refused("the attribute \"X\" is not known"),
        ),
        (
            "a property twice",
            cube_with(
                "<boolean name=\"flip_normals\" value=\"true\"/><boolean name=\"flip_normals\" value=\"false\"/>",
            ),
            Refused("property \"flip_normals\" is stated twice"),
        ),
        (
            "an unknown property of a BSDF",
            cube_with("<bsdf type=\"diffuse\"><rgb name=\"reflectence\" value=\"1\"/></bsdf>"),
            Refused("did you mean \"reflectance\"?"),
        ),
        (
            "an unknown texture of a BSDF",
            cube_with("<bsdf type=\"diffuse\"><texture name=\"bump\" type=\"bitmap\"/></bsdf>"),
            Refused("property \"bump\" is not used by bsdf \"diffuse\""),
        ),
        (
            "a property of the scene",
            xml(
                "3.0.0",
                "",
                &(cube("") + "<float name=\"scale\" value=\"2\"/>"),
            ),
            Refused("property \"scale\""),
        ),
        (
            "two ids",
            xml(
                "3.0.0",
                "",
                "<shape type=\"cube\" id=\"a\"/><shape type=\"cube\" id=\"a\"/>",
            ),
            Refused("the id \"a\" is stated twice"),
        ),
        (
            "a sampler",
            xml("3.0.0", "<sampler type=\"independent\"/>", &cube("")),
            unit("skipped"),
        ),
        (
            "a medium",
            cube_with("<medium name=\"interior\" type=\"homogeneous\"/>"),
            unit("media"),
        ),
        (
            "a film's format",
            xml(
                "3.0.0",
                "<film type=\"hdrfilm\"><string name=\"pixel_format\" value=\"rgb\"/></film>",
                &cube(""),
            ),
            unit("ignored hdrfilm pixel_format"),
        ),
        (
            "a gate",
            film(
                "<integer name=\"temporal_bins\" value=\"400\"/><float name=\"bin_width_opl\" value=\"0.03\"/>",
            ),
            unit("gate"),
        ),
        ("mitransient's own gate", film(""), unit("gate")),
        (
            "a gate without bins",
            film("<integer name=\"temporal_bins\" value=\"0\"/>"),
            Refused("0 time bins"),
        ),
        (
            "an include",
            xml("3.0.0", "", "<include filename=\"b.xml\"/>"),
            Refused("<include>: cannot read"),
        ),
        (
            "a path",
            xml("3.0.0", "<path value=\"b\"/>", &cube("")),
            unit(""),
        ),
        (
            "a concave face",
            xml(
                "3.0.0",
                "",
                "<shape type=\"obj\"><string name=\"filename\" value=\"l.obj\"/></shape>",
            ),
            Read([0.0; 3], [2.0, 2.0, 0.0], 3.0, ""),
        ),
        (
            "far away",
            xml(
                "3.0.0",
                "<transform name=\"to_world\"><translate x=\"4649776.25\" y=\"500000\"/></transform>",
                "<shape type=\"cube\"><transform name=\"to_world\"><scale value=\"0.05\"/>\
                 <translate x=\"4649776.3\" y=\"500000.1\" z=\"2\"/></transform></shape>",
            ),
            Read([0.0, 0.05, 1.95], [0.1, 0.15, 2.05], 0.06, "origin"),
        ),
        (
            "a mesh far from its own origin",
            xml(
                "3.0.0",
                "",
                "<shape type=\"ply\"><string name=\"filename\" value=\"far.ply\"/><transform name=\"to_world\">\
                 <translate x=\"-4649776\" y=\"-4649776\"/></transform></shape>",
            ),
            Read([0.0; 3], [0.2, 0.2, 0.0], 0.03, ""),
        ),
        (
            "a long file name",
            xml(
                "3.0.0",
                "",
                &format!(
                    "<shape type=\"ply\"><string name=\"filename\" value=\"{}\"/></shape>",
                    "a/".repeat(30_000)
                ),
            ),
            Refused("longer than 4096 bytes"),
        ),
        (
            "a long plugin name",
            xml(
                "3.0.0",
                "",
                &format!("<shape type=\"{}\"/>", "x".repeat(1 << 20)),
            ),
            Refused("is not supported"),
        ),
    ];
    let far = ply(L_FACE, 4_649_776.0);
    for (name, text, expected) in &cases {
        let files = [
            ("a.xml", text.as_bytes()),
            ("l.obj", L_OBJ.as_bytes()),
            ("far.ply", far.as_bytes()),
        ];
        check(name, read(&files), expected);
    }
}

#[test]
fn a_scene_without_a_laser_gets_spots_over_the_view_of_its_camera() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("a.xml");
    std::fs::write(&path, xml("3.0.0", "", "")).expect("writes");
    let mut file = Gltf::new();
    file.json["nodes"][1]
        .as_object_mut()
        .expect("a node")
        .remove("extras");
    let gltf = folder.path().join("a.gltf");
    std::fs::write(&gltf, file.bytes()).expect("writes");
    for path in [path, gltf] {
        let read = |options| read_scene_with(&path, &options, &Bounds::default()).expect("reads");
        let scene = read(ImportOptions::default());
        assert_eq!(scene.laser.beams.len(), 25);
        assert_eq!(scene.laser.origin, scene.camera.origin);
        let note = &scene.provenance.notes["chosen.laser"];
        assert!(note.contains("--spots"), "{note}");
        let scene = read(ImportOptions {
            spots_if_none: Aim::grid(4),
            ..ImportOptions::default()
        });
        assert_eq!(scene.laser.beams.len(), 4);
        assert!(!scene.provenance.notes.contains_key("chosen.laser"));
    }
}

/// Returns a PNG of 2×1 texels with these values of alpha.
fn png(alpha: [u8; 2]) -> Vec<u8> {
    let image =
        image::RgbaImage::from_fn(2, 1, |x, _| image::Rgba([200, 200, 200, alpha[x as usize]]));
    let mut bytes = std::io::Cursor::new(Vec::new());
    image
        .write_to(&mut bytes, image::ImageFormat::Png)
        .expect("writes");
    bytes.into_inner()
}

type Edit = Box<dyn Fn(&mut Gltf)>;

#[test]
fn scenes_in_gltf() {
    let at = |z: f32, note| Read([-0.5, -0.5, z], [0.5, 0.5, z], 1.0, note);
    let quad = |note| at(-2.0, note);
    let extras =
        |value: Json| -> Edit { Box::new(move |f| f.json["nodes"][2]["extras"] = value.clone()) };
    let skinned = |weight: f32| -> Edit {
        Box::new(move |f| {
            // A joint one metre further back, for a mesh of a hundredth of its size.
            let small: Vec<f32> = QUAD.iter().map(|x| x * 100.0).collect();
            let places = f.floats(&small, "VEC3");
            f.json["accessors"][places]["min"] = json!([-50, -50, 0]);
            f.json["accessors"][places]["max"] = json!([50, 50, 0]);
            let joints = f.accessor(&[0; 16], 5121, "VEC4", 4);
            let weights = f.floats(&[weight, 0.0, 0.0, 0.0].repeat(4), "VEC4");
            let mut matrix = [0.0f32; 16];
            (matrix[0], matrix[5], matrix[10], matrix[15]) = (0.01, 0.01, 0.01, 1.0);
            let inverse = f.floats(&matrix, "MAT4");
            f.primitive()["attributes"] =
                json!({"POSITION": places, "JOINTS_0": joints, "WEIGHTS_0": weights});
            f.json["skins"] = json!([{"joints": [3], "inverseBindMatrices": inverse}]);
            f.json["nodes"][2]["skin"] = json!(0);
            f.json["nodes"]
                .as_array_mut()
                .expect("a list")
                .push(json!({"translation": [0, 0, -2.5]}));
            f.json["scenes"][0]["nodes"] = json!([0, 1, 2, 3]);
        })
    };
    let morphed = |weights: Json, on_node: bool| -> Edit {
        Box::new(move |f| {
            let shift = f.floats(&[0.0, 0.0, 0.5].repeat(4), "VEC3");
            f.json["accessors"][shift]["min"] = json!([0, 0, 0.5]);
            f.json["accessors"][shift]["max"] = json!([0, 0, 0.5]);
            f.primitive()["targets"] = json!([{"POSITION": shift}]);
            let owner = if on_node {
                &mut f.json["nodes"][2]
            } else {
                &mut f.json["meshes"][1]
            };
            owner["weights"] = weights.clone();
        })
    };
    let instanced: Edit = Box::new(|f| {
        let moved = f.floats(&[0.0, 0.0, -0.25, 1.0, 0.0, 0.0], "VEC3");
        let scaled = f.floats(&[1.0, 1.0, 1.0, 2.0, 2.0, 2.0], "VEC3");
        f.json["nodes"][2]["extensions"] = json!({"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": moved, "SCALE": scaled}}});
        f.json["extensionsUsed"] = json!(["EXT_mesh_gpu_instancing"]);
        f.json["extensionsRequired"] = json!(["EXT_mesh_gpu_instancing"]);
    });
    let mask = |alpha: [u8; 2]| -> Edit {
        Box::new(move |f| {
            f.textured(&png(alpha), "image/png");
            f.json["materials"][1]["alphaMode"] = json!("MASK");
        })
    };
    let colours = |second: f32| -> Edit {
        Box::new(move |f| {
            let mut all = [0.5; 12];
            all[3] = second;
            let colour = f.floats(&all, "VEC3");
            f.primitive()["attributes"]["COLOR_0"] = json!(colour);
        })
    };
    let sourceless = |extension: Option<&'static str>| -> Edit {
        Box::new(move |f| {
            f.textured(&png([255; 2]), "image/png");
            f.json["textures"] = match extension {
                None => json!([{}]),
                Some(name) => json!([{"extensions": {name: {"source": 0}}}]),
            };
        })
    };
    let cases: Vec<(&str, Edit, Expected)> = vec![
        ("plain", Box::new(|_| {}), quad("")),
        ("a skin", skinned(1.0), at(-2.5, "skins")),
        (
            "a skin whose weights do not sum to 1",
            skinned(0.5),
            at(-2.5, "skins"),
        ),
        (
            "a skin without weights",
            skinned(0.0),
            Refused("has no WEIGHTS_0"),
        ),
        (
            "weights of a mesh",
            morphed(json!([1.0]), false),
            at(-1.5, "morphs"),
        ),
        (
            "weights of a node",
            morphed(json!([0.5]), true),
            at(-1.75, "morphs"),
        ),
        (
            "weights of nothing",
            morphed(json!([0.0]), false),
            quad("morphs"),
        ),
        (
            "instances",
            instanced,
            Read([0.0, -1.0, -2.0], [2.0, 1.0, -2.0], 4.0, ""),
        ),
        (
            "instances without an accessor",
            Box::new(|f| {
                f.json["nodes"][2]["extensions"] =
                    json!({"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": 99}}});
            }),
            Refused("TRANSLATION: no such accessor"),
        ),
        (
            "hidden",
            Box::new(|f| {
                f.json["nodes"][2]["extensions"] =
                    json!({"KHR_node_visibility": {"visible": false}});
                f.json["extensionsUsed"] = json!(["KHR_node_visibility"]);
            }),
            at(-3.0, "hidden"),
        ),
        (
            "below a hidden node",
            Box::new(|f| {
                f.json["nodes"].as_array_mut().expect("a list").push(json!({
                    "children": [2], "extensions": {"KHR_node_visibility": {"visible": false}}
                }));
                f.json["scenes"][0]["nodes"] = json!([0, 1, 3]);
            }),
            at(-3.0, "hidden"),
        ),
        (
            "a mask with holes",
            mask([0, 255]),
            Read([0.0, -0.5, -2.0], [0.5, 0.5, -2.0], 0.5, "masks"),
        ),
        ("a mask without holes", mask([255, 200]), quad("")),
        (
            "a mask by its factor",
            Box::new(|f| {
                f.json["materials"][0]["alphaMode"] = json!("MASK");
                f.json["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"] =
                    json!([1, 1, 1, 0.2]);
            }),
            Refused("alpha masks cut away its whole surface"),
        ),
        ("one vertex colour", colours(0.5), quad("")),
        ("vertex colours", colours(0.9), quad("vertex_colours")),
        ("extras of text", extras(json!("text")), quad("")),
        ("extras of a list", extras(json!(["chair", 2])), quad("")),
        ("extras of a number", extras(json!(5)), quad("")),
        (
            "a label of a number",
            extras(json!({"label": 5})),
            quad("extras.label"),
        ),
        (
            "an instance of text",
            extras(json!({"instance": "chair-3"})),
            quad("extras.instance"),
        ),
        (
            "an instance below 0",
            extras(json!({"instance": -1})),
            quad("extras.instance"),
        ),
        (
            "a laser that is none",
            extras(json!({"laser_spots": "many"})),
            Refused("nodes[2].extras"),
        ),
        (
            "an orthographic camera first",
            Box::new(|f| {
                let cameras = f.json["cameras"].as_array_mut().expect("a list");
                cameras.push(json!({"type": "orthographic", "orthographic": {"xmag": 1, "ymag": 1, "zfar": 9, "znear": 1}}));
                f.json["nodes"][0]["camera"] = json!(1);
            }),
            quad("cameras"),
        ),
        (
            "orthographic cameras only",
            Box::new(|f| {
                f.json["cameras"] = json!([{"type": "orthographic", "orthographic": {"xmag": 1, "ymag": 1, "zfar": 9, "znear": 1}}]);
            }),
            quad("cameras"),
        ),
        (
            "another scene without nodes",
            Box::new(|f| {
                f.json["scenes"]
                    .as_array_mut()
                    .expect("a list")
                    .push(json!({"name": "empty"}))
            }),
            quad(""),
        ),
        (
            "animations of a later specification",
            Box::new(|f| {
                f.json["animations"] = json!([{"samplers": [{"input": 0, "output": 0}], "channels": [{"sampler": 0,
                    "target": {"path": "pointer", "extensions": {"KHR_animation_pointer": {"pointer": "/a"}}}}]}]);
            }),
            quad("animation"),
        ),
        (
            "a texture without a source",
            sourceless(None),
            quad("textures.source"),
        ),
        (
            "an image in another format alone",
            sourceless(Some("MSFT_texture_dds")),
            Refused("MSFT_texture_dds alone"),
        ),
        (
            "an unreadable texture of roughness",
            Box::new(|f| {
                f.textured(b"\xabKTX 20\xbb\r\n\x1a\n", "image/ktx2");
                let texture =
                    json!({"metallicFactor": 0, "metallicRoughnessTexture": {"index": 0}});
                f.json["materials"][1]["pbrMetallicRoughness"] = texture;
            }),
            quad("metallic_roughness_textures.unread"),
        ),
        (
            "an unreadable base colour",
            Box::new(|f| f.textured(b"\xabKTX 20\xbb\r\n\x1a\n", "image/ktx2")),
            Refused("is not readable"),
        ),
        (
            "an image without a place that nothing uses",
            Box::new(|f| f.json["images"] = json!([{"name": "gone"}])),
            quad(""),
        ),
        (
            "version 1",
            Box::new(|f| f.json = json!({"asset": {"version": "1.0"}, "meshes": {"a": {}}})),
            Refused("is glTF 1.0"),
        ),
        (
            "nothing but a point cloud",
            Box::new(|f| {
                f.primitive()["mode"] = json!(0);
                f.json["scenes"][0]["nodes"] = json!([1, 2]);
            }),
            Refused("point cloud"),
        ),
        (
            "nothing but lines",
            Box::new(|f| {
                f.primitive()["mode"] = json!(1);
                f.json["scenes"][0]["nodes"] = json!([1, 2]);
            }),
            Refused("has only lines"),
        ),
        (
            "nothing but hidden meshes",
            Box::new(|f| {
                f.json["nodes"][2]["extensions"] =
                    json!({"KHR_node_visibility": {"visible": false}});
                f.json["scenes"][0]["nodes"] = json!([1, 2]);
            }),
            Refused("not visible"),
        ),
        (
            "meshes outside the scene",
            Box::new(|f| f.json["scenes"][0]["nodes"] = json!([1])),
            Refused("no node of its scene has a mesh"),
        ),
        (
            "nodes without a scene",
            Box::new(|f| {
                let root = f.json.as_object_mut().expect("an object");
                root.remove("scenes");
                root.remove("scene");
            }),
            quad("scenes"),
        ),
        (
            "a scene that lists a child of its nodes",
            Box::new(|f| {
                f.json["nodes"][0]["children"] = json!([2]);
                f.json["nodes"][2]["translation"] = json!([0, 0, 1]);
            }),
            quad("scenes.nodes"),
        ),
        (
            "a scene below a node outside it",
            Box::new(|f| {
                let nodes = f.json["nodes"].as_array_mut().expect("a list");
                nodes.push(json!({"children": [2], "translation": [0, 0, 9]}));
            }),
            quad(""),
        ),
        (
            "a child of two nodes",
            Box::new(|f| {
                f.json["nodes"][0]["children"] = json!([2]);
                f.json["nodes"][1]["children"] = json!([2]);
            }),
            Refused("more than one parent"),
        ),
        (
            "a surface without positions",
            Box::new(|f| {
                let bare = json!({"attributes": {}, "material": 0});
                let primitives = f.json["meshes"][1]["primitives"].as_array_mut();
                primitives.expect("a list").push(bare);
            }),
            quad("primitives"),
        ),
        (
            "whole numbers with a point",
            Box::new(|f| {
                f.primitive()["mode"] = json!(4.0);
                f.json["scenes"][0]["nodes"] = json!([0.0, 1.0, 2.0]);
            }),
            quad(""),
        ),
        (
            "a required extension",
            Box::new(|f| f.json["extensionsRequired"] = json!(["EXT_unheard_of"])),
            Refused("extensionsRequired: \"EXT_unheard_of\" is not supported"),
        ),
        (
            "a sparse index past the places",
            Box::new(|f| {
                f.json["accessors"][0]["sparse"] = json!({"count": 1, "indices": {"bufferView": 0, "componentType": 5125},
                    "values": {"bufferView": 0}});
            }),
            Refused("points past 4 elements"),
        ),
        (
            "far away",
            Box::new(|f| {
                f.json["nodes"][1]["translation"] = json!([4649776.25, 0, 500_000.5]);
                f.json["nodes"][2]["translation"] = json!([4649776.3, 0.0, 499_998.5]);
            }),
            Read([-0.45, -0.5, -2.0], [0.55, 0.5, -2.0], 1.0, "origin"),
        ),
        (
            "a chain of nodes that goes far and comes back",
            Box::new(|f| {
                f.json["nodes"].as_array_mut().expect("a list").push(json!({
                    "children": [2], "translation": [4_649_776.125, 0, 0]
                }));
                f.json["nodes"][2]["translation"] = json!([-4_649_776.025, 0, -2]);
                f.json["scenes"][0]["nodes"] = json!([0, 1, 3]);
            }),
            Read([-0.4, -0.5, -2.0], [0.6, 0.5, -2.0], 1.0, ""),
        ),
        (
            "a long uri of an image",
            Box::new(|f| {
                f.textured(&png([255; 2]), "image/png");
                f.json["images"] = json!([{"uri": "a/".repeat(30_000)}]);
            }),
            Refused("longer than 4096 bytes"),
        ),
        (
            "a long name of an extension",
            Box::new(|f| f.json["extensionsRequired"] = json!(["x".repeat(1 << 20)])),
            Refused("is not supported"),
        ),
    ];
    for (name, edit, expected) in &cases {
        let mut file = Gltf::new();
        edit(&mut file);
        check(name, read(&[("a.gltf", &file.bytes())]), expected);
    }
}
