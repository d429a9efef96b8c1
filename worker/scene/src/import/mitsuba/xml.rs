//! Parses Mitsuba's XML to a tree, and resolves defaults, ids and transforms.

use std::{
    collections::{BTreeMap, BTreeSet},
    path::{Path, PathBuf},
    rc::Rc,
};

use roxmltree::{Document, ParsingOptions};

use picofarm_files::FileError;

use crate::import::{Opener, quoted, read_file};

use super::{
    node::{Child, Node, Value, numbers, pairs, triple},
    old,
    transform::Matrix,
};

/// The deepest nesting of elements.
const MAX_DEPTH: usize = 32;
/// The greatest number of elements of a file.
const MAX_NODES: u32 = 4_000_000;
/// The greatest length of an attribute with its parameters replaced, bytes.
const MAX_VALUE: usize = 1 << 16;
/// The greatest number of `<default>` parameters of a file.
const MAX_DEFAULTS: usize = 1024;
/// The greatest number of `<include>` elements of a scene.
const MAX_INCLUDES: usize = 256;
/// The elements that are plugins.
const PLUGINS: [&str; 7] = [
    "scene", "shape", "bsdf", "sensor", "emitter", "texture", "film",
];
/// Elements of emitters that are read; the laser needs no others.
const EMITTER_VALUES: [&str; 8] = [
    "transform",
    "float",
    "integer",
    "boolean",
    "string",
    "vector",
    "point",
    "rgb",
];
/// Plugins with settings for rendering, which belong to the job.
pub(super) const SKIPPED: [&str; 6] = [
    "integrator",
    "sampler",
    "rfilter",
    "medium",
    "volume",
    "phase",
];

/// A scene's tree.
pub(super) struct Parsed {
    pub(super) root: Node,
    /// The text of its comment that starts with `picofarm`.
    pub(super) extras: Option<String>,
    /// The files that it includes, in order.
    pub(super) included: Vec<PathBuf>,
}

/// Parses a scene at `path`, with the files that it includes.
pub(super) fn parse(text: &str, path: &Path, files: &Opener) -> Result<Parsed, String> {
    let mut shared = Shared {
        files: files.clone(),
        ids: BTreeSet::new(),
        aliases: Vec::new(),
        skipped: Vec::new(),
        defaults: BTreeMap::new(),
        folders: Rc::new(vec![folder(path)]),
        included: Vec::new(),
        depth: 0,
    };
    let (mut root, extras) = scene(text, "", &mut shared)?;
    root.aliases = std::mem::take(&mut shared.skipped);
    for (id, known, at) in std::mem::take(&mut shared.aliases) {
        let target = find(&root, &known).ok_or_else(|| {
            format!(
                "{at}: refers to {}, which no element has as its id",
                quoted(&known)
            )
        })?;
        root.aliases.push((id, target));
    }
    Ok(Parsed {
        root,
        extras,
        included: shared.included,
    })
}

/// Returns the descendant of a node with an id.
fn find(root: &Node, id: &str) -> Option<Rc<Node>> {
    let nodes = |node: &Node| -> Vec<Rc<Node>> {
        let children = node.children.iter().filter_map(|(_, child)| match child {
            Child::Node(child) => Some(child.clone()),
            Child::Reference(_) => None,
        });
        children.collect()
    };
    let mut open = nodes(root);
    while let Some(node) = open.pop() {
        if node.id == id {
            return Some(node);
        }
        open.extend(nodes(&node));
    }
    None
}

/// Parses one document. `place` names it in errors; it is empty for the scene itself.
fn scene(text: &str, place: &str, shared: &mut Shared) -> Result<(Node, Option<String>), String> {
    let text = text.trim_start_matches('\u{feff}');
    let options = ParsingOptions {
        allow_dtd: false,
        nodes_limit: MAX_NODES,
        ..ParsingOptions::default()
    };
    let document = Document::parse_with_options(text, options)
        // The parser's message would quote the file.
        .map_err(|e| {
            format!(
                "{place}is not readable XML: line {}, column {}",
                e.pos().row,
                e.pos().col
            )
        })?;
    let root = document.root_element();
    if root.tag_name().name() != "scene" {
        return Err(format!(
            "{place}expected <scene> as the outermost element: not a Mitsuba scene"
        ));
    }
    let ends = text.bytes().enumerate().filter(|(_, b)| *b == b'\n');
    let mut parser = Parser {
        text,
        place,
        line_ends: ends.map(|(k, _)| k).collect(),
        old: old::is_old(root.attribute("version"))?,
        shared,
    };
    let node = parser.plugin(root, 0)?;
    let extras = root
        .children()
        .filter(|c| c.is_comment())
        .find_map(|c| c.text()?.trim().strip_prefix("picofarm "));
    Ok((node, extras.map(str::to_owned)))
}

