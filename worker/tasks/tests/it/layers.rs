//! The layers of this crate's modules, read from its source.

use std::{fs, path::Path};

/// The modules below `src`, from the bottom layer to the top.
const LAYERS: [&str; 17] = [
    "errors",
    "memory",
    "submission",
    "stores",
    "saver",
    "interpreter",
    "task",
    "device",
    "trial",
    "python",
    "input",
    "making",
    "repair",
    "kinds",
    "examine",
    "executor",
    "run",
];

/// Returns the source files below a folder.
fn sources(folder: &Path) -> Vec<std::path::PathBuf> {
    let mut files = Vec::new();
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        match path.is_dir() {
            true => files.extend(sources(&path)),
            false => files.push(path),
        }
    }
    files
}

/// Returns the paths that follow `crate::`, also those within braces, as far as their second name.
fn imports(text: &str) -> Vec<String> {
    let mut found = Vec::new();
    for part in text.split("crate::").skip(1) {
        let Some(group) = part.strip_prefix('{') else {
            found.push(part.to_owned());
            continue;
        };
        let (mut depth, mut begin) = (0, 0);
        for (at, c) in group.char_indices() {
            match c {
                '{' => depth += 1,
                '}' if depth == 0 => {
                    found.push(group[begin..at].to_owned());
                    break;
                }
                '}' => depth -= 1,
                ',' if depth == 0 => {
                    found.push(group[begin..at].to_owned());
                    begin = at + 1;
                }
                _ => {}
            }
        }
    }
    // After the last comma of a group there is no path.
    found.retain(|path| !path.trim().is_empty());
    found
}

/// Returns the first two names of a path.
fn head(path: &str) -> (&str, &str) {
    let name = |text: &'_ str| text.find(|c: char| c != '_' && !c.is_alphanumeric());
    let path = path.trim_start();
    let (first, rest) = path.split_at(name(path).unwrap_or(path.len()));
    let rest = rest.strip_prefix("::").unwrap_or("");
    (first, &rest[..name(rest).unwrap_or(rest.len())])
}

#[test]
fn a_module_imports_only_lower_layers_and_a_kind_no_other_kind() {
    let src = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let layer = |module: &str| LAYERS.iter().position(|known| *known == module);
    let (mut seen, mut wrong) = (0, Vec::new());
    for file in sources(&src) {
        let inner = file.strip_prefix(&src).unwrap().with_extension("");
        let names: Vec<&str> = inner.iter().map(|name| name.to_str().unwrap()).collect();
        // Tests of a module may use everything.
        if names == ["lib"] || names.contains(&"tests") || names.ends_with(&["examples", "folded"])
        {
            continue;
        }
        let own = layer(names[0]).unwrap_or_else(|| panic!("{names:?} has no layer"));
        let text = fs::read_to_string(&file).unwrap();
        let code = text.split("#[cfg(test)]\nmod tests {").next().unwrap();
        for path in imports(code) {
            let (module, name) = head(&path);
            seen += 1;
            let fits = match layer(module) {
                Some(other) if other < own => true,
                Some(other) if other == own => names[0] != "kinds" || names.get(1) == Some(&name),
                _ => false,
            };
            if !fits {
                wrong.push(format!(
                    "{} imports crate::{module}::{name}",
                    inner.display()
                ));
            }
        }
    }
    assert!(seen > 100, "only {seen} imports were found");
    assert!(wrong.is_empty(), "{wrong:#?}");
}

#[test]
fn the_layers_test_reads_imports_in_braces() {
    let text = "use crate::{a::{b, c}, d,};\nuse crate::e::f;";
    let all = imports(text);
    let heads: Vec<(&str, &str)> = all.iter().map(|path| head(path)).collect();
    assert_eq!(heads, [("a", ""), ("d", ""), ("e", "f")]);
}
