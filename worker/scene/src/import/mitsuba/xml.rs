//! Parses Mitsuba's XML to a tree, and resolves defaults, ids and transforms.

use std::{
    collections::{BTreeMap, BTreeSet},
    rc::Rc,
};

use roxmltree::{Document, ParsingOptions};

use crate::import::quoted;

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
/// The elements that are plugins.
const PLUGINS: [&str; 7] = [
    "scene", "shape", "bsdf", "sensor", "emitter", "texture", "film",
];
/// Plugins with settings for rendering, which belong to the job.
const SKIPPED: [&str; 6] = [
    "integrator",
    "sampler",
    "rfilter",
    "medium",
    "volume",
    "phase",
];

/// Returns the scene's node, and the text of its comment that starts with `picofarm`.
pub(super) fn parse(text: &str) -> Result<(Node, Option<String>), String> {
    let options = ParsingOptions {
        allow_dtd: false,
        nodes_limit: MAX_NODES,
        ..ParsingOptions::default()
    };
    let document = Document::parse_with_options(text, options)
        // The parser's message would quote the file.
        .map_err(|e| {
            format!(
                "is not readable XML: line {}, column {}",
                e.pos().row,
                e.pos().col
            )
        })?;
    let root = document.root_element();
    if root.tag_name().name() != "scene" {
        return Err("expected <scene> as the outermost element: not a Mitsuba scene".into());
    }
    let ends = text.bytes().enumerate().filter(|(_, b)| *b == b'\n');
    let mut parser = Parser {
        text,
        line_ends: ends.map(|(k, _)| k).collect(),
        old: old::is_old(root.attribute("version"))?,
        ids: BTreeSet::new(),
        defaults: BTreeMap::new(),
    };
    let node = parser.plugin(root, 0)?;
    let extras = root
        .children()
        .filter(|c| c.is_comment())
        .find_map(|c| c.text()?.trim().strip_prefix("picofarm "));
    Ok((node, extras.map(str::to_owned)))
}

struct Parser<'a> {
    text: &'a str,
    line_ends: Vec<usize>,
    /// Whether the file's version is before 2, with names in camelCase.
    old: bool,
    ids: BTreeSet<String>,
    /// The parameters; longer names are replaced first.
    defaults: BTreeMap<String, String>,
}

type Element<'a> = roxmltree::Node<'a, 'a>;

impl<'a> Parser<'a> {
    fn at(&self, e: Element<'a>) -> String {
        let line = self.line_ends.partition_point(|k| *k < e.range().start) + 1;
        let name = quoted(e.tag_name().name());
        let name = name.trim_matches('"');
        match e.attribute("type") {
            Some(kind) => format!("line {line}, <{name} type={}>", quoted(kind)),
            None => format!("line {line}, <{name}>"),
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
        let mut names: Vec<&String> = self.defaults.keys().collect();
        names.sort_by_key(|n| std::cmp::Reverse(n.len()));
        for known in names {
            let (key, new) = (format!("${known}"), &self.defaults[known]);
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
        if !node.id.is_empty() && !self.ids.insert(node.id.clone()) {
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
                self.defaults.entry(name).or_insert(value);
                if self.defaults.len() > MAX_DEFAULTS {
                    let what = format!("more than {MAX_DEFAULTS} <default> parameters");
                    return Err(format!("{}: {what}", self.at(child)));
                }
            } else if SKIPPED.contains(&tag) {
                node.skipped.push(tag.to_owned());
            } else {
                let at = self.at(child);
                let value = self.value(child, tag).map_err(|e| {
                    if e.starts_with("line ") {
                        e
                    } else {
                        format!("{at}: {e}")
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

    fn value(&self, e: Element<'a>, tag: &str) -> Result<Value, String> {
        if tag == "transform" {
            self.only(e, &["name"])?;
            return self.transform(e).map(Value::Transform);
        }
        if matches!(tag, "vector" | "point") {
            self.only(e, &["name", "value", "x", "y", "z"])?;
            return self.vector(e, 0.0).map(Value::Vector);
        }
        if tag == "include" {
            return Err("is not supported; put the elements of the file in its place".into());
        }
        if tag == "path" {
            return Err(
                "is not supported; state the path of each file relative to the scene file".into(),
            );
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