fn folder(path: &Path) -> PathBuf {
    path.parent().unwrap_or(Path::new("")).to_owned()
}

/// What a scene shares with the files that it includes.
struct Shared {
    files: Opener,
    ids: BTreeSet<String>,
    /// The aliases: (new id, known id, position).
    aliases: Vec<(String, String, String)>,
    /// The skipped elements with an id, which other elements may refer to.
    skipped: Vec<(String, Rc<Node>)>,
    /// The parameters; longer names are replaced first.
    defaults: BTreeMap<String, String>,
    /// The folders that files are searched in.
    folders: Rc<Vec<PathBuf>>,
    included: Vec<PathBuf>,
    /// The number of documents that include the current one.
    depth: usize,
}

impl Shared {
    fn add_folder(&mut self, folder: PathBuf) {
        if !self.folders.contains(&folder) {
            Rc::make_mut(&mut self.folders).push(folder);
        }
    }
}

struct Parser<'a, 's> {
    text: &'a str,
    /// The start of the positions in errors: empty, or the name of an included file.
    place: &'s str,
    line_ends: Vec<usize>,
    /// Whether the file's version is before 2, with names in camelCase.
    old: bool,
    shared: &'s mut Shared,
}

type Element<'a> = roxmltree::Node<'a, 'a>;

