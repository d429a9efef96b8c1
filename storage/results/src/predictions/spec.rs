//! The properties of a group of predictions, and the group's root metadata.

use picofarm_settings::EvidenceForm;
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value, json};

use super::array::PredictedArray;
use super::manifest::FORMAT;
use picofarm_store::StorageError;

/// The predicted quantities and the number of scenes.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PredictionSpec {
    /// Capacity in scenes.
    pub scenes: u64,
    /// Image height in pixels.
    pub height: u32,
    /// Image width in pixels.
    pub width: u32,
    /// Whether depth is predicted.
    pub depth: bool,
    /// Spots of the source with predicted masks, in the order of `lit`; empty = no masks.
    pub spots: Vec<u32>,
    /// Whether mirrors are predicted.
    pub specular: bool,
    /// Whether the confidence of the depth is stored.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub confidence: bool,
    /// The planes of evidence of each spot, if they are stored.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub evidence: Option<EvidenceForm>,
}

/// Returns the `zarr.json` of the group with these arrays.
pub(super) fn root(spec: &PredictionSpec, arrays: &[PredictedArray]) -> Value {
    let arrays = arrays.iter();
    let arrays: Map<String, Value> = arrays
        .map(|array| (array.name.to_owned(), array.metadata(spec.scenes)))
        .collect();
    json!({
        "zarr_format": 3,
        "node_type": "group",
        "attributes": {
            "picofarm": {"predictions": FORMAT, "spec": spec},
            "made_of": "manifests/<scene>.json names the scene and the models",
        },
        "consolidated_metadata": {"kind": "inline", "must_understand": false, "metadata": arrays},
    })
}

/// Returns the first field that must be equal but differs, with both values.
pub(super) fn difference(
    stored: &PredictionSpec,
    asked: &PredictionSpec,
) -> Option<(&'static str, String, String)> {
    let text = |value: &dyn std::fmt::Debug| format!("{value:?}");
    [
        ("height", text(&stored.height), text(&asked.height)),
        ("width", text(&stored.width), text(&asked.width)),
        ("depth", text(&stored.depth), text(&asked.depth)),
        ("spots", text(&stored.spots), text(&asked.spots)),
        ("specular", text(&stored.specular), text(&asked.specular)),
        (
            "confidence",
            text(&stored.confidence),
            text(&asked.confidence),
        ),
        ("evidence", text(&stored.evidence), text(&asked.evidence)),
    ]
    .into_iter()
    .find(|(_, stored, asked)| stored != asked)
}

/// Parses the properties from the root of a group.
pub(super) fn parse_root(bytes: &[u8], object: &str) -> Result<PredictionSpec, StorageError> {
    let root: Value = serde_json::from_slice(bytes).map_err(|e| StorageError::Damaged {
        object: object.to_owned(),
        what: format!("not JSON ({e}), so no Zarr group"),
    })?;
    let ours = &root["attributes"]["picofarm"];
    let other = |what: String| Err(StorageError::invalid(object, what));
    match ours["predictions"].as_u64() {
        Some(format) if format > u64::from(FORMAT) => other(format!(
            "written in format {format}, this program knows formats up to {FORMAT}: use a newer one"
        )),
        Some(_) => serde_json::from_value(ours["spec"].clone()).map_err(|e| StorageError::Damaged {
            object: object.to_owned(),
            what: format!("attributes.picofarm.spec: {e}"),
        }),
        None => other(
            "is a data set or another Zarr group, and not predictions; choose another folder for what models predict".into(),
        ),
    }
}
