//! Compares the error estimate by which a render stops with its true error, on scenes that are hard
//! to sample: `just lab stop [SCENE [SEEDS [PIXELS [ERROR...]]]]`.
//! SCENE is a scene's name, or a part of several scenes' names.
//!
//! ERROR 0 renders fixed numbers of passes and prints the error by pixel and of the whole image,
//! CPU seconds, slope and merit. A negative ERROR prints the share of each path class in the
//! variance. `json` instead of a number prints the scene for `tests/lab/peers`. If `STOP_TRUTHS` is
//! a folder, truths are stored there and reused, so that two versions are compared with the same
//! truth. `STOP_TUNING` is JSON with numbers of [`Tuning`] that differ from the default, such as
//! `{"walk":{"spots":8}}`.
//!
//! `rooms [ROOMS [PIXELS [ERROR [LIBRARY [FOLDER]]]]]` renders furnished rooms of fresh seeds with
//! 25 spots to an error, and prints their cost. Without further arguments: 20 rooms at 256×256 with
//! Sweet Home 3D's furniture to 0.1.

#[path = "../../../../worker/transient/tests/it/common/mod.rs"]
#[allow(unused, reason = "a bench uses its own part")]
mod common;
mod reference;
mod rooms;
#[path = "../../../../worker/transient/tests/it/hard_scenes.rs"]
mod scenes;

use common::{Quiet, settings};
use picofarm_scene::Scene;
use picofarm_transient::{Budget, Rendered, Settings, Tuning, plan, render_tuned, variance};

const BINS: usize = 637;

/// Returns the CPU seconds of this process so far (Linux), so that other work on the machine does
/// not count.
fn cpu_seconds() -> f64 {
    let stat = std::fs::read_to_string("/proc/self/stat").expect("the bench runs on Linux");
    let fields: Vec<&str> = stat.rsplit(')').next().unwrap_or("").split(' ').collect();
    let ticks = |k: usize| fields[k].parse::<f64>().unwrap_or(0.0);
    (ticks(12) + ticks(13)) / 100.0
}

fn render_once(scene: &Scene, budget: Budget, seed: u64) -> Rendered {
    let set = Settings {
        seed,
        split: false,
        ..settings(budget)
    };
    render_tuned(scene, &set, &tuning(), &Quiet).expect("the scene is sound")
}

/// Returns the numbers of `STOP_TUNING`, and the default of all others.
fn tuning() -> Tuning {
    match std::env::var("STOP_TUNING") {
        Ok(json) => serde_json::from_str(&json).expect("STOP_TUNING holds numbers of a Tuning"),
        Err(_) => Tuning::default(),
    }
}

/// A mean of renders, and its own squared error by pixel.
struct Truth {
    mean: Vec<f64>,
    noise: Vec<f64>,
}

