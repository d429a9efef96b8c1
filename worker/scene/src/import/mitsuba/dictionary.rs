//! Mitsuba's Python dictionary, written as JSON: `type` keys, and `to_world` as rows of numbers.

use std::{
    collections::BTreeSet,
    fmt,
    path::{Path, PathBuf},
    rc::Rc,
};

use serde::de::{Deserialize, Deserializer, Error as _, MapAccess, SeqAccess, Visitor};

use crate::{SpectrumPoint, import::quoted};

use super::{
    node::{Child, Node, Value, point, triple},
    transform::Matrix,
};

/// Plugins by their tag, which a dictionary does not contain.
const TAGS: [(&str, &[&str]); 6] = [
    (
        "shape",
        &[
            "ply",
            "obj",
            "serialized",
            "rectangle",
            "cube",
            "sphere",
            "disk",
            "cylinder",
            "instance",
            "shapegroup",
        ],
    ),
    (
        "bsdf",
        &[
            "diffuse",
            "roughconductor",
            "conductor",
            "twosided",
            "blendbsdf",
            "thindielectric",
            "dielectric",
            "roughdielectric",
            "plastic",
            "roughplastic",
            "pplastic",
            "principled",
            "principledthin",
            "mask",
            "bumpmap",
            "normalmap",
            "null",
        ],
    ),
    ("sensor", &["perspective", "thinlens", "orthographic"]),
    (
        "emitter",
        &[
            "projector",
            "spot",
            "point",
            "area",
            "constant",
            "envmap",
            "directional",
            "directionalarea",
            "angulararea",
        ],
    ),
    ("texture", &["bitmap", "checkerboard", "mesh_attribute"]),
    (
        "film",
        &[
            "hdrfilm",
            "specfilm",
            "transient_hdr_film",
            "phasor_hdr_film",
        ],
    ),
];
/// Plugins with settings for rendering, which belong to the job.
const SKIPPED: [&str; 25] = [
    "path",
    "direct",
    "volpath",
    "volpathmis",
    "aov",
    "depth",
    "ptracer",
    "prb",
    "stokes",
    "moment",
    "transient_path",
    "transient_volpath",
    "transient_prbvolpath",
    "transient_nlos_path",
    "independent",
    "stratified",
    "multijitter",
    "orthogonal",
    "ldsampler",
    "box",
    "tent",
    "mitchell",
    "catmullrom",
    "lanczos",
    "gaussian",
];

/// The greatest number of letters of a position in the file that errors quote.
const MAX_PLACE: usize = 200;

/// JSON objects that preserve the order of their keys, because the order determines the first BSDF
/// of a blend.
enum Json {
    Null,
    Switch(bool),
    Number(f64),
    Text(String),
    List(Vec<Json>),
    Fields(Vec<(String, Json)>),
}

impl Json {
    fn text(&self) -> Option<&str> {
        match self {
            Json::Text(text) => Some(text),
            _ => None,
        }
    }
}

impl<'de> Deserialize<'de> for Json {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Any;
        impl<'de> Visitor<'de> for Any {
            type Value = Json;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("JSON")
            }

            fn visit_unit<E>(self) -> Result<Json, E> {
                Ok(Json::Null)
            }

            fn visit_bool<E>(self, value: bool) -> Result<Json, E> {
                Ok(Json::Switch(value))
            }

            fn visit_f64<E: serde::de::Error>(self, value: f64) -> Result<Json, E> {
                // All values are finally stored in single precision.
                if (value as f32).is_finite() {
                    Ok(Json::Number(value))
                } else {
                    Err(E::custom("a number is too large"))
                }
            }

            fn visit_i64<E: serde::de::Error>(self, value: i64) -> Result<Json, E> {
                self.visit_f64(value as f64)
            }

            fn visit_u64<E: serde::de::Error>(self, value: u64) -> Result<Json, E> {
                self.visit_f64(value as f64)
            }

            fn visit_str<E>(self, value: &str) -> Result<Json, E> {
                Ok(Json::Text(value.to_owned()))
            }

            fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<Json, A::Error> {
                let mut all = Vec::new();
                while let Some(item) = items.next_element()? {
                    all.push(item);
                }
                Ok(Json::List(all))
            }

            fn visit_map<A: MapAccess<'de>>(self, mut fields: A) -> Result<Json, A::Error> {
                let (mut all, mut known) = (Vec::new(), BTreeSet::new());
                while let Some((key, value)) = fields.next_entry::<String, Json>()? {
                    if !known.insert(key.clone()) {
                        return Err(A::Error::custom(format!(
                            "key {} is stated twice",
                            quoted(&key)
                        )));
                    }
                    all.push((key, value));
                }
                Ok(Json::Fields(all))
            }
        }
        deserializer.deserialize_any(Any)
    }
}

fn field<'a>(fields: &'a [(String, Json)], key: &str) -> Option<&'a Json> {
    fields.iter().find(|(k, _)| k == key).map(|(_, v)| v)
}

