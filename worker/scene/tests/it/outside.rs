//! The files that a scene names are opened only within the allowed folders, and no error reveals
//! other files of the machine.

use std::{
    os::unix::fs::symlink,
    path::{Path, PathBuf},
};

use picofarm_scene::{
    Aim, SceneError,
    import::{Bounds, ImportOptions, fingerprint, read_scene_with},
};

const SECRET: &str = "root:x:0:0:hunter2";

struct Place {
    dir: tempfile::TempDir,
}

impl Place {
    /// Creates a folder `scenes` next to a file outside the allowed folders.
    fn new() -> Self {
        let dir = tempfile::tempdir().unwrap();
        let place = Self { dir };
        std::fs::create_dir(place.scenes()).unwrap();
        std::fs::write(place.secret(), format!("{SECRET}\nmore\n")).unwrap();
        symlink(place.secret(), place.scenes().join("link")).unwrap();
        symlink(place.dir.path(), place.scenes().join("up")).unwrap();
        place
    }

    fn scenes(&self) -> PathBuf {
        self.dir.path().join("scenes")
    }

    fn secret(&self) -> PathBuf {
        self.dir.path().join("secret")
    }

    fn scene(&self, name: &str, text: &str) -> PathBuf {
        let path = self.scenes().join(name);
        std::fs::write(&path, text).unwrap();
        path
    }

    /// Returns names of the secret, including those that would be valid on another system.
    fn tricks(&self) -> Vec<String> {
        let whole = self.secret().display().to_string();
        [
            "../secret",
            "link",
            "up/secret",
            "./up/../secret",
            "nothing/../../secret",
            "..\\secret",
            "\\\\server\\share\\secret",
            "../does-not-exist",
            "/etc/passwd",
        ]
        .map(str::to_owned)
        .into_iter()
        .chain([format!("file://{whole}"), format!("file:{whole}"), whole])
        .collect()
    }
}

fn options() -> ImportOptions {
    ImportOptions {
        laser: Aim::grid(1),
        ..ImportOptions::default()
    }
}

/// Checks that neither reading nor the fingerprint opens the named file, and that neither error
/// reveals its content.
fn refused(path: &Path, bounds: &Bounds, what: &str) {
    let read = read_scene_with(path, &options(), bounds).map(drop);
    let print = fingerprint(path, bounds).map(drop);
    for result in [read, print] {
        let said = result.expect_err(what).to_string();
        assert!(said.contains("is not opened"), "{what}: {said}");
        assert!(
            !said.contains("hunter2") && !said.contains("root:"),
            "{what}: {said}"
        );
    }
}

fn mitsuba(shape: &str, bsdf: &str) -> String {
    format!(
        r#"<scene version="3.0.0">
        <sensor type="perspective"><float name="fov" value="60"/></sensor>
        <shape type="{shape}">{bsdf}</shape></scene>"#
    )
}

