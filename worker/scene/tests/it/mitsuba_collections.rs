//! Features of Mitsuba files that public scene collections and Blender's exporter use.

use std::{io::Write, path::Path};

use flate2::{Compression, write::ZlibEncoder};
use picofarm_scene::{
    Bsdf, Scene, SceneError, Vec3,
    import::{Bounds, fingerprint, read_scene},
};

const SENSOR: &str = "<sensor type=\"perspective\"><float name=\"fov\" value=\"90\"/><film type=\"hdrfilm\">\
                      <integer name=\"width\" value=\"64\"/><integer name=\"height\" value=\"32\"/></film></sensor>";

fn scene(inner: &str) -> String {
    format!("<scene version=\"3.0.0\">{inner}</scene>")
}

/// Writes `files` into a folder and reads the first.
fn read(files: &[(&str, &[u8])]) -> Result<Scene, SceneError> {
    let folder = tempfile::tempdir().expect("a folder");
    write(folder.path(), files);
    read_scene(&folder.path().join(files[0].0))
}

fn write(folder: &Path, files: &[(&str, &[u8])]) {
    for (name, bytes) in files {
        let path = folder.join(name);
        std::fs::create_dir_all(path.parent().expect("a folder")).expect("a folder");
        std::fs::write(path, bytes).expect("writes");
    }
}

fn read_text(inner: &str) -> Scene {
    read(&[("a.xml", scene(inner).as_bytes())]).expect("reads")
}

/// Returns the world-space bounds of an object.
fn bounds(scene: &Scene, object: usize) -> [Vec3; 2] {
    let o = &scene.objects[object];
    let all = o.mesh.positions.iter().map(|p| o.to_world.point(*p));
    let mut all = all.collect::<Vec<_>>().into_iter();
    let first = all.next().expect("a vertex");
    let (lo, hi) = all.fold((first, first), |(lo, hi), p| (lo.min(p), hi.max(p)));
    [lo, hi]
}

fn near(a: Vec3, b: [f32; 3]) -> bool {
    (a - Vec3::from(b)).length() < 1e-4
}

#[test]
fn included_files_stand_in_the_place_of_the_element() {
    let main = scene(&format!(
        "<default name=\"size\" value=\"2\"/><path value=\"data\"/><include filename=\"parts/inner.xml\"/>{SENSOR}\
         <shape type=\"cube\" id=\"box.1\"><ref id=\"paint\"/></shape>"
    ));
    let inner = scene(
        "<bsdf type=\"diffuse\" id=\"red\"><rgb name=\"reflectance\" value=\"0.6, 0.3, 0\"/></bsdf>\
         <alias id=\"red\" as=\"paint\"/><shape type=\"ply\" id=\"mesh.1\"><string name=\"filename\" value=\"m.ply\"/>\
         <transform name=\"to_world\"><scale value=\"$size\"/></transform></shape>",
    );
    let ply = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n\
               element face 1\nproperty list uchar int vertex_index\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n";
    let files: [(&str, &[u8]); 3] = [
        ("a.xml", main.as_bytes()),
        ("parts/inner.xml", inner.as_bytes()),
        ("data/m.ply", ply.as_bytes()),
    ];
    let read = read(&files).expect("reads");
    assert_eq!(read.labels, ["mesh", "box"]);
    assert!(near(bounds(&read, 0)[1], [2.0, 2.0, 0.0]));
    assert_eq!(read.objects[1].mesh.materials[0].rgb, [0.6, 0.3, 0.0]);
    // A change of an included file changes the fingerprint.
    let folder = tempfile::tempdir().expect("a folder");
    let hash = |files: &[(&str, &[u8])]| {
        write(folder.path(), files);
        fingerprint(&folder.path().join("a.xml"), &Bounds::default()).expect("hashes")
    };
    let before = hash(&files);
    let other = inner.replace("0.6", "0.5");
    let after = hash(&[files[0], ("parts/inner.xml", other.as_bytes()), files[2]]);
    assert_ne!(before, after);
    let moved = ply.replace("0 1 0", "0 2 0");
    assert_ne!(after, hash(&[("data/m.ply", moved.as_bytes())]));
}

#[test]
fn a_file_that_includes_itself_is_refused() {
    let text = scene("<include filename=\"a.xml\"/>");
    let error = read(&[("a.xml", text.as_bytes())])
        .expect_err("a circle")
        .to_string();
    assert!(error.contains("includes itself"), "{error}");
    let outside = scene("<include filename=\"../b.xml\"/>");
    let error = read(&[
        ("in/a.xml", outside.as_bytes()),
        ("b.xml", b"<scene version=\"3.0.0\"/>"),
    ])
    .expect_err("outside")
    .to_string();
    assert!(error.contains("outside"), "{error}");
}

