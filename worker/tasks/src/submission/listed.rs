//! Expands the list of scene files of a job: patterns and folders stand for the files that are
//! there on submission.

use std::path::{Path, PathBuf};

use picofarm_proto::spec::{SceneFile, SpecError};

/// Extensions of files with a whole scene. Only a pattern or a path selects `.json`, because
/// folders also contain JSON of other kinds.
const SCENES: [&str; 3] = ["glb", "gltf", "xml"];
/// Extensions of meshes. In a folder with scenes they are parts of these.
const MESHES: [&str; 3] = ["obj", "ply", "stl"];
/// The deepest nesting of folders.
const MAX_DEPTH: usize = 32;

/// Returns the files for an entry of `scenes.files`, in the order of their paths. `path` is the
/// entry as an absolute path.
///
/// A folder stands for its scenes (glTF and Mitsuba), without any for its meshes, and without these
/// for its subfolders.
///
/// # Errors
/// A pattern or a folder without scene files.
pub(super) fn files(field: &str, path: &Path) -> Result<Vec<SceneFile>, SpecError> {
    let fail = |what: String| SpecError::new(field, what);
    let text = path.to_str().unwrap_or_default();
    let paths = if path.is_dir() {
        let mut found = Vec::new();
        folder(path, MAX_DEPTH, &mut found).map_err(fail)?;
        if found.is_empty() {
            return Err(fail(format!(
                "{text:?} is a folder without scene files; expected .glb, .gltf, .xml, .obj, .ply or .stl files in it"
            )));
        }
        found
    } else if text.contains(['*', '?', '[']) && !path.exists() {
        let all = glob::glob(text).map_err(|e| fail(format!("{text:?}: {e}")))?;
        let all: Result<Vec<PathBuf>, _> = all.collect();
        let all = all.map_err(|e| fail(e.to_string()))?;
        let found: Vec<PathBuf> = all.into_iter().filter(|path| path.is_file()).collect();
        if found.is_empty() {
            return Err(fail(format!("{text:?}: the pattern matches no file")));
        }
        found
    } else {
        vec![path.to_owned()]
    };
    let pinned = paths.into_iter().map(|path| {
        let text = path.to_str().map(str::to_owned);
        let path =
            text.ok_or_else(|| fail(format!("{path:?}: the name is no Unicode; rename it")))?;
        Ok(SceneFile {
            path,
            sha256: String::new(),
        })
    });
    pinned.collect()
}

fn folder(path: &Path, depth: usize, found: &mut Vec<PathBuf>) -> Result<(), String> {
    let failed = |e: std::io::Error| format!("{}: {e}", path.display());
    let entries: Result<Vec<_>, _> = std::fs::read_dir(path).map_err(failed)?.collect();
    let mut entries: Vec<PathBuf> = entries.map_err(failed)?.iter().map(|e| e.path()).collect();
    entries.sort_unstable();
    for extensions in [SCENES, MESHES] {
        let own = entries.iter().filter(|p| has(p, extensions) && p.is_file());
        let own: Vec<PathBuf> = own.cloned().collect();
        if !own.is_empty() {
            found.extend(own);
            return Ok(());
        }
    }
    if depth == 0 {
        return Err(format!(
            "{}: more than {MAX_DEPTH} nested folders",
            path.display()
        ));
    }
    let folders = entries.iter().filter(|p| p.is_dir());
    folders
        .into_iter()
        .try_for_each(|inner| folder(inner, depth - 1, found))
}

fn has(path: &Path, extensions: [&str; 3]) -> bool {
    let own = path.extension().and_then(|e| e.to_str());
    own.is_some_and(|own| extensions.iter().any(|e| own.eq_ignore_ascii_case(e)))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(base: &Path, entry: &str) -> Result<Vec<String>, String> {
        let found = files("scenes.files[0]", &base.join(entry)).map_err(|e| e.to_string())?;
        let name = |f: SceneFile| {
            let inner = Path::new(&f.path).strip_prefix(base).unwrap();
            inner.to_str().unwrap().to_owned()
        };
        Ok(found.into_iter().map(name).collect())
    }

    #[test]
    fn patterns_and_folders_stand_for_their_scene_files_in_order() {
        let dir = tempfile::tempdir().unwrap();
        for file in [
            "all/b/room.xml",
            "all/b/meshes/wall.ply",
            "all/a/two.glb",
            "all/a/one.GLB",
            "all/a/notes.json",
            "all/c/chair.obj",
            "all/c/chair.mtl",
            "none/readme.md",
            "one[1].glb",
        ] {
            let path = dir.path().join(file);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, file).unwrap();
        }
        let names = |entry| names(dir.path(), entry);
        let all = [
            "all/a/one.GLB",
            "all/a/two.glb",
            "all/b/room.xml",
            "all/c/chair.obj",
        ];
        assert_eq!(names("all").unwrap(), all);
        assert_eq!(names("all/*/t*.glb").unwrap(), ["all/a/two.glb"]);
        assert_eq!(names("all/**/*.ply").unwrap(), ["all/b/meshes/wall.ply"]);
        // A path of an existing file is no pattern, and a missing file is named when it is read.
        assert_eq!(names("one[1].glb").unwrap(), ["one[1].glb"]);
        assert_eq!(names("missing.glb").unwrap(), ["missing.glb"]);
        for (entry, expected) in [
            ("none", "without scene files"),
            ("*.stl", "matches no file"),
        ] {
            let said = names(entry).unwrap_err();
            assert!(
                said.contains("scenes.files[0]") && said.contains(expected),
                "{said}"
            );
        }
    }
}
