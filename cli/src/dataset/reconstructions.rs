//! `dataset info` of reconstructions: the means of their errors.

use futures::{StreamExt, TryStreamExt, stream};
use picofarm_dataset::{DatasetError, Reconstructions, open_store};
use serde_json::{Map, Value, json};

use super::failed;
use crate::{error::Result, output::Output};

/// Requests in flight.
const CONCURRENCY: usize = 16;

/// Figures of `metrics.json` of which means are given: a name, and the way to it.
const FIGURES: [(&str, &str); 11] = [
    ("l1_m", "/novel_views/all/l1_m"),
    ("rmse_m", "/novel_views/all/rmse_m"),
    ("psnr_db", "/novel_views/psnr_db"),
    ("visible_l1_m", "/novel_views/visible/l1_m"),
    ("occluded_l1_m", "/novel_views/occluded/l1_m"),
    ("outside_l1_m", "/novel_views/outside/l1_m"),
    ("specular_l1_m", "/novel_views/specular/l1_m"),
    ("chamfer_m", "/mesh/chamfer_m"),
    ("f_score", "/mesh/f_score"),
    ("floaters_m3", "/floaters/volume_m3"),
    ("spots", "/spots"),
];

/// The reconstructions at a place, if there are any.
pub async fn find(place: &str) -> Result<Option<Reconstructions>> {
    let (store, prefix) = open_store(place).map_err(failed)?;
    match Reconstructions::open(store, prefix).await {
        Ok(there) => Ok(Some(there)),
        Err(error @ DatasetError::Store { .. }) => Err(failed(error)),
        // What else may lie there is not for this to say.
        Err(_) => Ok(None),
    }
}

/// `dataset info`.
pub async fn info(place: &str, there: &Reconstructions, output: Output) -> Result<()> {
    let scenes = there.scenes_present().await.map_err(failed)?;
    let read = scenes
        .iter()
        .map(|scene| there.read(*scene, "metrics.json"));
    let all: Vec<bytes::Bytes> = stream::iter(read)
        .buffered(CONCURRENCY)
        .try_collect()
        .await
        .map_err(failed)?;
    let all: Vec<Value> = all
        .iter()
        .filter_map(|bytes| serde_json::from_slice(bytes).ok())
        .collect();
    let mut means = Map::new();
    for (name, way) in FIGURES {
        // A class without pixels has no error.
        let empty = |m: &Value| {
            let class = way.rsplit_once('/').map_or("", |(class, _)| class);
            m.pointer(&format!("{class}/pixels")) == Some(&json!(0))
        };
        let of = all.iter().filter(|m| !empty(m));
        let values: Vec<f64> = of
            .filter_map(|m| m.pointer(way).and_then(Value::as_f64))
            .collect();
        if !values.is_empty() {
            let mean = values.iter().sum::<f64>() / values.len() as f64;
            means.insert(name.into(), json!({"mean": mean, "scenes": values.len()}));
        }
    }
    let shown = json!({"reconstructions": place, "scenes": scenes.len(), "means": means});
    output.result(&shown, || {
        let mut text = format!("{place}: reconstructions of {} scenes\n", scenes.len());
        for (name, mean) in &means {
            text += &format!(
                "{name:>14} {:.4}, mean over {}\n",
                mean["mean"].as_f64().unwrap_or_default(),
                mean["scenes"]
            );
        }
        text
    });
    Ok(())
}
