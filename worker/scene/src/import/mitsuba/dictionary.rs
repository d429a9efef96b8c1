//! Mitsuba's Python dictionary, written as JSON: `type` keys, `to_world` as rows of numbers.

use std::rc::Rc;

use serde_json::{Map, Value as Json};

use super::{
    node::{Child, Node, Value, triple},
    transform::Matrix,
};

/// Plugins by what they are; a dictionary does not say.
const TAGS: [(&str, &[&str]); 6] = [
    (
        "shape",
        &["ply", "obj", "rectangle", "cube", "sphere", "disk"],
    ),
    (
        "bsdf",
        &[
            "diffuse",
            "roughconductor",
            "conductor",
            "twosided",
            "blendbsdf",
        ],
    ),
    ("sensor", &["perspective"]),
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
    ("texture", &["bitmap"]),
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
/// What says how to render, which is the job's business.
const SKIPPED: [&str; 21] = [
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
    "gaussian",
];

/// The scene's node of a dictionary.
pub(super) fn parse(json: &Json) -> Result<Node, String> {
    let Some(root) = json.as_object() else {
        return Err("expected a dictionary".into());
    };
    node(root, "scene", "scene")?.ok_or_else(|| "the scene is empty".into())
}

/// A plugin; `None` for those that are none of our business.
fn node(json: &Map<String, Json>, key: &str, at: &str) -> Result<Option<Node>, String> {
    let Some(kind) = json.get("type").and_then(Json::as_str) else {
        return Err(format!("{at}: needs the key \"type\" (text)"));
    };
    if SKIPPED.contains(&kind) || matches!(key, "integrator" | "sampler" | "rfilter") {
        return Ok(None);
    }
    let tag = TAGS.iter().find(|(_, kinds)| kinds.contains(&kind));
    let mut out = Node {
        tag: tag.map_or("", |(tag, _)| tag).to_owned(),
        kind: kind.to_owned(),
        id: json
            .get("id")
            .and_then(Json::as_str)
            .unwrap_or(key)
            .to_owned(),
        at: format!("{at} (type {kind:?})"),
        ..Node::default()
    };
    for (name, value) in json {
        let inner = format!("{at}.{name}");
        let wrong = |expected: &str| format!("{inner}: expected {expected}");
        let value = match value {
            _ if name == "type" || name == "id" => continue,
            Json::Bool(b) => Value::Switch(*b),
            Json::Number(n) => Value::Number(finite(n).ok_or_else(|| wrong("a finite number"))?),
            Json::String(s) => Value::Text(s.clone()),
            Json::Array(items) => array(items).map_err(|e| format!("{inner}: {e}"))?,
            Json::Object(fields) => match fields.get("type").and_then(Json::as_str) {
                Some("ref") => {
                    let id = fields.get("id").and_then(Json::as_str);
                    let id = id.ok_or_else(|| wrong("{\"type\": \"ref\", \"id\": …}"))?;
                    out.children
                        .push((name.clone(), Child::Reference(id.to_owned())));
                    continue;
                }
                Some("rgb" | "spectrum" | "srgb" | "uniform") => {
                    let value = fields.get("value").unwrap_or(&Json::Null);
                    let colour = flat(value).and_then(|n| triple(&n));
                    Value::Colour(
                        colour
                            .map_err(|e| format!("{inner}: {e}"))?
                            .map(|x| x as f32),
                    )
                }
                _ => {
                    if let Some(child) = node(fields, name, &inner)? {
                        out.children
                            .push((name.clone(), Child::Node(Rc::new(child))));
                    }
                    continue;
                }
            },
            Json::Null => return Err(wrong("a value, found null")),
        };
        out.parameters.insert(name.clone(), value);
    }
    Ok(Some(out))
}

fn finite(n: &serde_json::Number) -> Option<f64> {
    let x = n.as_f64()? as f32;
    x.is_finite().then(|| f64::from(x))
}

/// Rows of numbers, or numbers, as one list.
fn flat(json: &Json) -> Result<Vec<f64>, String> {
    const EXPECTED: &str = "expected finite numbers";
    match json {
        Json::Number(n) => Ok(vec![finite(n).ok_or(EXPECTED)?]),
        Json::Array(items) => {
            let mut all = Vec::new();
            for item in items {
                all.extend(flat(item)?);
            }
            Ok(all)
        }
        _ => Err(EXPECTED.into()),
    }
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