fn filename(name: &str) -> String {
    format!(r#"<string name="filename" value="{name}"/>"#)
}

#[test]
fn mitsuba_names_no_file_outside_its_folder() {
    let place = Place::new();
    let bounds = Bounds::default();
    for name in place.tricks() {
        for shape in ["ply", "obj"] {
            let text = mitsuba(shape, &filename(&name));
            let path = place.scene("a.xml", &text);
            refused(&path, &bounds, &format!("{shape} {name}"));
            let text = format!(
                r#"{{"type": "scene", "s": {{"type": "perspective", "fov": 60}}, "m": {{"type": "{shape}", "filename": {name:?}}}}}"#
            );
            let path = place.scene("a.json", &text);
            refused(&path, &bounds, &format!("dictionary, {shape} {name}"));
        }
        let texture = format!(
            r#"<bsdf type="diffuse"><texture name="reflectance" type="bitmap">{}</texture></bsdf>"#,
            filename(&name)
        );
        let path = place.scene("a.xml", &mitsuba("rectangle", &texture));
        refused(&path, &bounds, &format!("bitmap {name}"));
    }
    // A parameter may contain the name too.
    let text = mitsuba("ply", &filename("$x"))
        .replace("<sensor", r#"<default name="x" value="../secret"/><sensor"#);
    refused(&place.scene("a.xml", &text), &bounds, "default");
}

#[test]
fn gltf_names_no_file_outside_its_folder_by_any_spelling() {
    let place = Place::new();
    let mut names = place.tricks();
    names.extend(
        [
            "%2e%2e/secret",
            "..%2fsecret",
            "%2e%2e%2fsecret",
            "%2E%2E%5Csecret",
            "li%6ek",
            "%2fetc%2fpasswd",
            "a%00b",
        ]
        .map(str::to_owned),
    );
    for name in names {
        let text = format!(
            r#"{{"asset": {{"version": "2.0"}}, "scenes": [{{"nodes": []}}], "buffers": [{{"uri": {name:?}, "byteLength": 4}}]}}"#
        );
        let path = place.scene("a.gltf", &text);
        refused(&path, &Bounds::default(), &format!("buffer {name}"));
        let text = format!(
            r#"{{"asset": {{"version": "2.0"}}, "scenes": [{{"nodes": []}}], "images": [{{"uri": {name:?}}}]}}"#
        );
        let path = place.scene("a.gltf", &text);
        let said = fingerprint(&path, &Bounds::default())
            .unwrap_err()
            .to_string();
        assert!(said.contains("is not opened"), "image {name}: {said}");
    }
}

#[test]
fn a_root_lets_scenes_share_meshes_and_an_operators_bounds_hold_all_the_same() {
    let place = Place::new();
    std::fs::create_dir(place.dir.path().join("meshes")).unwrap();
    let mesh = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n\
                element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n";
    std::fs::write(place.dir.path().join("meshes/a.ply"), mesh).unwrap();
    let path = place.scene("a.xml", &mitsuba("ply", &filename("../meshes/a.ply")));
    let root = Some(place.dir.path().to_owned());
    let bounds = Bounds {
        root,
        ..Bounds::default()
    };
    refused(&path, &Bounds::default(), "no root");
    read_scene_with(&path, &options(), &bounds).unwrap();
    fingerprint(&path, &bounds).unwrap();
    let within = Bounds {
        files: bounds.files.within([place.scenes()]),
        ..bounds
    };
    refused(&path, &within, "operator");
    // The scene file itself is also checked.
    let own = place.scenes().join("link");
    let said = read_scene_with(&own, &options(), &within).unwrap_err();
    assert!(matches!(said, SceneError::Refused(_)), "{said}");
}

#[test]
fn a_file_that_is_something_else_is_not_quoted() {
    let place = Place::new();
    std::fs::write(place.scenes().join("own"), format!("{SECRET}\n")).unwrap();
    let tagged = format!("<{SECRET}>");
    for (name, text) in [
        ("a.xml", mitsuba("ply", &filename("own"))),
        ("a.xml", mitsuba("obj", &filename("own"))),
        ("a.xml", "<hunter2>".into()),
        ("a.xml", "<hunter2/>".into()),
        ("a.xml", tagged),
        ("a.json", format!("{SECRET}\n")),
        ("a.json", format!("[{SECRET:?}]")),
        ("a.json", format!("{{{SECRET:?}: 1}}")),
        ("a.ply", format!("ply\n{SECRET}\nend_header\n")),
        (
            "a.ply",
            format!(
                "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n\
                 end_header\n{SECRET}\n"
            ),
        ),
    ] {
        let path = place.scene(name, &text);
        let said = read_scene_with(&path, &options(), &Bounds::default())
            .unwrap_err()
            .to_string();
        assert!(
            !said.contains("hunter2") && !said.contains("root:"),
            "{said}"
        );
        assert!(said.contains(name), "{said}");
    }
}
