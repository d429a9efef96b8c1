//! OBJ and STL files open as they are.

use std::path::Path;

use picofarm_scene::{
    Scene, SceneError, Vec3,
    import::{Bounds, fingerprint, read_scene},
};

/// Writes `files` into a folder and reads the first.
fn read(files: &[(&str, &[u8])]) -> Result<Scene, SceneError> {
    let folder = tempfile::tempdir().expect("a folder");
    for (name, bytes) in files {
        std::fs::write(folder.path().join(name), bytes).expect("writes");
    }
    read_scene(&folder.path().join(files[0].0))
}

const OBJ: &str = "mtllib paint.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nv 0 0 1\nvt 0 0\nvt 1 0\nvt 1 1\n\
                   usemtl red paint\nf 1/1 2/2 3/3\nusemtl other\nf 1 3 4\nf 1 2 5\n";
const MTL: &str = "newmtl red paint\nKd 1 0 0\n\nnewmtl other\nKd 0.5 0.5 0.5\n";

#[test]
fn an_obj_has_the_colours_of_its_material_file() {
    let scene = read(&[("a.obj", OBJ.as_bytes()), ("paint.mtl", MTL.as_bytes())]).expect("reads");
    let mesh = &scene.objects[0].mesh;
    assert_eq!(mesh.triangles.len(), 3);
    let colour = |k: usize| mesh.materials[mesh.triangle_material[k] as usize].rgb;
    assert!(colour(0)[0] > 0.8 && colour(0)[1] < 0.1, "{:?}", colour(0));
    assert!((colour(1)[0] - 0.2176).abs() < 1e-3 && colour(1) == colour(2));
    let notes = &scene.provenance.notes;
    assert!(notes.contains_key("chosen.camera") && notes.contains_key("chosen.unit"));
}

#[test]
fn an_obj_without_its_material_file_is_grey_with_a_note() {
    let scene = read(&[("a.obj", OBJ.as_bytes())]).expect("reads");
    assert!(scene.provenance.notes.contains_key("import.materials"));
    assert!(
        scene.objects[0]
            .mesh
            .materials
            .iter()
            .all(|m| m.rgb == [0.5; 3])
    );
}

#[test]
fn the_material_file_is_part_of_the_fingerprint() {
    let folder = tempfile::tempdir().expect("a folder");
    let hash = |files: &[(&str, &str)]| {
        for (name, text) in files {
            std::fs::write(folder.path().join(name), text).expect("writes");
        }
        let path: &Path = &folder.path().join("a.obj");
        fingerprint(path, &Bounds::default()).expect("hashes")
    };
    let before = hash(&[("a.obj", OBJ), ("paint.mtl", MTL)]);
    assert_ne!(before, hash(&[("paint.mtl", &MTL.replace("Kd 1", "Kd 0"))]));
}

const FACETS: [[[f32; 3]; 3]; 2] = [
    [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]],
    [[0.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
];

fn text() -> Vec<u8> {
    let mut out = String::from("solid part one\n");
    for facet in FACETS {
        out += "facet normal 0 0 1\n outer loop\n";
        for [x, y, z] in facet {
            out += &format!("  vertex {x} {y:e} {z}\n");
        }
        out += " endloop\nendfacet\n";
    }
    (out + "endsolid part one\n").into_bytes()
}

fn binary() -> Vec<u8> {
    // Some programs start binary files with `solid`.
    let mut out = b"solid but binary".to_vec();
    out.resize(80, 0);
    out.extend(2u32.to_le_bytes());
    for facet in FACETS {
        out.extend([0; 12]);
        facet
            .iter()
            .flatten()
            .for_each(|x| out.extend(x.to_le_bytes()));
        out.extend([0; 2]);
    }
    out
}

#[test]
fn both_forms_of_stl_give_the_same_mesh() {
    for bytes in [text(), binary()] {
        let scene = read(&[("part.stl", &bytes)]).expect("reads");
        let mesh = &scene.objects[0].mesh;
        assert_eq!(mesh.positions.len(), 4, "equal corners are one vertex");
        assert_eq!(mesh.triangles, [[0, 1, 2], [0, 2, 3]]);
        assert_eq!(mesh.positions[3], Vec3::new(0.0, 0.0, 1.0));
    }
}

#[test]
fn damaged_stl_is_refused_by_place() {
    let whole = text();
    for (from, to, expected) in [
        (
            "vertex 1",
            "vertex one",
            "line 5: vertex: expected three numbers",
        ),
        ("vertex 1", "vertex nan", "not finite"),
        ("outer loop", "inner loop", "line 3: is no statement of STL"),
    ] {
        let damaged = String::from_utf8(whole.clone())
            .expect("text")
            .replacen(from, to, 1);
        let error = read(&[("part.stl", damaged.as_bytes())])
            .expect_err(expected)
            .to_string();
        assert!(
            error.contains("part.stl") && error.contains(expected),
            "{error}"
        );
    }
    for end in [whole.len() / 2, 20] {
        assert!(read(&[("part.stl", &whole[..end])]).is_err());
    }
    let short = binary();
    assert!(read(&[("part.stl", &short[..short.len() - 1])]).is_err());
}

#[test]
fn a_file_that_git_lfs_has_not_fetched_is_named() {
    let pointer = "version https://git-lfs.github.com/spec/v1\noid sha256:2c6b\nsize 4285914\n";
    let scene = r#"<scene version="3.0.0"><shape type="obj"><string name="filename" value="a.obj"/></shape></scene>"#;
    let lone = [("a.obj", pointer.as_bytes())];
    let named = [("a.xml", scene.as_bytes()), ("a.obj", pointer.as_bytes())];
    for files in [&lone[..], &named[..]] {
        let error = read(files).expect_err("no mesh").to_string();
        let expected = "a.obj: is a pointer of Git LFS";
        assert!(error.contains(expected), "{error}");
    }
}

#[test]
fn an_empty_file_is_named() {
    for name in ["a.stl", "a.obj", "a.glb"] {
        let error = read(&[(name, b"")]).expect_err("no mesh").to_string();
        assert!(error.contains(&format!("{name}: is empty")), "{error}");
    }
}

#[test]
fn glass_in_a_material_file_is_noted() {
    let mtl = MTL.replace("Kd 1 0 0", "Kd 1 0 0\nd 0.25");
    let scene = read(&[("a.obj", OBJ.as_bytes()), ("paint.mtl", mtl.as_bytes())]).expect("reads");
    let note = &scene.provenance.notes["import.glass"];
    assert!(note.contains("thin glass"), "{note}");
}