impl<'a> Parser<'a, '_> {
    fn at(&self, e: Element<'a>) -> String {
        let line = self.line_ends.partition_point(|k| *k < e.range().start) + 1;
        let name = quoted(e.tag_name().name());
        let name = name.trim_matches('"');
        let place = self.place;
        match e.attribute("type") {
            Some(kind) => format!("{place}line {line}, <{name} type={}>", quoted(kind)),
            None => format!("{place}line {line}, <{name}>"),
        }
    }

    /// Refuses attributes outside `known`.
    fn only(&self, e: Element<'a>, known: &[&str]) -> Result<(), String> {
        let other = e.attributes().find(|a| !known.contains(&a.name()));
        match other {
            None => Ok(()),
            Some(other) => Err(format!(
                "{}: the attribute {} is not known; use {}",
                self.at(e),
                quoted(other.name()),
                known.join(", ")
            )),
        }
    }

    /// Returns an attribute with `$name` replaced.
    fn attribute(&self, e: Element<'a>, name: &str) -> Result<Option<String>, String> {
        let Some(raw) = e.attribute(name) else {
            return Ok(None);
        };
        if !raw.contains('$') {
            return Ok(Some(raw.to_owned()));
        }
        let mut value = raw.to_owned();
        let mut names: Vec<&String> = self.shared.defaults.keys().collect();
        names.sort_by_key(|n| std::cmp::Reverse(n.len()));
        for known in names {
            let (key, new) = (format!("${known}"), &self.shared.defaults[known]);
            let count = value.matches(&key).count();
            if count > 0 && value.len() + count * new.len() > MAX_VALUE {
                return Err(format!(
                    "{}: {name}: longer than {MAX_VALUE} bytes",
                    self.at(e)
                ));
            }
            value = value.replace(&key, new);
        }
        if value.contains('$') {
            return Err(format!(
                "{}: {name}={} uses a parameter without <default>; add <default name=… value=…/> before it",
                self.at(e),
                quoted(raw)
            ));
        }
        Ok(Some(value))
    }

    fn needs(&self, e: Element<'a>, name: &str) -> Result<String, String> {
        self.attribute(e, name)?
            .ok_or_else(|| format!("{}: needs the attribute {name}", self.at(e)))
    }

    fn plugin(&mut self, e: Element<'a>, depth: usize) -> Result<Node, String> {
        if depth > MAX_DEPTH {
            return Err(format!("{}: nested deeper than {MAX_DEPTH}", self.at(e)));
        }
        let mut node = Node {
            tag: e.tag_name().name().to_owned(),
            kind: self.attribute(e, "type")?.unwrap_or_default(),
            id: self.attribute(e, "id")?.unwrap_or_default(),
            at: self.at(e),
            text: self.text[e.range()].to_owned(),
            folders: self.shared.folders.clone(),
            ..Node::default()
        };
        match depth {
            // The scene's own text would double the file.
            0 => node.text.clear(),
            _ => {
                self.only(e, &["type", "id", "name"])?;
                if node.kind.is_empty() {
                    return Err(node.fail("needs the attribute type"));
                }
            }
        }
        if !node.id.is_empty() && !self.shared.ids.insert(node.id.clone()) {
            return Err(node.fail(format!("the id {} is stated twice", quoted(&node.id))));
        }
        for child in e.children().filter(Element::is_element) {
            let tag = child.tag_name().name();
            let mut name = self.attribute(child, "name")?.unwrap_or_default();
            if self.old && tag != "default" {
                name = old::name(&name);
            }
            if PLUGINS.contains(&tag) && tag != "scene" {
                let inner = Rc::new(self.plugin(child, depth + 1)?);
                node.children.push((name, Child::Node(inner)));
            } else if tag == "ref" {
                self.only(child, &["id", "name"])?;
                let id = self.needs(child, "id")?;
                node.children.push((name, Child::Reference(id)));
            } else if tag == "default" {
                self.only(child, &["name", "value"])?;
                let value = self.needs(child, "value")?;
                self.shared.defaults.entry(name).or_insert(value);
                if self.shared.defaults.len() > MAX_DEFAULTS {
                    let what = format!("more than {MAX_DEFAULTS} <default> parameters");
                    return Err(format!("{}: {what}", self.at(child)));
                }
            } else if SKIPPED.contains(&tag) {
                node.skipped.push(tag.to_owned());
                if let Some(id) = self.attribute(child, "id")? {
                    let skipped = Node {
                        tag: tag.to_owned(),
                        at: self.at(child),
                        ..Node::default()
                    };
                    self.shared.skipped.push((id, Rc::new(skipped)));
                }
            } else if tag == "include" {
                self.include(child, &mut node, depth)?;
            } else if tag == "path" {
                self.only(child, &["value"])?;
                let value = self.needs(child, "value")?;
                let at = self.at(child);
                for folder in self.shared.folders.clone().iter() {
                    let folder = Opener::named(folder, &value).map_err(|e| format!("{at}: {e}"))?;
                    self.shared.add_folder(folder);
                }
            } else if tag == "alias" {
                self.only(child, &["id", "as"])?;
                let (known, id) = (self.needs(child, "id")?, self.needs(child, "as")?);
                let at = self.at(child);
                self.shared.aliases.push((id, known, at));
            } else if node.tag == "emitter" && !EMITTER_VALUES.contains(&tag) {
                // The colour and power of lamps are not used.
            } else {
                let at = self.at(child);
                let value = self.value(child, tag).map_err(|e| {
                    match e.starts_with("line ") || e.starts_with(&at) {
                        true => e,
                        false => format!("{at}: {e}"),
                    }
                })?;
                if name.is_empty() {
                    return Err(format!("{at}: needs the attribute name"));
                }
                node.set(name, value, at)?;
            }
        }
        if self.old {
            old::upgrade(&mut node)?;
        }
        Ok(node)
    }

    /// Puts the elements of another file in the place of `<include>`.
    fn include(&mut self, e: Element<'a>, node: &mut Node, depth: usize) -> Result<(), String> {
        self.only(e, &["filename"])?;
        let name = self.needs(e, "filename")?;
        let at = self.at(e);
        let path = resolved(&self.shared.files, &self.shared.folders, &name)
            .map_err(|what| format!("{at}: {what}"))?;
        if self.shared.included.len() >= MAX_INCLUDES || self.shared.depth >= MAX_DEPTH {
            return Err(format!(
                "{at}: more than {MAX_INCLUDES} files are included, or a file includes itself"
            ));
        }
        self.shared.included.push(path.clone());
        let bytes = read_file(&self.shared.files, &path).map_err(|what| format!("{at}: {what}"))?;
        let text = std::str::from_utf8(&bytes)
            .map_err(|e| format!("{at}: {}: is not UTF-8 text: {e}", path.display()))?;
        self.shared.add_folder(folder(&path));
        self.shared.depth += 1;
        let place = format!("{}: ", path.display());
        let (inner, _) = scene(text, &place, self.shared)?;
        self.shared.depth -= 1;
        node.children.extend(inner.children);
        node.skipped.extend(inner.skipped);
        match depth {
            0 => Ok(()),
            _ => Err(format!("{at}: is only supported directly in <scene>")),
        }
    }

    fn value(&self, e: Element<'a>, tag: &str) -> Result<Value, String> {
        if tag == "transform" {
            self.only(e, &["name"])?;
            return self.transform(e).map(Value::Transform);
        }
        if matches!(tag, "vector" | "point") {
            self.only(e, &["name", "value", "x", "y", "z"])?;
            return self.vector(e, 0.0).map(Value::Vector);
        }
        if !matches!(
            tag,
            "float" | "integer" | "boolean" | "string" | "rgb" | "spectrum"
        ) {
            return Err(
                "this element is not supported; see the documentation for the subset".into(),
            );
        }
        match tag {
            // Version 0.6 had an intent of colours.
            "rgb" | "spectrum" if self.old => self.only(e, &["name", "value", "intent"])?,
            _ => self.only(e, &["name", "value"])?,
        }
        let value = self.needs(e, "value")?;
        Ok(match tag {
            "string" => Value::Text(value),
            "boolean" => match value.trim() {
                "true" => Value::Switch(true),
                "false" => Value::Switch(false),
                _ => return Err(format!("expected true or false, found {}", quoted(&value))),
            },
            "float" | "integer" => match numbers(&value)?[..] {
                [x] => Value::Number(x),
                _ => return Err(format!("expected one number, found {}", quoted(&value))),
            },
            "spectrum" if value.contains(':') => Value::Spectrum(pairs(&value)?),
            _ => Value::Colour(colour(&value)?),
        })
    }

    /// Parses `value` with 1 or 3 numbers, or any of `x`, `y`, `z`.
    fn vector(&self, e: Element<'a>, missing: f64) -> Result<[f64; 3], String> {
        if let Some(value) = self.attribute(e, "value")? {
            return triple(&numbers(&value)?);
        }
        let mut out = [missing; 3];
        for (k, name) in ["x", "y", "z"].into_iter().enumerate() {
            if let Some(value) = self.attribute(e, name)? {
                out[k] = self.one(&value)?;
            }
        }
        Ok(out)
    }

    fn one(&self, value: &str) -> Result<f64, String> {
        match numbers(value)?[..] {
            [x] => Ok(x),
            _ => Err(format!("expected one number, found {}", quoted(value))),
        }
    }

    fn transform(&self, e: Element<'a>) -> Result<Matrix, String> {
        let mut all = Matrix::IDENTITY;
        for step in e.children().filter(Element::is_element) {
            self.only(step, attributes_of(step.tag_name().name()))?;
            let point = |name: &str| triple(&numbers(&self.needs(step, name)?)?);
            let matrix = match step.tag_name().name() {
                "translate" => Matrix::translation(self.vector(step, 0.0)?),
                "scale" => Matrix::scale(self.vector(step, 1.0)?),
                "rotate" => {
                    let angle = self.one(&self.needs(step, "angle")?)?;
                    Matrix::rotation(self.vector(step, 0.0)?, angle)?
                }
                "lookat" | "look_at" | "lookAt" => {
                    let up = match step.attribute("up") {
                        Some(_) => point("up")?,
                        None => [0.0, 1.0, 0.0],
                    };
                    Matrix::look_at(point("origin")?, point("target")?, up)?
                }
                "matrix" => Matrix::from_numbers(&numbers(&self.needs(step, "value")?)?)?,
                other => {
                    return Err(format!(
                        "<{}> is no transform; use translate, rotate, scale, matrix or lookat",
                        quoted(other).trim_matches('"')
                    ));
                }
            };
            all = matrix.after(&all);
        }
        Ok(all)
    }
}