#[test]
fn instances_share_the_mesh_of_their_group() {
    let scene = read_text(&format!(
        "{SENSOR}<shape type=\"shapegroup\" id=\"group\"><shape type=\"cube\" id=\"box.0\">\
         <transform name=\"to_world\"><scale value=\"0.5\"/></transform></shape>\
         <shape type=\"rectangle\" id=\"plate.0\"/></shape>\
         <shape type=\"instance\"><ref id=\"group\"/></shape>\
         <shape type=\"instance\"><ref id=\"group\"/><transform name=\"to_world\"><translate x=\"3\"/></transform></shape>"
    ));
    assert_eq!(scene.objects.len(), 4);
    assert!(std::sync::Arc::ptr_eq(
        &scene.objects[0].mesh,
        &scene.objects[2].mesh
    ));
    assert!(near(bounds(&scene, 0)[1], [0.5, 0.5, 0.5]));
    assert!(near(bounds(&scene, 2)[1], [3.5, 0.5, 0.5]));
    assert!(near(bounds(&scene, 3)[0], [2.0, -1.0, 0.0]));
}

#[test]
fn cylinders_reach_from_end_to_end() {
    let scene = read_text(&format!(
        "{SENSOR}<shape type=\"cylinder\"><point name=\"p0\" value=\"1, 2, 3\"/><point name=\"p1\" value=\"1, 5, 3\"/>\
         <float name=\"radius\" value=\"0.5\"/></shape>"
    ));
    let [lo, hi] = bounds(&scene, 0);
    assert!((lo.y - 2.0).abs() < 1e-5 && (hi.y - 5.0).abs() < 1e-5);
    assert!((hi.x - lo.x - 1.0).abs() < 2e-3 && (hi.z - lo.z - 1.0).abs() < 2e-3);
    // Facets face outwards.
    let o = &scene.objects[0];
    for t in &o.mesh.triangles {
        let [a, b, c] = t.map(|v| o.to_world.point(o.mesh.positions[v as usize]));
        let out = (a + b + c) * (1.0 / 3.0) - Vec3::new(1.0, 3.5, 3.0);
        let flat = Vec3::new(out.x, 0.0, out.z);
        assert!((b - a).cross(c - a).dot(flat) > 0.0);
    }
}

/// Returns a serialized file of two triangles, in version 3 or 4.
fn serialized(version: u16) -> Vec<u8> {
    let mut file = Vec::new();
    let mut starts = Vec::new();
    for shift in [0.0f32, 10.0] {
        starts.push(file.len());
        let mut body = Vec::new();
        body.extend((0x1000u32 | 0x0001 | 0x0002).to_le_bytes());
        if version == 4 {
            body.extend(b"name\0");
        }
        body.extend(3u64.to_le_bytes());
        body.extend(1u64.to_le_bytes());
        for p in [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0f32]] {
            p.iter()
                .for_each(|x| body.extend((x + shift).to_le_bytes()));
        }
        for _ in 0..3 {
            [0.0, 0.0, 1.0f32]
                .iter()
                .for_each(|x| body.extend(x.to_le_bytes()));
        }
        for _ in 0..6 {
            body.extend(0.25f32.to_le_bytes());
        }
        [0u32, 1, 2]
            .iter()
            .for_each(|v| body.extend(v.to_le_bytes()));
        file.extend(0x041cu16.to_le_bytes());
        file.extend(version.to_le_bytes());
        let mut zlib = ZlibEncoder::new(&mut file, Compression::default());
        zlib.write_all(&body).expect("compresses");
        zlib.finish().expect("compresses");
    }
    for start in starts {
        match version {
            4 => file.extend((start as u64).to_le_bytes()),
            _ => file.extend((start as u32).to_le_bytes()),
        }
    }
    file.extend(2u32.to_le_bytes());
    file
}

