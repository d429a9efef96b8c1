//! The order of the renderer's folders, and of the files in them.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
    path::{Path, PathBuf},
};

/// The folders of `src` from the bottom up. A folder imports only from layers below its own.
const LAYERS: [&[&str]; 5] = [
    &["api", "numeric", "tuning"],
    &["film", "scene"],
    &["light"],
    &["paths", "truth"],
    &["render"],
];

/// Imports by file, both relative to `src`.
type Imports = BTreeMap<String, BTreeSet<String>>;

fn sources(folder: &Path, all: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            sources(&path, all);
        } else if path.extension().is_some_and(|e| e == "rs") {
            all.push(path);
        }
    }
}

/// Returns the paths of a tree of imports: `a::{b, c::d}` is `a::b` and `a::c::d`.
fn leaves(tree: &str) -> Vec<String> {
    let Some((prefix, rest)) = tree.split_once('{') else {
        return vec![tree.trim().to_owned()];
    };
    let inner = &rest[..rest.rfind('}').unwrap()];
    let (mut parts, mut depth, mut start) = (vec![], 0, 0);
    for (k, c) in inner.char_indices() {
        match c {
            '{' => depth += 1,
            '}' => depth -= 1,
            ',' if depth == 0 => {
                parts.push(&inner[start..k]);
                start = k + 1;
            }
            _ => {}
        }
    }
    parts.push(&inner[start..]);
    let parts = parts.into_iter().filter(|part| !part.trim().is_empty());
    let each = parts.flat_map(|part| leaves(part.trim()));
    each.map(|leaf| format!("{}{leaf}", prefix.trim()))
        .collect()
}

/// Returns the code of a file without comments and unit tests.
fn code(text: &str) -> String {
    let code = text.split("#[cfg(test)]").next().unwrap();
    let lines = code.lines().map(|l| l.split("//").next().unwrap());
    lines.collect::<Vec<_>>().join("\n")
}

/// Returns the paths that begin with `crate::`, in `use` statements and elsewhere.
fn paths(code: &str) -> Vec<String> {
    let mut all = vec![];
    for part in code.split("crate::").skip(1) {
        let tree = match part.starts_with('{') {
            true => &part[..part.find(';').unwrap()],
            false => {
                let in_path = |c: char| c.is_alphanumeric() || c == '_' || c == ':';
                let end = part.find(|c| !in_path(c)).unwrap_or(part.len());
                match part[end..].starts_with('{') && part[..end].ends_with("::") {
                    true => &part[..part.find(';').unwrap()],
                    false => &part[..end],
                }
            }
        };
        all.extend(leaves(tree));
    }
    all
}

/// Returns the file that defines the longest beginning of a path.
fn file(files: &BTreeSet<String>, path: &str) -> Option<String> {
    let parts: Vec<&str> = path.split("::").filter(|p| !p.is_empty()).collect();
    (1..=parts.len()).rev().find_map(|n| {
        let stem = parts[..n].join("/");
        let names = [format!("{stem}.rs"), format!("{stem}/mod.rs")];
        names.into_iter().find(|name| files.contains(name))
    })
}

fn imports() -> Imports {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut all = vec![];
    sources(&root, &mut all);
    let name = |p: &PathBuf| {
        let relative = p.strip_prefix(&root).unwrap();
        relative.to_str().unwrap().replace('\\', "/")
    };
    let files: BTreeSet<String> = all.iter().map(name).collect();
    let each = all.iter().filter(|p| !p.ends_with("tests.rs"));
    let each = each.map(|p| {
        let code = code(&fs::read_to_string(p).unwrap());
        let file_name = name(p);
        assert!(
            !code.lines().any(|l| l.starts_with("use super::")),
            "{file_name}: import by `crate::…`, so that this test sees it"
        );
        let found = paths(&code).into_iter();
        let found = found.filter_map(|path| file(&files, &path));
        let found = found.filter(|f| *f != file_name).collect();
        (file_name, found)
    });
    each.collect()
}

fn folder(file: &str) -> &str {
    let first = file.split('/').next().unwrap();
    first.strip_suffix(".rs").unwrap_or(first)
}

#[test]
fn a_folder_imports_only_from_layers_below_its_own() {
    let layer = |folder: &str| LAYERS.iter().position(|l| l.contains(&folder));
    let mut seen = BTreeSet::new();
    for (from, to) in &imports() {
        let from_folder = folder(from);
        if from_folder == "lib" {
            continue;
        }
        let own = layer(from_folder).unwrap_or_else(|| panic!("{from}: add its folder to LAYERS"));
        for to in to.iter().filter(|to| folder(to) != from_folder) {
            let below = layer(folder(to)).is_some_and(|l| l < own);
            assert!(below, "{from} imports {to}, which is not below it");
            seen.insert((from_folder.to_owned(), folder(to).to_owned()));
        }
    }
    assert!((10..=30).contains(&seen.len()), "{seen:?}");
}

#[test]
fn files_do_not_import_each_other_in_circles() {
    let mut left = imports();
    assert!(left.values().map(BTreeSet::len).sum::<usize>() > 300);
    // Removes files that import nothing that is left, until only circles and their users remain.
    loop {
        let done: Vec<String> = left
            .iter()
            .filter(|(_, to)| !to.iter().any(|to| left.contains_key(to)))
            .map(|(from, _)| from.clone())
            .collect();
        if done.is_empty() {
            break;
        }
        left.retain(|from, _| !done.contains(from));
    }
    assert!(left.is_empty(), "in circles, or above them: {left:#?}");
}

#[test]
fn imports_are_read_from_use_trees_and_from_paths_in_code() {
    let code = code("use crate::{a::{B, c::D}, e};\nlet x = crate::f::g(1); // crate::h::I\n");
    assert_eq!(paths(&code), ["a::B", "a::c::D", "e", "f::g"]);
    let files = ["a/c.rs", "a/mod.rs", "f.rs"].map(str::to_owned).into();
    assert_eq!(file(&files, "a::c::D").as_deref(), Some("a/c.rs"));
    assert_eq!(file(&files, "a::B").as_deref(), Some("a/mod.rs"));
    assert_eq!(file(&files, "x::Y"), None);
}
