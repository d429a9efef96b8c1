//! The tree to which both XML and the dictionary are parsed: plugins with parameters and children.

use std::{collections::BTreeMap, path::PathBuf, rc::Rc};

use crate::{SpectrumPoint, import::quoted};

use super::transform::Matrix;

/// A parameter's value.
#[derive(Debug, Clone)]
pub(super) enum Value {
    Number(f64),
    Switch(bool),
    Text(String),
    Colour([f32; 3]),
    /// By wavelength, in the file's order; unchecked.
    Spectrum(Vec<SpectrumPoint>),
    Vector([f64; 3]),
    Transform(Matrix),
}

/// A child, or the id of one.
#[derive(Debug, Clone)]
pub(super) enum Child {
    Node(Rc<Node>),
    Reference(String),
}

/// A plugin.
#[derive(Debug, Default)]
pub(super) struct Node {
    /// shape, bsdf, sensor, …
    pub(super) tag: String,
    /// The plugin's name.
    pub(super) kind: String,
    /// The id; empty without one.
    pub(super) id: String,
    /// The position in the file, for errors.
    pub(super) at: String,
    /// The XML text; empty from a dictionary.
    pub(super) text: String,
    pub(super) parameters: BTreeMap<String, Value>,
    /// The position of each parameter, for errors.
    pub(super) places: BTreeMap<String, String>,
    /// The tags of its skipped elements.
    pub(super) skipped: Vec<String>,
    /// The children in order: (parameter name or empty, child).
    pub(super) children: Vec<(String, Child)>,
    /// Other ids of elements of a scene.
    pub(super) aliases: Vec<(String, Rc<Node>)>,
    /// The folders of the files that this element names, in order of preference.
    pub(super) folders: Rc<Vec<PathBuf>>,
}

impl Node {
    /// Returns a message with the position.
    pub(super) fn fail(&self, what: impl std::fmt::Display) -> String {
        format!("{}: {what}", self.at)
    }

    fn wrong(&self, name: &str, expected: &str) -> String {
        self.fail(format!("{name}: expected {expected}"))
    }

    pub(super) fn number(&self, name: &str) -> Result<Option<f64>, String> {
        match self.parameters.get(name) {
            None => Ok(None),
            Some(Value::Number(x)) => Ok(Some(*x)),
            Some(_) => Err(self.wrong(name, "a number")),
        }
    }

    pub(super) fn text(&self, name: &str) -> Result<Option<&str>, String> {
        match self.parameters.get(name) {
            None => Ok(None),
            Some(Value::Text(x)) => Ok(Some(x)),
            Some(_) => Err(self.wrong(name, "a string")),
        }
    }

    pub(super) fn switch(&self, name: &str) -> Result<Option<bool>, String> {
        match self.parameters.get(name) {
            None => Ok(None),
            Some(Value::Switch(x)) => Ok(Some(*x)),
            Some(_) => Err(self.wrong(name, "true or false")),
        }
    }

    pub(super) fn vector(&self, name: &str) -> Result<Option<[f64; 3]>, String> {
        match self.parameters.get(name) {
            None => Ok(None),
            Some(Value::Vector(x)) => Ok(Some(*x)),
            Some(_) => Err(self.wrong(name, "a point or vector")),
        }
    }

    pub(super) fn transform(&self, name: &str) -> Result<Matrix, String> {
        match self.parameters.get(name) {
            None => Ok(Matrix::IDENTITY),
            Some(Value::Transform(x)) => Ok(*x),
            Some(_) => Err(self.wrong(name, "a transform")),
        }
    }

    /// Sets a parameter.
    ///
    /// # Errors
    /// A name that is already set.
    pub(super) fn set(&mut self, name: String, value: Value, place: String) -> Result<(), String> {
        if self.parameters.contains_key(&name) {
            return Err(format!(
                "{place}: property {} is stated twice",
                quoted(&name)
            ));
        }
        self.places.insert(name.clone(), place);
        self.parameters.insert(name, value);
        Ok(())
    }
}

/// Parses numbers separated by commas or white space.
pub(super) fn numbers(text: &str) -> Result<Vec<f64>, String> {
    text.split(|c: char| c == ',' || c.is_ascii_whitespace())
        .filter(|w| !w.is_empty())
        .map(|w| match w.parse::<f64>() {
            // All values are finally stored in single precision.
            Ok(x) if (x as f32).is_finite() => Ok(x),
            _ => Err(format!("expected a finite number, found {}", quoted(w))),
        })
        .collect()
}

fn finite(word: &str) -> Result<f32, String> {
    match word.parse::<f32>() {
        Ok(x) if x.is_finite() => Ok(x),
        _ => Err(format!("expected a finite number, found {}", quoted(word))),
    }
}

/// Parses `wavelength:value` pairs, separated as in [`numbers`].
pub(super) fn pairs(text: &str) -> Result<Vec<SpectrumPoint>, String> {
    text.split(|c: char| c == ',' || c.is_ascii_whitespace())
        .filter(|w| !w.is_empty())
        .map(|w| match w.split_once(':') {
            Some((nm, value)) => Ok(point(finite(nm)?, finite(value)?)),
            None => Err(format!("expected wavelength:value, found {}", quoted(w))),
        })
        .collect()
}

/// Returns the reflectance at one wavelength.
pub(super) fn point(nm: f32, reflectance: f32) -> SpectrumPoint {
    SpectrumPoint {
        nm,
        reflectance,
        specular_reflectance: None,
    }
}

/// Returns three numbers, or one number three times.
pub(super) fn triple(n: &[f64]) -> Result<[f64; 3], String> {
    match *n {
        [x] => Ok([x; 3]),
        [x, y, z] => Ok([x, y, z]),
        _ => Err(format!("expected 1 or 3 numbers, found {}", n.len())),
    }
}