#[test]
fn serialized_meshes_are_read_by_their_index_and_damage_is_named() {
    let text = |index: u32| {
        scene(&format!(
            "{SENSOR}<shape type=\"serialized\"><string name=\"filename\" value=\"m.serialized\"/>\
             <integer name=\"shape_index\" value=\"{index}\"/></shape>"
        ))
    };
    for version in [3, 4] {
        let file = serialized(version);
        let of = |index: u32, file: &[u8]| {
            read(&[("a.xml", text(index).as_bytes()), ("m.serialized", file)])
        };
        for (index, lo) in [(0, 0.0), (1, 10.0)] {
            let scene = of(index, &file).expect("reads");
            assert!(near(bounds(&scene, 0)[0], [lo; 3]), "version {version}");
            assert_eq!(scene.objects[0].mesh.uv, [[0.25, 0.25]; 3]);
        }
        let error = of(2, &file).expect_err("no such mesh").to_string();
        assert!(error.contains("the file has 2 meshes"), "{error}");
        for end in [0, 3, 40, file.len() - 1] {
            assert!(of(0, &file[..end]).is_err(), "{end} bytes");
        }
        for k in 0..file.len() {
            let mut damaged = file.clone();
            damaged[k] ^= 0x55;
            // Damage is refused, or is in a part that is not used.
            let _ = of(0, &damaged);
        }
    }
}

#[test]
fn bsdfs_without_an_equal_are_approximated_with_a_note() {
    let of = |bsdf: &str| {
        let scene = read_text(&format!("{SENSOR}<shape type=\"cube\">{bsdf}</shape>"));
        let notes: Vec<String> = scene.provenance.notes.keys().cloned().collect();
        (scene.objects[0].mesh.materials[0].bsdf, notes)
    };
    let noted = |notes: &[String], key: &str| notes.iter().any(|n| n == &format!("import.{key}"));
    let (bsdf, notes) =
        of("<bsdf type=\"roughplastic\"><rgb name=\"diffuse_reflectance\" value=\"0.2\"/></bsdf>");
    assert_eq!(bsdf, Bsdf::Diffuse { reflectance: 0.2 });
    assert!(noted(&notes, "plastics"));
    let (bsdf, _) = of(
        "<bsdf type=\"principled\"><rgb name=\"base_color\" value=\"0.4\"/><float name=\"metallic\" value=\"0.25\"/>\
         <float name=\"roughness\" value=\"0.5\"/></bsdf>",
    );
    assert!(
        matches!(
            bsdf,
            Bsdf::Mixed {
                reflectance: 0.4,
                alpha: 0.25,
                weight: 0.25,
                ..
            }
        ),
        "{bsdf:?}"
    );
    let (bsdf, notes) = of(
        "<bsdf type=\"mask\"><float name=\"opacity\" value=\"0.3\"/><bsdf type=\"bumpmap\">\
                            <texture type=\"bitmap\"><string name=\"filename\" value=\"none.png\"/></texture>\
                            <bsdf type=\"diffuse\"/></bsdf></bsdf>",
    );
    assert_eq!(bsdf, Bsdf::Diffuse { reflectance: 0.5 });
    assert!(
        noted(&notes, "masks") && noted(&notes, "relief"),
        "{notes:?}"
    );
    // Copper by its complex index of refraction at 650, 550 and 450 nm.
    let (bsdf, notes) = of(
        "<bsdf type=\"conductor\"><rgb name=\"eta\" value=\"0.2, 0.92, 1.1\"/>\
                            <rgb name=\"k\" value=\"3.9, 2.45, 2.14\"/></bsdf>",
    );
    let Bsdf::RoughConductor { reflectance, .. } = bsdf else {
        panic!("{bsdf:?}")
    };
    assert!((reflectance - 0.70).abs() < 0.02, "{reflectance}");
    assert!(noted(&notes, "metals"));
    // Gold by spectra, whose values exceed 1.
    let (bsdf, _) = of(
        "<bsdf type=\"conductor\"><spectrum name=\"eta\" value=\"450:1.4, 550:0.4, 650:0.2\"/>\
                            <spectrum name=\"k\" value=\"450:1.9, 550:2.6, 650:3.7\"/></bsdf>",
    );
    let Bsdf::RoughConductor { reflectance, .. } = bsdf else {
        panic!("{bsdf:?}")
    };
    assert!((reflectance - 0.72).abs() < 0.03, "{reflectance}");
    let (bsdf, notes) = of(
        "<bsdf type=\"measured_polarized\"><string name=\"filename\" value=\"none.pbsdf\"/></bsdf>",
    );
    assert_eq!(bsdf, Bsdf::Diffuse { reflectance: 0.5 });
    assert!(noted(&notes, "bsdf.measured_polarized"));
    let (bsdf, notes) = of(
        "<bsdf type=\"diffuse\"><texture type=\"checkerboard\" name=\"reflectance\"><rgb name=\"color0\" value=\"0.1\"/>\
         <rgb name=\"color1\" value=\"0.5\"/></texture></bsdf>",
    );
    assert!(matches!(bsdf, Bsdf::Diffuse { reflectance } if (reflectance - 0.3).abs() < 1e-6));
    assert!(noted(&notes, "textures.checkerboard"));
}

