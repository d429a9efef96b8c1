//! The reference of a benchmark: two independent converged renders, or a stored one.

use std::{path::Path, sync::Arc};

use picofarm_scene::Scene;
use picofarm_transient::{Budget, Gate};
use zarrs::{array::Array, filesystem::FilesystemStore, group::Group};

use crate::args::Render as RenderArgs;
use picofarm_cli::error::{CliError, Result};

use super::{
    deviation::Truth,
    measure::{Bench, settings},
};

/// Seeds of the two halves, far from those of the rungs.
const SEEDS: [u64; 2] = [0x7472_7574_6800, 0x7472_7574_6801];

/// Renders two halves of the reference. Half their difference is its noise, whatever its nature.
///
/// # Errors
/// As [`Bench::render`].
pub fn render(scene: &Scene, args: &RenderArgs, samples: u32, bench: &Bench<'_>) -> Result<Truth> {
    let each = samples.div_ceil(2);
    let half = |k: usize| -> Result<Vec<f32>> {
        let what = format!("{}: truth, {} of 2", scene.name, k + 1);
        let settings = settings(args, Budget::Samples(each), SEEDS[k]);
        Ok(bench.render(scene, &settings, &what)?.rendered.transient)
    };
    let (mut value, other) = (half(0)?, half(1)?);
    let bins = args.gate.bins as usize;
    let noise = value
        .chunks_exact(bins)
        .zip(other.chunks_exact(bins))
        .map(|(a, b)| {
            let square = |(a, b): (&f32, &f32)| (f64::from(*a) - f64::from(*b)).powi(2);
            a.iter().zip(b).map(square).sum::<f64>() / 4.0
        })
        .collect();
    for (a, b) in value.iter_mut().zip(&other) {
        *a = 0.5 * (*a + *b);
    }
    Ok(Truth {
        bins,
        value,
        noise,
        source: format!("2 x {each} paths a pixel, independent seeds"),
    })
}

/// Reads the parts `two` and `multi` and their standard errors from a folder written by
/// `picofarm scene render --split`.
///
/// # Errors
/// Fails if the folder has another format, image size or gate.
pub fn read(dir: &Path, scene: &Scene, gate: Gate) -> Result<Truth> {
    let bad = |what: String| {
        CliError::input(format!("--truth {}: {what}", dir.display())).hint(
            "write it with `picofarm scene render SCENE --split --resolution N --out DIR`, same gate",
        )
    };
    let store = FilesystemStore::new(dir.join("render")).map_err(|e| bad(e.to_string()))?;
    let store = Arc::new(store);
    let group = Group::open(store.clone(), "/").map_err(|e| bad(e.to_string()))?;
    let stored = group.attributes().get("gate").cloned();
    let stored = stored.and_then(|g| serde_json::from_value::<Gate>(g).ok());
    if stored != Some(gate) {
        return Err(bad(format!("expected the gate {gate:?}, found {stored:?}")));
    }
    let i = &scene.camera.intrinsics;
    let expected = [
        u64::from(i.height),
        u64::from(i.width),
        u64::from(gate.bins),
    ];
    let array = |name: &str| -> Result<Vec<f32>> {
        let array = Array::open(store.clone(), &format!("/{name}"))
            .map_err(|e| bad(format!("array {name}: {e}")))?;
        if array.shape() != expected {
            return Err(bad(format!(
                "array {name}: expected the shape {expected:?}, found {:?}",
                array.shape()
            )));
        }
        array
            .retrieve_array_subset(&array.subset_all())
            .map_err(|e| bad(format!("array {name}: {e}")))
    };
    let mut value = array("two")?;
    for (v, m) in value.iter_mut().zip(array("multi")?) {
        *v += m;
    }
    let bins = gate.bins as usize;
    let mut noise = vec![0.0; value.len() / bins];
    for name in ["two_se", "multi_se"] {
        for (n, se) in noise.iter_mut().zip(array(name)?.chunks_exact(bins)) {
            *n += se.iter().map(|&s| f64::from(s).powi(2)).sum::<f64>();
        }
    }
    Ok(Truth {
        bins,
        value,
        noise,
        source: dir.display().to_string(),
    })
}