fn truth(scene: &Scene, passes: u32) -> Truth {
    const RUNS: u64 = 8;
    let all: Vec<Rendered> = (0..RUNS)
        .map(|k| render_once(scene, Budget::Samples(passes / RUNS as u32), 1_000_000 + k))
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

/// Returns the median and the 95th percentile over pixels of ‖h − r‖ / ‖r‖, without the truth's own
/// noise.
fn deviation(h: &[f32], t: &Truth) -> [f64; 2] {
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
    [all[all.len() / 2], all[all.len() * 19 / 20]]
}

/// Prints the figures of the scenes or rooms that `args` selects.
pub fn run(args: &[String]) {
    let number = |k: usize, or: u32| args.get(k).and_then(|a| a.parse().ok()).unwrap_or(or);
    let (seeds, pixels) = (number(1, 10), number(2, 24));
    let asked = args.iter().skip(3);
    let mut asked: Vec<f64> = asked.filter_map(|a| a.parse().ok()).collect();
    if asked.is_empty() {
        asked.push(0.1);
    }
    if args.first().is_some_and(|a| a == "rooms") {
        let library = args.get(4).map_or("sweethome3d", String::as_str);
        let size = (number(1, 20), number(2, 256));
        rooms::run(library, args.get(5), size, asked[0]);
        return;
    }
    let all = scenes::all(pixels);
    let asked_for = args.first().map_or("all", String::as_str);
    let whole = all.iter().any(|(name, _)| name == asked_for);
    for (name, scene) in all {
        let wanted = match (asked_for, whole) {
            ("all", _) => true,
            (part, false) => name.contains(part),
            (_, true) => name == asked_for,
        };
        if !wanted {
            continue;
        }
        if args.get(3).is_some_and(|a| a == "json") {
            let rendered = render_once(&scene, Budget::Samples(1), 0);
            match reference::json(&name, &scene, &rendered) {
                Ok(json) => println!("{json}"),
                Err(what) => {
                    eprintln!("{name}: {what}");
                    std::process::exit(1);
                }
            }
            continue;
        }
        let budget = match asked[0] > 0.0 {
            true => Budget::Error(asked[0]),
            false => Budget::Samples(64),
        };
        let set = Settings {
            split: false,
            ..settings(budget)
        };
        let before = cpu_seconds();
        let planned = plan(&scene, &set).expect("the scene is sound");
        let between = cpu_seconds();
        let first = render_once(&scene, budget, 0);
        println!(
            "{name}: {} paths at first, {:.2} CPU s, says {:.2} %, {:.1} M rays; planned in {:.2} CPU s: {} paths, {:.2} %, {:.1} M rays",
            first.error.samples,
            cpu_seconds() - between,
            100.0 * first.error.median_relative,
            first.rays as f64 / 1e6,
            between - before,
            planned.passes,
            100.0 * planned.error,
            planned.rays as f64 / 1e6,
        );
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
        if asked[0] < 0.0 {
            classes(&scene);
            continue;
        }
        let passes = (16 * first.error.samples).clamp(768, 32768);
        let truth = stored_truth(&format!("{name}-{pixels}"), || truth(&scene, passes));
        let noise = truth.noise.iter().zip(truth.mean.chunks(BINS));
        let mut noise: Vec<f64> = noise
            .map(|(n, r)| (n / r.iter().map(|r| r * r).sum::<f64>()).sqrt())
            .collect();
        noise.sort_by(f64::total_cmp);
        println!(
            "    truth: median noise {:.2} %",
            100.0 * noise[noise.len() / 2]
        );
        if asked[0] == 0.0 {
            let rungs = [8, 32, 128].map(|passes| fixed(&scene, (passes, seeds), &truth));
            merit(&rungs);
        }
        for &asked in asked.iter().filter(|&&a| a > 0.0) {
            stopped(&scene, asked, seeds, &truth);
        }
    }
}

/// Variance by class of paths.
fn classes(scene: &Scene) {
    let set = settings(Budget::Samples(64));
    let all = variance(scene, &set, 64).expect("the scene is sound");
    println!("    energy %  variance %  of the middle half %");
    for c in all {
        let of = [c.energy, c.variance, c.middle].map(|x| 100.0 * x);
        println!(
            "    {:8.2}  {:8.2}  {:8.2}  {}",
            of[0], of[1], of[2], c.class
        );
    }
}

/// Reads a truth from its file, or creates and stores it.
fn stored_truth(name: &str, make: impl Fn() -> Truth) -> Truth {
    let Ok(folder) = std::env::var("STOP_TRUTHS") else {
        return make();
    };
    let path = std::path::Path::new(&folder).join(format!("{name}.json"));
    if let Some((mean, noise)) = std::fs::read(&path)
        .ok()
        .and_then(|bytes| serde_json::from_slice(&bytes).ok())
    {
        return Truth { mean, noise };
    }
    let truth = make();
    let bytes = serde_json::to_vec(&(&truth.mean, &truth.noise)).expect("numbers");
    std::fs::write(path, bytes).expect("the folder of truths can be written to");
    truth
}

/// The mean result of renders with a fixed number of passes: CPU seconds, and the median error of a
/// pixel.
struct Rung {
    cpu_s: f64,
    error: f64,
}

/// Renders with a fixed number of passes, and prints the estimated and the true error, per pixel
/// and of the whole image.
fn fixed(scene: &Scene, (passes, seeds): (u32, u32), truth: &Truth) -> Rung {
    let (mut says, mut is, mut p95, mut total, mut cpu_s) = (0.0, 0.0, 0.0, 0.0, 0.0);
    let mut says_p95 = 0.0;
    let (mut mean_total, mut unsure) = (0.0, 0.0);
    let mut sums = vec![];
    let n = f64::from(seeds);
    for seed in 0..seeds {
        let before = cpu_seconds();
        let r = render_once(scene, Budget::Samples(passes), u64::from(seed));
        cpu_s += (cpu_seconds() - before) / n;
        says += f64::from(r.error.median_relative) / n;
        says_p95 += f64::from(r.error.p95_relative) / n;
        let [median, high] = deviation(&r.transient, truth);
        is += median / n;
        p95 += high / n;
        total += f64::from(r.error.total_relative).powi(2) / n;
        mean_total += f64::from(r.error.total_relative) / n;
        unsure += f64::from(r.error.total_uncertainty) / n;
        sums.push(r.transient.iter().map(|&x| f64::from(x)).sum::<f64>());
    }
    let whole = truth.mean.iter().sum::<f64>();
    let spread = sums.iter().map(|s| (s / whole - 1.0).powi(2)).sum::<f64>() / n;
    println!(
        "    {passes} paths: {cpu_s:.2} CPU s; says {:.2} %, is {:.2} % ({:.2}), 95th {:.1} % (says {:.1} %); whole image says {:.3} % (mean {:.3} %, uncertainty {unsure:.2}), is {:.3} %",
        100.0 * says,
        100.0 * is,
        is / says,
        100.0 * p95,
        100.0 * says_p95,
        100.0 * total.sqrt(),
        100.0 * mean_total,
        100.0 * spread.sqrt()
    );
    Rung { cpu_s, error: is }
}

/// Prints the slope of error over time between the last rungs, and CPU seconds to 10 % and to 5 %.
fn merit(rungs: &[Rung]) {
    let [.., a, b] = rungs else { return };
    let slope = (b.error / a.error).ln() / (b.cpu_s / a.cpu_s).ln();
    let to = |error: f64| {
        let below = rungs.iter().position(|r| r.error <= error);
        let (from, slope) = match below {
            Some(k) if k > 0 => {
                let (a, b) = (&rungs[k - 1], &rungs[k]);
                (b, (b.error / a.error).ln() / (b.cpu_s / a.cpu_s).ln())
            }
            Some(_) => (&rungs[0], -0.5),
            None => (b, slope.clamp(-0.5, -0.2)),
        };
        from.cpu_s * (error / from.error).powf(1.0 / slope)
    };
    println!(
        "    merit: slope {slope:.2}; {:.2} CPU s to 10 %, {:.2} to 5 %",
        to(0.1),
        to(0.05)
    );
}

/// Renders until the requested error, and prints the true one.
fn stopped(scene: &Scene, asked: f64, seeds: u32, truth: &Truth) {
    let mut found = vec![];
    for seed in 0..seeds {
        let before = cpu_seconds();
        let r = render_once(scene, Budget::Error(asked), u64::from(seed));
        found.push((
            deviation(&r.transient, truth)[0],
            f64::from(r.error.median_relative),
            r.error.samples,
            cpu_seconds() - before,
        ));
    }
    found.sort_by(|a, b| a.0.total_cmp(&b.0));
    let n = found.len() as f64;
    let mean = |f: fn(&(f64, f64, u32, f64)) -> f64| found.iter().map(f).sum::<f64>() / n;
    println!(
        "    asked for {:.1} %: is {:.2} % in the mean ({:.2} to {:.2}), says {:.2} %, {:.0} paths, {:.2} CPU s",
        100.0 * asked,
        100.0 * mean(|f| f.0),
        100.0 * found[0].0,
        100.0 * found[found.len() - 1].0,
        100.0 * mean(|f| f.1),
        mean(|f| f64::from(f.2)),
        mean(|f| f.3),
    );
}