#[test]
fn lenses_and_crop_windows_give_the_view_of_the_image() {
    let camera = |sensor: &str| {
        read_text(&format!("{sensor}<shape type=\"cube\"/>"))
            .camera
            .intrinsics
    };
    // 50 mm on a film of 36 mm by 24 mm: 46.8 degrees along the diagonal.
    let i = camera(
        "<sensor type=\"thinlens\"><string name=\"focal_length\" value=\"50mm\"/><float name=\"aperture_radius\" value=\"0.1\"/>\
         <film type=\"hdrfilm\"><integer name=\"width\" value=\"300\"/><integer name=\"height\" value=\"200\"/></film></sensor>",
    );
    let half = (300.0f32.hypot(200.0) * 0.5) / i.fx;
    assert!((half - 43.2666 * 0.5 / 50.0).abs() < 1e-4, "{half}");
    let whole = camera(SENSOR);
    let crop = camera(&SENSOR.replace(
        "</film>",
        "<integer name=\"crop_offset_x\" value=\"10\"/><integer name=\"crop_offset_y\" value=\"4\"/>\
         <integer name=\"crop_width\" value=\"20\"/><integer name=\"crop_height\" value=\"8\"/></film>",
    ));
    assert_eq!((crop.width, crop.height), (20, 8));
    assert_eq!(
        (crop.fx, crop.cx, crop.cy),
        (whole.fx, whole.cx - 10.0, whole.cy - 4.0)
    );
}

#[test]
fn media_and_their_references_are_left_out_with_a_note() {
    let scene = read_text(&format!(
        "{SENSOR}<medium type=\"homogeneous\" id=\"fog\"/><shape type=\"cube\"><ref name=\"interior\" id=\"fog\"/></shape>\
         <shape type=\"sphere\"><bsdf type=\"null\"/></shape><shape type=\"disk\"><bsdf type=\"polarizer\"/></shape>"
    ));
    assert_eq!(scene.objects.len(), 1);
    let notes = &scene.provenance.notes;
    for left_out in ["media", "null", "polarizers"] {
        assert!(
            notes.contains_key(&format!("import.{left_out}")),
            "{notes:?}"
        );
    }
}

#[test]
fn a_sensor_that_is_no_pinhole_leaves_the_choice_of_the_camera() {
    let scene = read_text("<sensor type=\"orthographic\"/><shape type=\"cube\"/>");
    let notes = &scene.provenance.notes;
    assert!(notes.contains_key("import.sensors.kind") && notes.contains_key("chosen.camera"));
}

#[test]
fn a_sensor_at_a_shape_is_ignored_with_a_note() {
    let scene = read_text(&format!(
        "{SENSOR}<shape type=\"rectangle\"><sensor type=\"irradiancemeter\"/></shape>"
    ));
    assert!(scene.provenance.notes.contains_key("import.sensors.shapes"));
}

#[test]
fn gates_of_older_transient_films_are_stated_as_options() {
    let gate = |film: &str| {
        let sensor = SENSOR.replace("</film>", &format!("{film}</film>"));
        let scene = read_text(&format!("{sensor}<shape type=\"cube\"/>"));
        scene
            .provenance
            .notes
            .get("import.gate")
            .cloned()
            .unwrap_or_default()
    };
    let of_bounds = gate(
        "<float name=\"min_bound\" value=\"2\"/><float name=\"max_bound\" value=\"12\"/>\
         <float name=\"bin_width\" value=\"0.5\"/><string name=\"decomposition\" value=\"transient\"/>",
    );
    assert!(
        of_bounds.contains("--bins 20 --bin-width-m 0.5 --gate-start-m 2"),
        "{of_bounds}"
    );
    let of_streak = gate(
        "<integer name=\"time\" value=\"400\"/><float name=\"exposure_time\" value=\"8\"/>\
         <float name=\"time_offset\" value=\"500\"/>",
    );
    assert!(
        of_streak.contains("--bins 400 --bin-width-m 8 --gate-start-m 500"),
        "{of_streak}"
    );
}
