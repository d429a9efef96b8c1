//! Errors against photon noise, and against the number of lit spots: a sensor with pulse and jitter
//! counts the light of rooms that nothing was tuned on. "Photons" are those of the median pixel's
//! brightest bin.
//!
//! In the environment: as for the example `rooms`, with `ROOMS` (3), and `SVG`, a path to which
//! both are drawn.

#[path = "common/chart.rs"]
mod chart;
#[path = "common/mod.rs"]
mod common;

use std::{env, fs};

use chart::{Panel, Series};
use common::{Kind, Room, variable};
use picofarm_demultiplex::{Capture, Demultiplexed, Settings, Shading, demultiplex, score};
use picofarm_sensor::{Histograms, Jitter, PS_PER_M, Pulse, Scale, Sensor, Values, sense};

/// What a sensor sees of a room; `None` = the light itself.
fn seen(room: &Room, seed: u64, photons: Option<f64>) -> Vec<f32> {
    let Some(photons) = photons else {
        return room.histogram.clone();
    };
    let sensor = Sensor {
        scale: Scale::Peak { photons },
        ..Sensor::default()
    };
    let light = Histograms {
        transient: &room.histogram,
        two_bounce: None,
        bins: room.gate.bins as usize,
        bin_width_ps: room.gate.bin_width_m * PS_PER_M,
    };
    match sense(&sensor, &light, 1, seed)
        .expect("light that can be sensed")
        .values
    {
        Values::Counts(counts) => counts.iter().map(|c| *c as f32).collect(),
        Values::Rate(rate) => rate,
    }
}

/// Sum of errors and count of the pixels that so many spots light: the first bounds of each group.
const LIT: [usize; 7] = [0, 1, 3, 5, 8, 12, 17];

fn by_lit(room: &Room, found: &Demultiplexed, sums: &mut [[f64; 2]; LIT.len()]) {
    let pixels = room.depth.len();
    for p in 0..pixels {
        if room.specular[p] != 0 || room.depth[p] <= 0.0 {
            continue;
        }
        let lit = (0..room.spots.len())
            .filter(|s| room.visibility[s * pixels + p] != 0)
            .count();
        let group = LIT
            .iter()
            .rposition(|least| *least <= lit)
            .expect("the first is 0");
        sums[group][0] += f64::from((found.depth_m[p] - room.depth[p]).abs());
        sums[group][1] += 1.0;
    }
}

fn main() {
    let kind = Kind::of_environment();
    let (first, count) = (variable("FIRST", 91001), variable("ROOMS", 3u64));
    let sensor = Sensor::default();
    let Jitter::Gaussian { fwhm_ps } = sensor.jitter else {
        panic!("the usual jitter is Gaussian");
    };
    let pulse = match sensor.pulse {
        Pulse::None {} => "no pulse",
        _ => "the usual pulse",
    };
    println!("{count} rooms, jitter of {fwhm_ps} ps, {pulse}");
    println!(
        "| photons | depth MAE, m | worst room | median, mm | IoU by physics | learned | mirrors IoU |"
    );
    println!("| --- | --- | --- | --- | --- | --- | --- |");
    let mut groups = [[0.0; 2]; LIT.len()];
    // Photons; depth MAE, that of the worst room, and median in metres.
    let mut curve = Vec::new();
    for photons in [
        None,
        Some(400.0),
        Some(200.0),
        Some(100.0),
        Some(50.0),
        Some(20.0),
        Some(10.0),
    ] {
        let (mut sum, mut worst, mut mirrors) = ([0.0f64; 4], 0.0f64, Vec::new());
        for seed in first..first + count {
            let room = Room::new(seed, &kind);
            let histogram = seen(&room, seed, photons);
            let capture = Capture {
                histogram: &histogram,
                ..room.capture()
            };
            let by = |shadows| {
                let settings = Settings {
                    shadows,
                    ..Settings::default()
                };
                demultiplex(&capture, &settings).expect("a capture")
            };
            let (physics, learned) = (by(Shading::Physics), by(Shading::Learned));
            let depth = score::depth(&physics.depth_m, &room.truth());
            let iou = |found| {
                score::masks(found, &room.truth())
                    .expect("masks of all spots")
                    .iou
            };
            let row = [depth.mae_m, depth.median_m, iou(&physics), iou(&learned)];
            sum.iter_mut()
                .zip(row)
                .for_each(|(s, x)| *s += x / count as f64);
            worst = worst.max(depth.mae_m);
            mirrors.extend(score::mirrors(&physics, &room.truth()));
            if photons.is_none() {
                by_lit(&room, &physics, &mut groups);
            }
        }
        curve.push((photons, [sum[0], worst, sum[1]]));
        let name = photons.map_or("all light".to_owned(), |p| p.to_string());
        let mirrors = mirrors.iter().sum::<f64>() / mirrors.len() as f64;
        println!(
            "| {name} | {:.4} | {worst:.4} | {:.1} | {:.3} | {:.3} | {mirrors:.3} |",
            sum[0],
            sum[1] * 1e3,
            sum[2],
            sum[3]
        );
    }
    let pixels: f64 = groups.iter().map(|g| g[1]).sum();
    println!("\n| lit spots | share of pixels | depth MAE, m |\n| --- | --- | --- |");
    for (n, [sum, count]) in groups.iter().enumerate() {
        let last = LIT
            .get(n + 1)
            .map_or("and more".to_owned(), |next| format!("to {}", next - 1));
        println!(
            "| {} {last} | {:.3} | {:.4} |",
            LIT[n],
            count / pixels,
            sum / count
        );
    }
    if let Some(path) = env::var_os("SVG") {
        fs::write(&path, drawn(&curve, &groups)).expect("SVG is a path that can be written");
    }
}

/// Name of a group of pixels.
fn group(n: usize) -> String {
    match LIT.get(n + 1) {
        None => format!("{}+", LIT[n]),
        Some(next) if *next == LIT[n] + 1 => LIT[n].to_string(),
        Some(next) => format!("{}–{}", LIT[n], next - 1),
    }
}

/// The chart of both.
fn drawn(curve: &[(Option<f64>, [f64; 3])], groups: &[[f64; 2]]) -> String {
    // 10 to 400 photons, then all light.
    let position = |photons: Option<f64>| match photons {
        Some(photons) => 0.85 * (photons / 10.0).ln() / 40.0f64.ln(),
        None => 1.0,
    };
    let series = |name, k: usize| Series {
        name,
        points: curve
            .iter()
            .map(|(n, errors)| (position(*n), errors[k]))
            .collect(),
    };
    let photons = Panel {
        title: "by photons",
        axis: "photons in the brightest bin of the median pixel",
        ticks: curve
            .iter()
            .map(|(n, _)| (position(*n), n.map_or("all".into(), |n| n.to_string())))
            .collect(),
        series: vec![
            series("mean", 0),
            series("worst room", 1),
            series("median", 2),
        ],
    };
    let place = |n: usize| n as f64 / (groups.len() - 1) as f64;
    let lit = Panel {
        title: "by lit spots",
        axis: "spots that light a pixel (without noise)",
        ticks: (0..groups.len()).map(|n| (place(n), group(n))).collect(),
        series: vec![Series {
            name: "mean",
            points: groups
                .iter()
                .enumerate()
                .map(|(n, [sum, count])| (place(n), sum / count))
                .collect(),
        }],
    };
    let title =
        "Error of depth from one flash, by photons and by the number of spots that light a pixel";
    chart::draw(title, &[photons, lit], [0.001, 0.5])
}
