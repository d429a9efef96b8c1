//! Measures one scene: a ladder of budgets against a reference, and a check of the stopping rule.

use picofarm_scene::Scene;
use picofarm_transient::{Budget, Gate, Settings};
use serde::Serialize;
use tokio_util::sync::CancellationToken;

use crate::args::{
    Render as RenderArgs,
    strategies::{Variant, variants},
};
use picofarm_cli::{error::Result, output::Output};

use super::{
    curve::{Crossing, crossing},
    deviation::{Deviation, Truth},
    measure::{Bench, Measured, settings},
    peer::{Peer, PeerRung},
    truth,
};

/// Maximum noise of the reference, as a fraction of the smallest error measured with it. Above
/// this, a warning is printed.
const QUIET: f64 = 0.5;
/// The stopping rule passes if the true error is at most this factor times the target.
const SLACK: f64 = 1.1;

/// Results for one scene.
#[derive(Debug, Serialize)]
pub struct Outcome {
    pub scene: String,
    pub width: u32,
    pub height: u32,
    pub bins: u32,
    pub spots: usize,
    pub triangles: usize,
    pub threads: usize,
    /// Origin of the reference.
    pub truth: String,
    /// Median over pixels of the reference's own relative noise.
    pub truth_noise: f64,
    pub variants: Vec<Curve>,
    pub stopping: Stopping,
    pub peers: Vec<PeerCurve>,
    pub warnings: Vec<String>,
}

/// Error over time for one way to render.
#[derive(Debug, Serialize)]
pub struct Curve {
    pub name: String,
    pub rungs: Vec<Rung>,
    pub to: Vec<Target>,
    /// The renderer's decisions, in its own words.
    pub plan: Vec<String>,
}

/// One budget, averaged over the seeds.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Rung {
    /// Camera paths per pixel.
    pub samples: u32,
    pub cpu_s: f64,
    pub wall_s: f64,
    pub rays: u64,
    /// The measured error.
    pub error: Deviation,
    /// The renderer's own estimate of the median error.
    pub claimed: f64,
}

/// The time to one error.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Target {
    pub error: f64,
    pub at: Option<Crossing>,
}

/// A render with a target error, with the settings of the first variant.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Stopping {
    pub target: f64,
    pub rung: Rung,
    /// Whether the true error exceeds the target by at most a tenth.
    pub holds: bool,
}

/// Another tool's curve for the same scene at the same size.
#[derive(Debug, Serialize)]
pub struct PeerCurve {
    pub name: String,
    pub rungs: Vec<PeerRung>,
    pub to: Vec<Target>,
    /// Ratio of its time to the first variant's, for each target.
    pub ratio: Vec<Option<f64>>,
}

impl Curve {
    /// Returns (CPU seconds, error) of its rungs.
    pub fn points(&self) -> Vec<(f64, f64)> {
        self.rungs
            .iter()
            .map(|r| (r.cpu_s, r.error.median))
            .collect()
    }
}

impl PeerCurve {
    /// Returns (CPU seconds, error) of its rungs.
    pub fn points(&self) -> Vec<(f64, f64)> {
        self.rungs
            .iter()
            .map(|r| (r.cpu_seconds, r.error))
            .collect()
    }
}

/// Measures one scene.
///
/// # Errors
/// Fails if the renderer rejects the scene, a stored reference is unsuitable, or on an
/// interruption.
pub fn run(
    scene: &Scene,
    args: &RenderArgs,
    peers: &[Peer],
    output: Output,
    stop: &CancellationToken,
) -> Result<Outcome> {
    let bench = Bench::new(Some(args.threads), output, stop)?;
    let target = args.error[0];
    let what = format!("{}: until {} %", scene.name, target * 100.0);
    let ways = variants(&args.strategies);
    let until = Settings {
        strategy: ways[0].strategy,
        ..settings(args, Budget::Error(target), 1)
    };
    let until = bench.render(scene, &until, &what)?;
    let truth = match &args.truth {
        Some(dir) => truth::read(dir, scene, gate(args))?,
        None => {
            let samples = truth_samples(args, until.rendered.error.samples);
            let all_cores = Bench::new(None, output, stop)?;
            truth::render(scene, args, samples, &all_cores)?
        }
    };
    let variants = ways
        .iter()
        .map(|v| climb(v, scene, args, &truth, &bench))
        .collect::<Result<Vec<_>>>()?;
    let rung = compare(&until, &truth);
    let stopping = Stopping {
        target,
        rung,
        holds: rung.error.median <= SLACK * target,
    };

    let i = &scene.camera.intrinsics;
    let same = |size: (u32, u32, u32)| size == (i.width, i.height, args.gate.bins);
    let peers = peers
        .iter()
        .flat_map(|p| p.runs.iter().map(move |r| (p, r)))
        .filter(|(_, r)| r.scene == scene.name && same((r.width, r.height, r.bins)))
        .map(|(p, r)| beside(format!("{} {}", p.tool, r.mode), &r.rungs, &variants[0].to))
        .collect();
    let mut outcome = Outcome {
        scene: scene.name.clone(),
        width: i.width,
        height: i.height,
        bins: args.gate.bins,
        spots: scene.laser.beams.len(),
        triangles: scene.triangle_count(),
        threads: args.threads.max(1),
        truth_noise: truth.median_noise(),
        truth: truth.source,
        variants,
        stopping,
        peers,
        warnings: vec![],
    };
    outcome.warnings = warnings(&outcome);
    Ok(outcome)
}

