//! The folders of `src` import one way, and no file imports another in a circle. Tests are exempt.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
    path::{Path, PathBuf},
};

/// The folders. Each may import those before it.
const ORDER: [&str; 8] = [
    "core",
    "memory",
    "observe",
    "auth",
    "explain",
    "actor",
    "submission",
    "edge",
];

/// A path of modules below the root of the crate; the root itself has none.
type Module = Vec<String>;

/// The paths that `use` declarations of a module name, from the root of the crate.
type Imports = BTreeMap<Module, Vec<Module>>;

fn source_files(folder: &Path, files: &mut Vec<PathBuf>) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_name().unwrap().to_str().unwrap();
        // Tests compare layers with each other.
        if ["tests", "tests.rs", "laws.rs", "snapshots"].contains(&name) {
            continue;
        }
        match path.is_dir() {
            true => source_files(&path, files),
            false => files.push(path),
        }
    }
}

fn module_of(root: &Path, file: &Path) -> Module {
    let below = file.strip_prefix(root).unwrap().with_extension("");
    let names = below.iter().map(|name| name.to_str().unwrap().to_owned());
    names
        .filter(|name| name != "mod" && name != "lib")
        .collect()
}

/// Returns the source without comments and without its module `tests`.
fn code(text: &str) -> String {
    let end = text.find("#[cfg(test)]\nmod tests {");
    let lines = text[..end.unwrap_or(text.len())].lines();
    let code = lines.map(|line| line.split("//").next().unwrap());
    code.collect::<Vec<_>>().join("\n")
}

/// Splits `a::{b, c::{d, e}}` into `a::b`, `a::c::d` and `a::c::e`.
fn leaves(tree: &str) -> Vec<Module> {
    let tree = tree.trim();
    if let Some(list) = tree.strip_prefix('{').and_then(|t| t.strip_suffix('}')) {
        let (mut parts, mut depth, mut from) = (Vec::new(), 0, 0);
        for (at, letter) in list.char_indices() {
            match letter {
                '{' => depth += 1,
                '}' => depth -= 1,
                ',' if depth == 0 => {
                    parts.push(&list[from..at]);
                    from = at + 1;
                }
                _ => {}
            }
        }
        parts.push(&list[from..]);
        return parts.into_iter().flat_map(leaves).collect();
    }
    match tree.split_once("::") {
        Some((first, rest)) => leaves(rest)
            .into_iter()
            .map(|mut path| {
                path.insert(0, first.trim().to_owned());
                path
            })
            .collect(),
        None if tree.is_empty() => Vec::new(),
        None => vec![vec![tree.split(" as ").next().unwrap().to_owned()]],
    }
}

/// Returns the trees of `use` declarations, and the paths elsewhere that begin with `crate` or
/// `super`.
fn trees(code: &str) -> Vec<String> {
    let mut trees = Vec::new();
    let mut open: Option<String> = None;
    for line in code.lines().map(str::trim) {
        let keyword = line.find("use ").filter(|at| {
            let before = line[..*at].trim_end();
            before.is_empty() || (before.starts_with("pub") && !before.contains(' '))
        });
        match (&mut open, keyword) {
            (Some(tree), _) => tree.push_str(line),
            (None, Some(at)) => open = Some(line[at + "use ".len()..].to_owned()),
            (None, None) => trees.extend(inline_paths(line)),
        }
        if let Some(tree) = open.take_if(|tree| tree.ends_with(';')) {
            trees.push(tree.trim_end_matches(';').to_owned());
        }
    }
    trees
}

fn inline_paths(line: &str) -> impl Iterator<Item = String> {
    let is_part = |c: char| c.is_alphanumeric() || c == '_' || c == ':';
    let words = line.split(move |c| !is_part(c));
    let paths = words.filter(|w| w.starts_with("crate::") || w.starts_with("super::"));
    paths.map(|path| path.trim_end_matches(':').to_owned())
}

/// Returns the paths that a file imports from this crate. They may begin with `crate`, `self`,
/// `super` or, for re-exports, with the name of a child.
fn imports(module: &Module, code: &str, modules: &BTreeSet<Module>) -> Vec<Module> {
    let mut found = Vec::new();
    for tree in trees(code) {
        for path in leaves(&tree) {
            let mut base = module.clone();
            let rest = match path[0].as_str() {
                "crate" => {
                    base.clear();
                    &path[1..]
                }
                "self" => &path[1..],
                "super" => {
                    let ups = path.iter().take_while(|name| *name == "super").count();
                    base.truncate(base.len() - ups);
                    &path[ups..]
                }
                child => {
                    let child: Module = [module.as_slice(), &[child.to_owned()]].concat();
                    if !modules.contains(&child) {
                        continue;
                    }
                    &path[..]
                }
            };
            base.extend(rest.iter().filter(|name| *name != "self").cloned());
            found.push(base);
        }
    }
    found
}

