//! PLY: every encoding of the same mesh gives the same result; damage is reported by name.

use std::path::PathBuf;

use picofarm_scene::{
    Aim, Scene, SceneError, export,
    import::{Bounds, ImportOptions, read_scene_with},
    primitive::{self, PrimitiveSettings},
};

const HEADER: &str = "comment made by hand\nelement vertex 5\nproperty float x\nproperty double y\nproperty float z\n\
    property uchar red\nproperty uchar green\nproperty uchar blue\nproperty float s\nproperty float t\n\
    element face 3\nproperty uchar flags\nproperty list uchar int vertex_indices\n\
    element edge 1\nproperty list uint short ends\nend_header\n";
const VERTICES: [[f64; 3]; 5] = [
    [0., 0., 0.],
    [1., 0., 0.],
    [1., 1., 0.],
    [0.5, 1.5, 0.],
    [0., 1., 0.],
];

fn ascii() -> Vec<u8> {
    let mut text = format!("ply\nformat ascii 1.0\n{HEADER}");
    for [x, y, z] in VERTICES {
        text += &format!("{x} {y} {z} 255 188 0 {x} {y}\n");
    }
    (text + "7 5 0 1 2 3 4\n7 2 0 1\n7 3 0 1 2\n2 0 1\n").into_bytes()
}

fn binary(big: bool) -> Vec<u8> {
    let name = if big { "big" } else { "little" };
    let mut out = format!("ply\r\nformat binary_{name}_endian 1.0\n{HEADER}").into_bytes();
    let mut put = |bytes: &[u8]| {
        if big {
            out.extend(bytes.iter().rev());
        } else {
            out.extend(bytes);
        }
    };
    for [x, y, z] in VERTICES {
        put(&(x as f32).to_le_bytes());
        put(&y.to_le_bytes());
        put(&(z as f32).to_le_bytes());
        [255, 188, 0].iter().for_each(|&c: &u8| put(&[c]));
        put(&(x as f32).to_le_bytes());
        put(&(y as f32).to_le_bytes());
    }
    for face in [&[0, 1, 2, 3, 4][..], &[0, 1], &[0, 1, 2]] {
        put(&[7]);
        put(&[face.len() as u8]);
        face.iter().for_each(|v: &i32| put(&v.to_le_bytes()));
    }
    put(&2u32.to_le_bytes());
    put(&0i16.to_le_bytes());
    put(&1i16.to_le_bytes());
    out
}

fn read(name: &str, bytes: &[u8]) -> Result<Scene, SceneError> {
    let folder = tempfile::tempdir().expect("a folder");
    let path: PathBuf = folder.path().join(name);
    std::fs::write(&path, bytes).expect("writes");
    let options = ImportOptions {
        laser: Aim::grid(4),
        ..ImportOptions::default()
    };
    read_scene_with(&path, &options, &Bounds::default())
}

#[test]
fn every_encoding_gives_the_same_mesh() {
    for bytes in [ascii(), binary(false), binary(true)] {
        let scene = read("a.ply", &bytes).expect("reads");
        let mesh = &scene.objects[0].mesh;
        assert_eq!(mesh.triangles, [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 1, 2]]);
        assert_eq!(mesh.positions[3].y, 1.5);
        assert_eq!(mesh.uv[3], [0.5, 1.5]);
        let [r, g, b] = mesh.materials[0].rgb;
        assert!(r == 1.0 && (g - 0.503).abs() < 1e-3 && b == 0.0);
        let notes = &scene.provenance.notes;
        assert!(notes.contains_key("import.colours") && notes.contains_key("import.faces"));
        for p in &mesh.positions {
            let c = scene.camera.to_camera(*p);
            let i = scene.camera.intrinsics;
            let (x, y) = (c.x / c.z * i.fx + i.cx, c.y / c.z * i.fy + i.cy);
            assert!(c.z > 0.0 && (0.0..256.0).contains(&x) && (0.0..256.0).contains(&y));
        }
    }
}

#[test]
fn damage_is_refused_and_named() {
    let text = String::from_utf8(ascii()).expect("text");
    for (from, to, expected) in [
        ("vertex 5", "vertex 4000000000", "do not fit"),
        ("7 5 0 1 2 3 4", "7 5 0 1 2 3 9", "index 9 points past 5"),
        ("7 5 0 1 2 3 4", "7 5 0 1 -2 3 4", "index -2"),
        ("7 5 0 1 2 3 4", "7 250 0 1 2 3 4", "does not fit"),
        ("1 1 0 255", "1 nan 0 255", "vertex 2 is not finite"),
        ("1 1 0 255", "1 one 0 255", "row 2: expected a number"),
        ("double y", "quadruple y", "header line 6"),
        ("format ascii", "format morse", "header line 2"),
        ("end_header", "end", "header line"),
        ("vertex_indices", "corners", "no list vertex_indices"),
    ] {
        let error = read("bad.ply", text.replacen(from, to, 1).as_bytes())
            .expect_err(to)
            .to_string();
        assert!(
            error.contains("bad.ply") && error.contains(expected),
            "{error}"
        );
    }
    let whole = binary(false);
    for keep in [3, 20, whole.len() - 40, whole.len() - 1] {
        assert!(read("cut.ply", &whole[..keep]).is_err());
    }
}

#[test]
fn a_scene_written_as_ply_has_the_same_triangles() {
    let scene = primitive::generate(1, &PrimitiveSettings::default()).expect("generates");
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("room.ply");
    export::write_ply(&scene, &path).expect("writes");
    let back = read("room.ply", &std::fs::read(&path).expect("the file")).expect("reads");
    assert_eq!(back.triangle_count(), scene.triangle_count());
    let all = scene.objects.iter().flat_map(|o| {
        let place = |p: &picofarm_scene::Vec3| o.to_world.point(*p);
        o.mesh.positions.iter().map(place)
    });
    assert!(all.eq(back.objects[0].mesh.positions.iter().copied()));
}
