//! The shapes a job is written in (TOML file, stored JSON): every field known, every other one refused.
//! They become the model types by `TryFrom`, whose errors name the field.

use std::collections::BTreeMap;

use picofarm_settings::{Budget, Choice, Strategy};
use serde::Deserialize;

use super::{
    kinds::render::{RenderSettings, SceneFile, SceneKind, SceneSource},
    spec_error::SpecError,
};
use crate::show;

/// The kinds of scenes.
const KINDS: [&str; 3] = ["furnished", "primitive", "files"];

/// `[scenes]`.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct SceneSourceText {
    kind: String,
    assets: Option<String>,
    min_specular: Option<u32>,
    files: Option<Vec<SceneFile>>,
    root: Option<String>,
    /// Only in a lease.
    #[serde(default)]
    first: u64,
    count: Option<u64>,
    #[serde(default)]
    seed: u64,
    fov_deg: Option<f64>,
    spots: Option<u32>,
}

impl TryFrom<SceneSourceText> for SceneSource {
    type Error = SpecError;

    fn try_from(text: SceneSourceText) -> Result<Self, SpecError> {
        // First: of a kind that is unknown, fields cannot be said to belong to another.
        if !KINDS.contains(&&*text.kind) {
            return Err(SpecError::new(
                "scenes.kind",
                show::unknown(&text.kind, &KINDS),
            ));
        }
        let only = |field: &str, kind: &str, given: bool| {
            if given && text.kind != kind {
                Err(SpecError::new(
                    format!("scenes.{field}"),
                    format!(
                        "belongs to kind = \"{kind}\"; remove it from kind = {:?}",
                        text.kind
                    ),
                ))
            } else {
                Ok(())
            }
        };
        only("assets", "furnished", text.assets.is_some())?;
        only("min_specular", "furnished", text.min_specular.is_some())?;
        only("files", "files", text.files.is_some())?;
        only("root", "files", text.root.is_some())?;
        only("first", "files", text.first != 0)?;
        let mut count = text.count;
        let kind = match text.kind.as_str() {
            "furnished" => SceneKind::Furnished {
                assets: text.assets.unwrap_or_else(|| "auto".into()),
                min_specular: text.min_specular.unwrap_or(1),
            },
            "primitive" => SceneKind::Primitive,
            _ => {
                let files = text.files.unwrap_or_default();
                count = count.or(Some(files.len() as u64));
                SceneKind::Files {
                    files,
                    first: text.first,
                    root: text.root,
                }
            }
        };
        Ok(SceneSource {
            kind,
            count: count
                .ok_or_else(|| SpecError::new("scenes.count", "is missing; say how many scenes"))?,
            seed: text.seed,
            fov_deg: text.fov_deg.unwrap_or(90.0),
            spots: text.spots.unwrap_or(25),
        })
    }
}

/// `[render]`.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct RenderSettingsText {
    resolution: Option<u32>,
    gate_start_m: Option<f64>,
    bin_width_m: Option<f64>,
    bins: Option<u32>,
    samples: Option<u32>,
    error: Option<Share>,
    max_bounces: Option<u32>,
    renderer: Option<String>,
    #[serde(default)]
    subsets: Vec<u32>,
    #[serde(default)]
    per_spot: bool,
    #[serde(default)]
    strategy: BTreeMap<String, Choice>,
}

#[derive(Deserialize)]
#[serde(untagged)]
enum Share {
    Number(f64),
    Text(String),
}

/// Reads "10%" or "0.1" as 0.1.
///
/// # Errors
/// A message that says what was expected.
pub fn parse_share(text: &str) -> Result<f64, String> {
    let (number, scale) = match text.trim().strip_suffix('%') {
        Some(percent) => (percent, 0.01),
        None => (text.trim(), 1.0),
    };
    let value = number.trim().parse::<f64>();
    let value = value.map_err(|_| format!("{text:?} is not a share; write \"10%\" or 0.1"))?;
    let share = value * scale;
    check_share(share).map(|()| share)
}

/// Checks the error that a render is to reach: an error of the whole is no error, and nothing reaches one of nothing.
///
/// # Errors
/// A message that says what was expected.
pub(super) fn check_share(share: f64) -> Result<(), String> {
    if (1e-6..1.0).contains(&share) {
        return Ok(());
    }
    let meant = match share {
        1.0..=100.0 => format!("; did you mean \"{share}%\"?"),
        _ => String::new(),
    };
    Err(format!(
        "{share} is {} %, and lies outside 0.0001 %..100 %; write \"10%\" or 0.1{meant}",
        share * 100.0
    ))
}

impl TryFrom<RenderSettingsText> for RenderSettings {
    type Error = SpecError;

    fn try_from(text: RenderSettingsText) -> Result<Self, SpecError> {
        let default = RenderSettings::default();
        let budget = match (text.samples, text.error) {
            (Some(_), Some(_)) => {
                return Err(SpecError::new(
                    "render.error",
                    "samples and error exclude each other; keep one",
                ));
            }
            (Some(n), None) => Budget::Samples(n),
            (None, Some(Share::Number(e))) => Budget::Error(e),
            (None, Some(Share::Text(e))) => {
                Budget::Error(parse_share(&e).map_err(|m| SpecError::new("render.error", m))?)
            }
            (None, None) => default.budget,
        };
        let mut strategy = Strategy::default();
        for (name, choice) in text.strategy {
            strategy
                .choose(&name, choice)
                .map_err(|what| SpecError::new("render.strategy", what))?;
        }
        // The order in which somebody names them shall not make other results of them.
        let mut subsets = text.subsets;
        subsets.sort_unstable();
        Ok(RenderSettings {
            resolution: text.resolution.unwrap_or(default.resolution),
            gate_start_m: text.gate_start_m.unwrap_or(default.gate_start_m),
            bin_width_m: text.bin_width_m.unwrap_or(default.bin_width_m),
            bins: text.bins.unwrap_or(default.bins),
            budget,
            max_bounces: text.max_bounces.unwrap_or(default.max_bounces),
            renderer: text.renderer.unwrap_or_default(),
            subsets,
            per_spot: text.per_spot,
            strategy,
        })
    }
}
