//! The tables of the benchmark.

use super::{
    Report, Row,
    reading::{Fetched, Into, Reading, TRAINING},
};
use picofarm_cli::output::table;

pub fn describe(report: &Report) -> String {
    let m = &report.machine;
    let mut text = format!("{}, {} cores, one of them used", m.processor, m.cores);
    if !m.optimised {
        text += "\nNOT OPTIMISED: build with --release before you believe any speed";
    }
    text += "\n";
    for s in &report.scenes {
        let [rows, columns, bins] = s.size;
        text += &format!(
            "scene {}: {rows}x{columns}x{bins}, {:.0} % of bins dark, {:.0} % below one photon; two-bounce light in \
             {:.0} bins of a pixel\n",
            s.scene,
            100.0 * s.dark,
            100.0 * s.below_one_photon,
            s.arrivals
        );
    }
    text += &format!("\nprofiles\n{}", profiles(&report.rows));
    text += "MB/CPU-s: of 32-bit floats, one thread. sigma = sqrt(max(N, 1)). Projected from these scenes.\n";
    if let Some(reading) = &report.reading {
        text += &read(reading);
    }
    text
}

fn profiles(rows: &[Row]) -> String {
    let head = [
        "",
        "MB a scene",
        "97,432 scenes",
        "max sigma",
        "rms sigma",
        "peaks moved",
        "peak sigma",
        "encode MB/CPU-s",
        "decode MB/CPU-s",
    ];
    let mut cells = vec![head.map(String::from).to_vec()];
    for row in rows {
        cells.push(vec![
            row.name.into(),
            format!("{:.2}", row.mb_a_scene),
            format!("{:.2} TB", row.tb),
            error(row.loss.max_sigma),
            error(row.loss.rms_sigma),
            format!("{:.2} %", 100.0 * row.loss.peak_moved),
            error(row.loss.peak_sigma),
            format!("{:.0}", row.encode_mb_per_cpu_s),
            format!("{:.0}", row.decode_mb_per_cpu_s),
        ]);
    }
    table(&cells)
}

/// Formats an error with three decimals, or in powers of ten if it is large.
fn error(sigma: f64) -> String {
    match sigma {
        0.0 => "0".into(),
        s if s >= 1000.0 => format!("{s:.1e}"),
        s => format!("{s:.3}"),
    }
}

fn read(reading: &Reading) -> String {
    let fetched = |name: String, f: &Fetched| {
        vec![
            name,
            format!(
                "{:.2} MB, {:.2} x its share, {:.1} requests",
                f.bytes / 1e6,
                f.of_share,
                f.requests
            ),
        ]
    };
    let side = reading.crop.side;
    let mut rows = vec![
        vec![
            "whole scenes".into(),
            format!("{:.0} MB/CPU-s", reading.whole_mb_per_cpu_s),
        ],
        vec![
            "the same into one buffer".into(),
            format!("{:.0} MB/CPU-s", reading.reused_mb_per_cpu_s),
        ],
        fetched(
            format!("{side}x{side} crop, aligned"),
            &reading.crop.aligned,
        ),
        fetched("mean over offsets".into(), &reading.crop.mean),
        fetched("worst".into(), &reading.crop.worst),
        fetched("up to 128 bins of all pixels".into(), &reading.bins),
    ];
    for l in &reading.loaders {
        rows.push(vec![
            format!(
                "loader of {}, {} thread{}",
                match l.into {
                    Into::Histogram => "histograms",
                    Into::Input => "a network's input",
                },
                l.threads,
                if l.threads == 1 { "" } else { "s" }
            ),
            format!(
                "{:.2} scenes/s, {:.3} CPU-s a scene: {:.1} cores for {TRAINING:.0} scenes/s",
                l.scenes_per_s, l.cpu_s_a_scene, l.cores_for_training
            ),
        ]);
    }
    format!("\nreading, {}\n{}", reading.profile, table(&rows))
}