/// Follows re-exports to the module that defines an imported item.
fn defining_module(path: &Module, all: &Imports) -> Module {
    let depth = (0..=path.len()).rev();
    let depth = depth.into_iter().find(|n| all.contains_key(&path[..*n]));
    let (module, rest) = path.split_at(depth.unwrap());
    let Some(item) = rest.first() else {
        return module.to_vec();
    };
    let reexport = all[module].iter().find(|target| {
        target.last() == Some(item) && target.len() > path.len() && target.starts_with(module)
    });
    match reexport {
        Some(target) => defining_module(target, all),
        None => module.to_vec(),
    }
}

fn all_imports() -> Imports {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut files = Vec::new();
    source_files(&root, &mut files);
    let modules: BTreeSet<Module> = files.iter().map(|f| module_of(&root, f)).collect();
    let read = |file: &PathBuf| {
        let module = module_of(&root, file);
        let code = code(&fs::read_to_string(file).unwrap());
        let imports = imports(&module, &code, &modules);
        (module, imports)
    };
    files.iter().map(read).collect()
}

/// Returns the modules from which each module takes items.
fn dependencies() -> BTreeMap<Module, BTreeSet<Module>> {
    let all = all_imports();
    let of = |(module, paths): (&Module, &Vec<Module>)| {
        let used = paths.iter().map(|path| defining_module(path, &all));
        let used = used.filter(|used| used != module).collect();
        (module.clone(), used)
    };
    all.iter().map(of).collect()
}

fn rank(module: &Module) -> usize {
    let folder = &module[0];
    let rank = ORDER.iter().position(|name| name == folder);
    rank.unwrap_or_else(|| panic!("src/{folder} has no place in ORDER; add it to this test"))
}

#[test]
fn folders_import_only_from_those_below() {
    let dependencies = dependencies();
    let mut wrong = Vec::new();
    for (module, used) in dependencies.iter().filter(|(module, _)| !module.is_empty()) {
        for used in used {
            if used.is_empty() || rank(used) > rank(module) {
                wrong.push(format!("{} imports {}", module.join("::"), used.join("::")));
            }
        }
    }
    assert!(
        wrong.is_empty(),
        "against the order {ORDER:?}:\n{}",
        wrong.join("\n")
    );
    let folders: BTreeSet<_> = dependencies.keys().filter_map(|m| m.first()).collect();
    assert_eq!(
        folders.len(),
        ORDER.len(),
        "ORDER names what does not exist"
    );
}

#[test]
fn no_files_import_each_other_in_a_circle() {
    let mut left = dependencies();
    assert!(left.len() > 50, "the sources are read: {}", left.len());
    loop {
        let free: Vec<Module> = left
            .iter()
            .filter(|(_, used)| !used.iter().any(|used| left.contains_key(used)))
            .map(|(module, _)| module.clone())
            .collect();
        if free.is_empty() {
            break;
        }
        for module in free {
            left.remove(&module);
        }
    }
    let circle: Vec<String> = left
        .iter()
        .map(|(module, used)| {
            let used = used.iter().filter(|used| left.contains_key(*used));
            let used: Vec<String> = used.map(|used| used.join("::")).collect();
            format!("{} imports {}", module.join("::"), used.join(", "))
        })
        .collect();
    assert!(circle.is_empty(), "in a circle:\n{}", circle.join("\n"));
}

#[test]
fn import_trees_are_split_and_reexports_are_followed() {
    let path = |text: &str| -> Module { text.split("::").map(str::to_owned).collect() };
    let tree = "a::{b, c::{self, d as e}, f}";
    let split = ["a::b", "a::c::self", "a::c::d", "a::f"].map(path);
    assert_eq!(leaves(tree), split);
    let all = Imports::from([
        (path("low"), vec![path("low::part::Thing")]),
        (path("low::part"), Vec::new()),
        (path("high"), vec![path("low::Thing")]),
    ]);
    assert_eq!(
        defining_module(&path("low::Thing"), &all),
        path("low::part")
    );
    let modules = all.keys().cloned().collect();
    let code = "use super::low::Thing;\nuse crate::{low::part, high};\nuse std::fmt;\nfn f(x: crate::low::T) {}";
    let found = imports(&path("high"), code, &modules);
    assert_eq!(
        found,
        ["low::Thing", "low::part", "high", "low::T"].map(path)
    );
}
