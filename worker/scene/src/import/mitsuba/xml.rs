//! Mitsuba's XML as a tree: defaults, ids and transforms resolved.

use std::{collections::BTreeMap, rc::Rc};

use roxmltree::{Document, ParsingOptions};

use super::{
    node::{Child, Node, Value, numbers, pairs, triple},
    transform::Matrix,
};

/// Deepest nesting of elements.
const MAX_DEPTH: usize = 32;
/// Most elements of a file.
const MAX_NODES: u32 = 4_000_000;
/// Longest attribute with its parameters replaced, bytes.
const MAX_VALUE: usize = 1 << 16;
/// Elements that are plugins.
const PLUGINS: [&str; 7] = [
    "scene", "shape", "bsdf", "sensor", "emitter", "texture", "film",
];
/// Plugins that say how to render, which is the job's business.
const SKIPPED: [&str; 6] = [
    "integrator",
    "sampler",
    "rfilter",
    "medium",
    "volume",
    "phase",
];

/// The scene's node, and the texts of its comments that start with `picofarm`.
pub(super) fn parse(text: &str) -> Result<(Node, Option<String>), String> {
    let options = ParsingOptions {
        allow_dtd: false,
        nodes_limit: MAX_NODES,
        ..ParsingOptions::default()
    };
    let document = Document::parse_with_options(text, options)
        // What the parser says quotes the file.
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
    let mut parser = Parser {
        document: &document,
        text,
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
    document: &'a Document<'a>,
    text: &'a str,
    /// Longest name first when replaced.
    defaults: BTreeMap<String, String>,
}

type Element<'a> = roxmltree::Node<'a, 'a>;

impl<'a> Parser<'a> {
    fn at(&self, e: Element<'a>) -> String {
        let line = self.document.text_pos_at(e.range().start).row;
        let name = e.tag_name().name();
        match e.attribute("type") {
            Some(kind) => format!("line {line}, <{name} type={kind:?}>"),
            None => format!("line {line}, <{name}>"),
        }
    }

    /// An attribute with `$name` replaced.
    fn attribute(&self, e: Element<'a>, name: &str) -> Result<Option<String>, String> {
        let Some(raw) = e.attribute(name) else {
            return Ok(None);
        };
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
                "{}: {name}={raw:?} uses a parameter without <default>; add <default name=… value=…/> before it",
                self.at(e)
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
        if depth > 0 && node.kind.is_empty() {
            return Err(node.fail("needs the attribute type"));
        }
        // The scene's own text would double the file.
        if depth == 0 {
            node.text.clear();
        }
        for child in e.children().filter(Element::is_element) {
            let tag = child.tag_name().name();
            let name = self.attribute(child, "name")?.unwrap_or_default();
            if PLUGINS.contains(&tag) && tag != "scene" {
                let inner = Rc::new(self.plugin(child, depth + 1)?);
                node.children.push((name, Child::Node(inner)));
            } else if tag == "ref" {
                let id = self.needs(child, "id")?;
                node.children.push((name, Child::Reference(id)));
            } else if tag == "default" {
                let value = self.needs(child, "value")?;
                self.defaults.entry(name).or_insert(value);
            } else if !SKIPPED.contains(&tag) {
                let at = self.at(child);
                let value = self.value(child, tag).map_err(|e| {
                    if e.starts_with("line ") {
                        e
                    } else {
                        format!("{at}: {e}")
                    }
                })?;
                node.parameters.insert(name, value);
            }
        }
        Ok(node)
    }

    fn value(&self, e: Element<'a>, tag: &str) -> Result<Value, String> {
        if tag == "transform" {
            return self.transform(e).map(Value::Transform);
        }
        if matches!(tag, "vector" | "point") {
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
        let value = self.needs(e, "value")?;
        Ok(match tag {
            "string" => Value::Text(value),
            "boolean" => match value.trim() {
                "true" => Value::Switch(true),
                "false" => Value::Switch(false),
                _ => return Err(format!("expected true or false, found {value:?}")),
            },
            "float" | "integer" => match numbers(&value)?[..] {
                [x] => Value::Number(x),
                _ => return Err(format!("expected one number, found {value:?}")),
            },
            "spectrum" if value.contains(':') => Value::Spectrum(pairs(&value)?),
            _ => Value::Colour(colour(&value)?),
        })
    }

    /// `value` with 1 or 3 numbers, or any of `x`, `y`, `z`.
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
            _ => Err(format!("expected one number, found {value:?}")),
        }
    }

    fn transform(&self, e: Element<'a>) -> Result<Matrix, String> {
        let mut all = Matrix::IDENTITY;
        for step in e.children().filter(Element::is_element) {
            let point = |name: &str| triple(&numbers(&self.needs(step, name)?)?);
            let matrix = match step.tag_name().name() {
                "translate" => Matrix::translation(self.vector(step, 0.0)?),
                "scale" => Matrix::scale(self.vector(step, 1.0)?),
                "rotate" => {
                    let angle = self.one(&self.needs(step, "angle")?)?;
                    Matrix::rotation(self.vector(step, 0.0)?, angle)?
                }
                "lookat" | "look_at" => {
                    let up = match step.attribute("up") {
                        Some(_) => point("up")?,
                        None => [0.0, 1.0, 0.0],
                    };
                    Matrix::look_at(point("origin")?, point("target")?, up)?
                }
                "matrix" => Matrix::from_numbers(&numbers(&self.needs(step, "value")?)?)?,
                other => {
                    return Err(format!(
                        "<{other}> is no transform; use translate, rotate, scale, matrix or lookat"
                    ));
                }
            };
            all = matrix.after(&all);
        }
        Ok(all)
    }
}

/// One or three numbers, or #rrggbb (sRGB).
fn colour(text: &str) -> Result<[f32; 3], String> {
    if let Some(hex) = text.trim().strip_prefix('#') {
        let byte = |k: usize| {
            let pair = hex.get(2 * k..2 * k + 2).filter(|_| hex.len() == 6);
            pair.and_then(|p| u8::from_str_radix(p, 16).ok())
                .map(crate::texture::linear)
        };
        return match (byte(0), byte(1), byte(2)) {
            (Some(r), Some(g), Some(b)) => Ok([r, g, b]),
            _ => Err(format!("expected #rrggbb, found {text:?}")),
        };
    }
    if text.contains(':') {
        return Err("expected 1 or 3 numbers; values by wavelength stand in <spectrum>".into());
    }
    triple(&numbers(text)?).map(|c| c.map(|x| x as f32))
}
