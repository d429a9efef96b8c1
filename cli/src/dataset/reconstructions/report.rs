//! `dataset report`: a page about reconstructions, and its content as JSON.
//!
//! The command belongs to data sets, not to models, because reconstructions are stored like data
//! sets, are named by location, and need no network. `model report` is the counterpart for trained
//! models.

use std::collections::BTreeMap;

use futures::{StreamExt, TryStreamExt, stream};
use picofarm_results::{ReconstructionManifest, Reconstructions, Verdict};
use picofarm_store::StorageError;
use serde::Serialize;
use serde_json::{Value, json};

use super::{CONCURRENCY, FIGURES, figure, metrics, opened, page};
use crate::{
    args::DatasetReport,
    dataset::{failed, predictions::summed},
    error::{CliError, Result},
    output::Output,
    picture::write_atomically,
};

/// Contents of the page and of its JSON file.
#[derive(Debug, Serialize)]
pub(super) struct Report {
    pub title: String,
    /// Date of the report.
    pub date: String,
    /// Groups of reconstructions with equal settings.
    pub groups: Vec<Group>,
    pub published: [Published; 4],
    pub differs: &'static str,
}

/// Reconstructions of a folder with the same settings.
#[derive(Debug, Serialize)]
pub(super) struct Group {
    pub place: String,
    pub settings: Value,
    /// Version of the reconstruction code.
    pub code: String,
    pub scenes: usize,
    pub bytes: u64,
    /// Minimum and maximum number of spots that a scene used.
    pub spots: Option<[u64; 2]>,
    /// Width and height of the measured images, if all are equal.
    pub image: Option<[u64; 2]>,
    /// Figures by their names in `dataset info`.
    pub figures: BTreeMap<&'static str, Spread>,
    /// Whether the group has the published setup: 16 spots, 512 x 512 pixels and PlatoNeRF's room.
    pub as_published: bool,
    pub extremes: Vec<Extreme>,
    /// Combined verdict.
    pub verdict: Option<Verdict>,
}

/// Mean over scenes, and its standard error if there are at least two scenes.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub(super) struct Spread {
    pub mean: f64,
    pub standard_error: Option<f64>,
    pub scenes: usize,
}

/// The best, the median or the worst scene by L1.
#[derive(Debug, Serialize)]
pub(super) struct Extreme {
    pub rank: &'static str,
    pub scene: u64,
    pub l1_m: f64,
    /// Its `views.png`.
    #[serde(skip)]
    pub picture: Vec<u8>,
}

/// A published figure.
#[derive(Debug, Clone, Copy, Serialize)]
pub(super) struct Published {
    pub method: &'static str,
    pub light: &'static str,
    pub l1_m: f64,
}

/// Klinghoffer et al., CVPR 2024: depth L1 of novel views of a chair.
pub(super) const PUBLISHED: [Published; 4] = [
    Published {
        method: "PlatoNeRF",
        light: "no ambient light",
        l1_m: 0.0862,
    },
    Published {
        method: "PlatoNeRF",
        light: "ambient light of level 4",
        l1_m: 0.0794,
    },
    Published {
        method: "S³-NeRF",
        light: "no ambient light",
        l1_m: 0.1178,
    },
    Published {
        method: "S³-NeRF",
        light: "ambient light of level 4",
        l1_m: 0.3080,
    },
];

const DIFFERS: &str = "Published figures are those of PlatoNeRF's paper for its chair. They are not of these conditions: \
    its chair is another one, which pixels its mean covers is not stated, its depth is a mean along the ray and ours the median, \
    and its captures come from another renderer; rows from truth use no captures at all. So they compare in kind, not in digits. \
    A dash stands where the settings are not the paper's: 16 spots, 512 × 512 pixels, its room.";

/// A scene's manifest and metrics.
struct Scene {
    manifest: ReconstructionManifest,
    metrics: Value,
}

/// `dataset report`.
///
/// # Errors
/// Fails if a location has no reconstructions or is damaged, or if the page cannot be written.
pub async fn run(args: &DatasetReport, output: Output) -> Result<()> {
    let mut groups = Vec::new();
    for place in &args.places {
        output.say(format!("reads {place}"));
        groups.extend(collected(place).await?);
    }
    let date = humantime::format_rfc3339_seconds(std::time::SystemTime::now()).to_string();
    let report = Report {
        title: args.title.clone(),
        date: date[..10].to_owned(),
        groups,
        published: PUBLISHED,
        differs: DIFFERS,
    };
    let beside = args.out.with_extension("json");
    if beside == args.out {
        let what = format!("--out {}: is where the JSON goes", args.out.display());
        return Err(CliError::input(what).hint("end the page's name in .html"));
    }
    let mut document = serde_json::to_string_pretty(&report).expect("plain data");
    document.push('\n');
    write_atomically(&args.out, page::html(&report).as_bytes())?;
    write_atomically(&beside, document.as_bytes())?;
    let scenes: usize = report.groups.iter().map(|g| g.scenes).sum();
    let facts = json!({"page": args.out, "json": beside, "scenes": scenes});
    output.result(&facts, || {
        format!(
            "{scenes} scenes: {} and {}",
            args.out.display(),
            beside.display()
        )
    });
    Ok(())
}

