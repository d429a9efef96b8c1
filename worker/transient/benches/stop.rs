//! Whether the error that a render states, and stops by, is its true one, on scenes that are hard to sample:
//! `cargo bench -p picofarm-transient --bench stop [SCENE [SEEDS [PIXELS]]]`.

#[path = "../tests/common/mod.rs"]
#[allow(unused, reason = "a bench uses its own part")]
mod common;
#[path = "stop/scenes.rs"]
mod scenes;

use common::{Quiet, settings};
use picofarm_scene::Scene;
use picofarm_transient::{Budget, Rendered, Settings, render};

const BINS: usize = 637;

/// CPU seconds of this process so far (Linux), so that other work on the machine does not count.
fn cpu_seconds() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").expect("the bench runs on Linux");
    let fields: Vec<&str> = stat.rsplit(')').next().unwrap_or("").split(' ').collect();
    let ticks = |k: usize| fields[k].parse::<f64>().unwrap_or(0.0);
    (ticks(12) + ticks(13)) / 100.0
}

fn run(scene: &Scene, budget: Budget, seed: u64) -> Rendered {
    let set = Settings {
        seed,
        split: false,
        ..settings(budget)
    };
    render(scene, &set, &Quiet).expect("the scene is sound")
}

/// A mean of renders, and its own squared error by pixel.
struct Truth {
    mean: Vec<f64>,
    noise: Vec<f64>,
}

fn truth(scene: &Scene, passes: u32) -> Truth {
    const RUNS: u64 = 8;
    let all: Vec<Rendered> = (0..RUNS)
        .map(|k| run(scene, Budget::Samples(passes / RUNS as u32), 1_000_000 + k))
        .collect();
    let n = RUNS as f64;
    let bins = all[0].transient.len();
    let at = |i: usize| all.iter().map(move |r| f64::from(r.transient[i]));
    let mean: Vec<f64> = (0..bins).map(|i| at(i).sum::<f64>() / n).collect();
    let spread = |i: usize| at(i).map(|x| (x - mean[i]).powi(2)).sum::<f64>() / (n * (n - 1.0));
    let noise = (0..bins / BINS)
        .map(|p| (p * BINS..(p + 1) * BINS).map(spread).sum())
        .collect();
    Truth { mean, noise }
}

/// Median over pixels of ‖h − r‖ / ‖r‖, and the quadratic mean, the truth's own noise taken off.
fn deviation(h: &[f32], t: &Truth) -> (f64, f64) {
    let mut all: Vec<f64> = h
        .chunks(BINS)
        .zip(t.mean.chunks(BINS))
        .zip(&t.noise)
        .filter_map(|((h, r), noise)| {
            let pairs = h.iter().zip(r);
            let d2: f64 = pairs.map(|(&h, r)| (f64::from(h) - r).powi(2)).sum();
            let r2: f64 = r.iter().map(|r| r * r).sum();
            (r2 > 0.0).then(|| ((d2 - noise).max(0.0) / r2).sqrt())
        })
        .collect();
    all.sort_by(f64::total_cmp);
    let mean = all.iter().map(|x| x * x).sum::<f64>() / all.len() as f64;
    (all[all.len() / 2], mean.sqrt())
}

fn main() {
    let args: Vec<String> = std::env::args()
        .skip(1)
        .filter(|a| a != "--bench")
        .collect();
    let number = |k: usize, or: u32| args.get(k).and_then(|a| a.parse().ok()).unwrap_or(or);
    let (seeds, pixels) = (number(1, 10), number(2, 24));
    for (name, scene) in scenes::all(pixels) {
        if args
            .first()
            .is_some_and(|a| a != "all" && !name.contains(a.as_str()))
        {
            continue;
        }
        let first = run(&scene, Budget::Error(0.1), 0);
        println!("{name}: {} paths at first", first.error.samples);
        for line in first
            .plan
            .strategies
            .iter()
            .chain(&first.plan.approximations)
        {
            println!("    {line}");
        }
        for line in &first.warnings {
            println!("    warning: {line}");
        }
        let truth = truth(&scene, (24 * first.error.samples).clamp(1024, 32768));
        let noise = truth.noise.iter().zip(truth.mean.chunks(BINS));
        let mut noise: Vec<f64> = noise
            .map(|(n, r)| (n / r.iter().map(|r| r * r).sum::<f64>()).sqrt())
            .collect();
        noise.sort_by(f64::total_cmp);
        println!(
            "    truth: median noise {:.2} %",
            100.0 * noise[noise.len() / 2]
        );
        for passes in [8, 32, 128] {
            let (mut says, mut is, mut rms) = (0.0, 0.0, 0.0);
            for seed in 0..4u32 {
                let r = run(&scene, Budget::Samples(passes), u64::from(seed));
                let (median, mean) = deviation(&r.transient, &truth);
                says += 25.0 * f64::from(r.error.median_relative);
                is += 25.0 * median;
                rms += 25.0 * mean;
            }
            println!(
                "    {passes} paths: says {says:.2} %, is {is:.2} %, rms over pixels {rms:.2} %"
            );
        }
        let mut found = vec![];
        for seed in 0..seeds {
            let before = cpu_seconds();
            let r = run(&scene, Budget::Error(0.1), u64::from(seed));
            let (is, _) = deviation(&r.transient, &truth);
            found.push((
                is,
                f64::from(r.error.median_relative),
                r.error.samples,
                cpu_seconds() - before,
            ));
        }
        found.sort_by(|a, b| a.0.total_cmp(&b.0));
        let n = found.len() as f64;
        let mean = |f: fn(&(f64, f64, u32, f64)) -> f64| found.iter().map(f).sum::<f64>() / n;
        println!(
            "    asked for 10 %: is {:.2} % in the mean ({:.2} to {:.2}), says {:.2} %, {:.0} paths, {:.2} CPU s",
            100.0 * mean(|f| f.0),
            100.0 * found[0].0,
            100.0 * found[found.len() - 1].0,
            100.0 * mean(|f| f.1),
            mean(|f| f64::from(f.2)),
            mean(|f| f.3),
        );
    }
}