/// Returns the scene's node of a dictionary.
pub(super) fn parse(bytes: &[u8], path: &Path) -> Result<Node, String> {
    let json = serde_json::from_slice(bytes).map_err(|e| e.to_string())?;
    let Json::Fields(root) = json else {
        return Err("expected a dictionary".into());
    };
    let folders = Rc::new(vec![path.parent().unwrap_or(Path::new("")).to_owned()]);
    node(&root, "scene", "scene", &folders)?.ok_or_else(|| "the scene is empty".into())
}

/// Returns a plugin, or `None` for irrelevant ones.
fn node(
    json: &[(String, Json)],
    key: &str,
    at: &str,
    folders: &Rc<Vec<PathBuf>>,
) -> Result<Option<Node>, String> {
    let Some(kind) = field(json, "type").and_then(Json::text) else {
        return Err(format!("{at}: needs the key \"type\" (text)"));
    };
    if SKIPPED.contains(&kind) || matches!(key, "integrator" | "sampler" | "rfilter") {
        return Ok(None);
    }
    let at = &shortened(at);
    let tag = TAGS.iter().find(|(_, kinds)| kinds.contains(&kind));
    let mut out = Node {
        tag: tag.map_or("", |(tag, _)| tag).to_owned(),
        kind: kind.to_owned(),
        id: field(json, "id")
            .and_then(Json::text)
            .unwrap_or(key)
            .to_owned(),
        at: format!("{at} (type {})", quoted(kind)),
        folders: folders.clone(),
        ..Node::default()
    };
    for (name, value) in json {
        let inner = format!("{at}.{name}");
        let wrong = |expected: &str| format!("{inner}: expected {expected}");
        let value = match value {
            _ if name == "type" || name == "id" => continue,
            Json::Switch(b) => Value::Switch(*b),
            Json::Number(n) => Value::Number(*n),
            Json::Text(s) => Value::Text(s.clone()),
            Json::List(items) => array(items).map_err(|e| format!("{inner}: {e}"))?,
            Json::Fields(fields) => match field(fields, "type").and_then(Json::text) {
                Some("ref") => {
                    let id = field(fields, "id").and_then(Json::text);
                    let id = id.ok_or_else(|| wrong("{\"type\": \"ref\", \"id\": …}"))?;
                    out.children
                        .push((name.clone(), Child::Reference(id.to_owned())));
                    continue;
                }
                Some("spectrum") if by_wavelength(fields) => {
                    let value = field(fields, "value").unwrap_or(&Json::Null);
                    Value::Spectrum(pairs(value).map_err(|e| format!("{inner}: {e}"))?)
                }
                Some("rgb" | "spectrum" | "srgb" | "uniform") => {
                    let value = field(fields, "value").unwrap_or(&Json::Null);
                    let colour = flat(value).and_then(|n| triple(&n));
                    Value::Colour(
                        colour
                            .map_err(|e| format!("{inner}: {e}"))?
                            .map(|x| x as f32),
                    )
                }
                _ => {
                    match node(fields, name, &inner, folders)? {
                        Some(child) => out
                            .children
                            .push((name.clone(), Child::Node(Rc::new(child)))),
                        None => out.skipped.push("integrator".into()),
                    }
                    continue;
                }
            },
            Json::Null => return Err(wrong("a value, found null")),
        };
        out.set(name.clone(), value, inner)?;
    }
    Ok(Some(out))
}

/// Shortens the path of keys to a value, which a hostile file can make long.
fn shortened(at: &str) -> String {
    match at.char_indices().rev().nth(MAX_PLACE) {
        None => at.to_owned(),
        Some((start, _)) => format!("…{}", &at[start..]),
    }
}

/// Returns rows of numbers, or numbers, as one list.
fn flat(json: &Json) -> Result<Vec<f64>, String> {
    const EXPECTED: &str = "expected numbers";
    match json {
        Json::Number(n) => Ok(vec![*n]),
        Json::List(items) => {
            let mut all = Vec::new();
            for item in items {
                all.extend(flat(item)?);
            }
            Ok(all)
        }
        _ => Err(EXPECTED.into()),
    }
}

/// Returns whether a spectrum's value starts with a pair.
fn by_wavelength(fields: &[(String, Json)]) -> bool {
    let Some(Json::List(items)) = field(fields, "value") else {
        return false;
    };
    matches!(items.first(), Some(Json::List(pair)) if pair.len() == 2)
}

/// Parses a list of [wavelength, value].
fn pairs(json: &Json) -> Result<Vec<SpectrumPoint>, String> {
    let Json::List(items) = json else {
        return Err("expected pairs [wavelength, value]".into());
    };
    let pair = |item: &Json| match item {
        Json::List(pair) => match pair[..] {
            [Json::Number(nm), Json::Number(value)] => Ok(point(nm as f32, value as f32)),
            _ => Err("expected pairs [wavelength, value] of numbers".into()),
        },
        _ => Err("expected pairs [wavelength, value] alone".into()),
    };
    items.iter().map(pair).collect()
}

fn array(items: &[Json]) -> Result<Value, String> {
    let all = items
        .iter()
        .map(flat)
        .collect::<Result<Vec<_>, _>>()?
        .concat();
    match all.len() {
        3 => triple(&all).map(Value::Vector),
        9 | 16 => Matrix::from_numbers(&all).map(Value::Transform),
        n => Err(format!(
            "expected 3 numbers or a 4x4 matrix, found {n} numbers"
        )),
    }
}