/// Collects the figures of a folder.
async fn collected(place: &str) -> Result<Vec<Group>> {
    let there = opened(place).await?;
    let present = there.scenes_present().await.map_err(failed)?;
    if present.is_empty() {
        let what = format!("{place}: no reconstruction is finished yet");
        return Err(CliError::input(what));
    }
    let read = present.iter().map(|&scene| {
        let there = &there;
        async move {
            Ok::<_, CliError>(Scene {
                manifest: there.manifest(scene).await.map_err(failed)?,
                metrics: metrics(place, there, scene).await?,
            })
        }
    });
    let scenes: Vec<Scene> = stream::iter(read)
        .buffered(CONCURRENCY)
        .try_collect()
        .await?;
    // Grouped by the text of their settings, because JSON values have no order.
    let mut alike: BTreeMap<(String, String), Vec<Scene>> = BTreeMap::new();
    for scene in scenes {
        let key = (
            scene.manifest.settings.to_string(),
            scene.manifest.code.clone(),
        );
        alike.entry(key).or_default().push(scene);
    }
    let mut groups = Vec::new();
    for scenes in alike.into_values() {
        groups.push(group(place, &there, &scenes).await?);
    }
    Ok(groups)
}

async fn group(place: &str, there: &Reconstructions, scenes: &[Scene]) -> Result<Group> {
    let first = &scenes[0].manifest;
    let numbers = |way: &str| -> Vec<u64> {
        let found = scenes.iter().map(|s| s.metrics.pointer(way));
        found.filter_map(|v| v.and_then(Value::as_u64)).collect()
    };
    let spots = numbers("/spots");
    let (widths, heights) = (numbers("/image/0"), numbers("/image/1"));
    let same = |of: &[u64]| {
        let all = of.len() == scenes.len() && of.iter().all(|n| *n == of[0]);
        all.then(|| of[0])
    };
    let image = same(&widths).zip(same(&heights)).map(|(w, h)| [w, h]);
    let of_the_paper = |s: &Scene| {
        let source = s.metrics.pointer("/provenance/source");
        source
            .and_then(Value::as_str)
            .is_some_and(|source| source.starts_with("plato-"))
    };
    let figures = FIGURES.iter().filter_map(|(name, way)| {
        let values = scenes.iter().filter_map(|s| figure(&s.metrics, way));
        Some((*name, spread(&values.collect::<Vec<_>>())?))
    });
    Ok(Group {
        place: place.to_owned(),
        settings: first.settings.clone(),
        code: first.code.clone(),
        scenes: scenes.len(),
        bytes: scenes.iter().map(|s| s.manifest.total_bytes()).sum(),
        spots: spots
            .iter()
            .min()
            .zip(spots.iter().max())
            .map(|(a, b)| [*a, *b]),
        as_published: image == Some([512, 512])
            && spots.iter().all(|n| *n == 16)
            && scenes.iter().all(of_the_paper),
        image,
        figures: figures.collect(),
        verdict: summed(
            scenes
                .iter()
                .map(|s| (s.manifest.scene, Verdict::of_reconstruction(&s.metrics))),
        ),
        extremes: extremes(there, scenes).await?,
    })
}

/// Returns mean and standard error; `None` without values.
fn spread(values: &[f64]) -> Option<Spread> {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let squares: f64 = values.iter().map(|v| (v - mean) * (v - mean)).sum();
    (!values.is_empty()).then(|| Spread {
        mean,
        standard_error: (values.len() > 1).then(|| (squares / (n - 1.0) / n).sqrt()),
        scenes: values.len(),
    })
}

/// Returns the best, median and worst scene, each once.
async fn extremes(there: &Reconstructions, scenes: &[Scene]) -> Result<Vec<Extreme>> {
    let mut ranked: Vec<(f64, u64)> = scenes
        .iter()
        .filter_map(|s| {
            Some((
                figure(&s.metrics, "/novel_views/all/l1_m")?,
                s.manifest.scene,
            ))
        })
        .collect();
    ranked.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    let last = ranked.len().saturating_sub(1);
    let named: &[(&str, usize)] = match ranked.len() {
        0 => &[],
        1 => &[("only", 0)],
        2 => &[("best", 0), ("worst", last)],
        n => &[("best", 0), ("median", n / 2), ("worst", last)],
    };
    let mut extremes = Vec::new();
    for &(rank, at) in named {
        let (l1_m, scene) = ranked[at];
        let picture = match there.read(scene, "views.png").await {
            Ok(bytes) => bytes.to_vec(),
            Err(StorageError::NotPublished { .. }) => Vec::new(),
            Err(e) => return Err(failed(e)),
        };
        extremes.push(Extreme {
            rank,
            scene,
            l1_m,
            picture,
        });
    }
    Ok(extremes)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mean_has_a_standard_error_from_two_scenes_on() {
        assert_eq!(spread(&[]), None);
        let one = spread(&[0.3]).unwrap();
        assert_eq!((one.mean, one.standard_error, one.scenes), (0.3, None, 1));
        // Standard deviation 1, of four values: a standard error of one half.
        let four = spread(&[0.0, 0.0, 1.5, 1.5]).unwrap();
        let error = four.standard_error.unwrap();
        assert!((four.mean - 0.75).abs() < 1e-12 && (error - 0.75f64.sqrt() / 2.0).abs() < 1e-12);
    }
}