/// Returns a number of samples for which the reference's noise is negligible in the largest rung
/// and in the render with a stopping rule.
fn truth_samples(args: &RenderArgs, until: u32) -> u32 {
    let largest = args.ladder.iter().copied().max().unwrap_or(1);
    args.truth_samples
        .unwrap_or_else(|| largest.saturating_mul(16).max(until.saturating_mul(8)))
}

fn gate(args: &RenderArgs) -> Gate {
    settings(args, Budget::Samples(1), 0).gate
}

/// Measures the ladder of one variant.
fn climb(
    variant: &Variant,
    scene: &Scene,
    args: &RenderArgs,
    truth: &Truth,
    bench: &Bench<'_>,
) -> Result<Curve> {
    let (mut rungs, mut plan) = (vec![], vec![]);
    for &samples in &args.ladder {
        let mut each = Vec::new();
        for seed in 1..=args.seeds {
            let settings = Settings {
                strategy: variant.strategy,
                ..settings(args, Budget::Samples(samples), seed)
            };
            let what = format!("{}: {}, {samples} paths a pixel", scene.name, variant.name);
            let measured = bench.render(scene, &settings, &what)?;
            each.push(compare(&measured, truth));
            plan = measured.rendered.plan.strategies;
        }
        rungs.push(average(&each));
    }
    let points: Vec<_> = rungs.iter().map(|r| (r.cpu_s, r.error.median)).collect();
    Ok(Curve {
        name: variant.name.clone(),
        to: targets(&points, &args.error),
        rungs,
        plan,
    })
}

/// Compares a render with the reference.
fn compare(measured: &Measured, truth: &Truth) -> Rung {
    let r = &measured.rendered;
    Rung {
        samples: r.error.samples,
        cpu_s: measured.cpu_s,
        wall_s: measured.wall_s,
        rays: r.rays,
        error: truth.deviation(&r.transient),
        claimed: f64::from(r.error.median_relative),
    }
}

fn average(rungs: &[Rung]) -> Rung {
    let n = rungs.len() as f64;
    let mean = |f: fn(&Rung) -> f64| rungs.iter().map(f).sum::<f64>() / n;
    Rung {
        samples: rungs[0].samples,
        cpu_s: mean(|r| r.cpu_s),
        wall_s: mean(|r| r.wall_s),
        rays: rungs.iter().map(|r| r.rays).sum::<u64>() / rungs.len() as u64,
        error: Deviation {
            median: mean(|r| r.error.median),
            rmse: mean(|r| r.error.rmse),
            energy_ratio: mean(|r| r.error.energy_ratio),
        },
        claimed: mean(|r| r.claimed),
    }
}

fn targets(points: &[(f64, f64)], errors: &[f64]) -> Vec<Target> {
    errors
        .iter()
        .map(|&error| Target {
            error,
            at: crossing(points, error),
        })
        .collect()
}

fn beside(name: String, rungs: &[PeerRung], ours: &[Target]) -> PeerCurve {
    let points: Vec<_> = rungs.iter().map(|r| (r.cpu_seconds, r.error)).collect();
    let to = targets(&points, &ours.iter().map(|t| t.error).collect::<Vec<_>>());
    let ratio = to
        .iter()
        .zip(ours)
        .map(|(theirs, ours)| Some(theirs.at?.cpu_s / ours.at?.cpu_s))
        .collect();
    PeerCurve {
        name,
        rungs: rungs.to_vec(),
        to,
        ratio,
    }
}

fn warnings(found: &Outcome) -> Vec<String> {
    let rungs = found.variants.iter().flat_map(|v| &v.rungs);
    let smallest = rungs
        .chain([&found.stopping.rung])
        .map(|r| r.error.median)
        .fold(f64::INFINITY, f64::min);
    let mut warnings = vec![];
    if found.truth_noise > QUIET * smallest {
        warnings.push(format!(
            "the truth's own noise ({:.2} %) is large beside the smallest error ({:.2} %): take a better one",
            100.0 * found.truth_noise,
            100.0 * smallest,
        ));
    }
    if !found.stopping.holds {
        warnings.push(format!(
            "asked for {:.1} %, the true error is {:.1} %, claimed {:.1} %",
            100.0 * found.stopping.target,
            100.0 * found.stopping.rung.error.median,
            100.0 * found.stopping.rung.claimed,
        ));
    }
    warnings
}