/// Returns the path of a file by its name: in the first folder where it exists, else in the first.
///
/// # Errors
/// A name that is not a plain path.
pub(super) fn resolved(
    files: &Opener,
    folders: &[PathBuf],
    name: &str,
) -> Result<PathBuf, FileError> {
    let mut first = None;
    for folder in folders {
        let path = Opener::named(folder, name)?;
        if files.check(&path).is_ok() && path.is_file() {
            return Ok(path);
        }
        first.get_or_insert(path);
    }
    match first {
        Some(path) => Ok(path),
        None => Opener::named(Path::new(""), name),
    }
}

/// Returns the attributes of a step of a transform.
fn attributes_of(step: &str) -> &'static [&'static str] {
    match step {
        "rotate" => &["value", "x", "y", "z", "angle"],
        "matrix" => &["value"],
        "lookat" | "look_at" | "lookAt" => &["origin", "target", "up"],
        _ => &["value", "x", "y", "z"],
    }
}

/// Parses one or three numbers, or #rrggbb (sRGB).
fn colour(text: &str) -> Result<[f32; 3], String> {
    if let Some(hex) = text.trim().strip_prefix('#') {
        let byte = |k: usize| {
            let pair = hex.get(2 * k..2 * k + 2).filter(|_| hex.len() == 6);
            pair.and_then(|p| u8::from_str_radix(p, 16).ok())
                .map(crate::texture::linear)
        };
        return match (byte(0), byte(1), byte(2)) {
            (Some(r), Some(g), Some(b)) => Ok([r, g, b]),
            _ => Err(format!("expected #rrggbb, found {}", quoted(text))),
        };
    }
    if text.contains(':') {
        return Err("expected 1 or 3 numbers; values by wavelength stand in <spectrum>".into());
    }
    triple(&numbers(text)?).map(|c| c.map(|x| x as f32))
}
