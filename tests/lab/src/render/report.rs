//! Output of the render benchmark: tables for people, one document for programs.

use serde_json::{Value, json};

use crate::args::Render as RenderArgs;
use picofarm_cli::output::table;

use super::{
    curve::{Crossing, How, three_digits},
    ladder::{Outcome, Rung},
    scaling::{Axis, Scaling},
};

/// Returns the document that `--json` prints.
pub fn document(found: &[Outcome], args: &RenderArgs) -> Value {
    json!({
        "renderer": picofarm_transient::RENDERER_VERSION,
        "seeds": args.seeds,
        "error": "median over pixels of |h - r| / |r| over the bins, one-bounce peaks left out, the truth's own noise taken off in quadrature",
        "scenes": found,
    })
}

/// Formats error over time, scene by scene.
pub fn ladders(found: &[Outcome]) -> String {
    let parts: Vec<String> = found.iter().map(ladder).collect();
    parts.join("\n")
}

fn percent(share: f64) -> String {
    three_digits(100.0 * share)
}

/// Formats a requested fraction as a percentage with as few digits as possible: "10 %", "2.5 %".
fn asked(share: f64) -> String {
    format!("{} %", (share * 1e6).round() / 1e4)
}

fn plural(n: usize) -> &'static str {
    if n == 1 { "" } else { "s" }
}

fn ladder(found: &Outcome) -> String {
    let mut text = format!(
        "{}: {}x{} pixels x {} bins, {} spot{}, {} triangles, {} thread{}\n\
         truth: {}; its own noise {} %\n\n",
        found.scene,
        found.width,
        found.height,
        found.bins,
        found.spots,
        plural(found.spots),
        found.triangles,
        found.threads,
        plural(found.threads),
        found.truth,
        percent(found.truth_noise),
    );
    let header = [
        "",
        "paths",
        "CPU s",
        "wall s",
        "Mrays/s",
        "error %",
        "claimed %",
        "all bins %",
        "energy",
    ];
    let mut rows = vec![header.map(String::from).to_vec()];
    for curve in &found.variants {
        rows.extend(curve.rungs.iter().map(|r| row(&curve.name, r)));
    }
    let stopping = &found.stopping;
    let until = format!("until {}", asked(stopping.target));
    rows.push(row(&until, &stopping.rung));
    text += &right_aligned(&rows);
    text += "\n";
    text += &right_aligned(&times(found));
    if !found.peers.is_empty() {
        text +=
            "~ beyond the last rung, error ~ time^-1/2; < the cheapest rung is better already\n";
    }
    for warning in &found.warnings {
        text += &format!("warning: {warning}\n");
    }
    text
}

fn row(name: &str, r: &Rung) -> Vec<String> {
    vec![
        name.into(),
        r.samples.to_string(),
        three_digits(r.cpu_s),
        three_digits(r.wall_s),
        three_digits(r.rays as f64 / 1e6 / r.cpu_s),
        percent(r.error.median),
        percent(r.claimed),
        percent(r.error.rmse),
        format!("{:.4}", r.error.energy_ratio),
    ]
}

/// Returns the CPU seconds to each error, one row per curve.
fn times(found: &Outcome) -> Vec<Vec<String>> {
    let shown = |at: Option<Crossing>| at.map_or("-".into(), |c| c.to_string());
    let mut header = vec!["CPU s to".to_owned()];
    for t in &found.variants[0].to {
        header.push(asked(t.error));
    }
    let mut rows = vec![header];
    for curve in &found.variants {
        let mut row = vec![curve.name.clone()];
        row.extend(curve.to.iter().map(|t| shown(t.at)));
        rows.push(row);
    }
    for peer in &found.peers {
        let mut row = vec![peer.name.clone()];
        row.extend(peer.to.iter().map(|t| shown(t.at)));
        rows.push(row);
        let mut row = vec!["  ratio".to_owned()];
        let each = peer.ratio.iter().zip(&peer.to).zip(&found.variants[0].to);
        row.extend(each.map(
            |((ratio, theirs), ours)| match (ratio, theirs.at, ours.at) {
                (Some(r), Some(a), Some(b)) => {
                    let exact = [a, b].iter().all(|c| c.how == How::Interpolated);
                    format!("{}{}x", if exact { "" } else { "~" }, three_digits(*r))
                }
                _ => "-".into(),
            },
        ));
        rows.push(row);
    }
    rows
}

/// Like [`table`], with every column except the first aligned right.
fn right_aligned(rows: &[Vec<String>]) -> String {
    let columns = rows.first().map_or(0, Vec::len);
    let width = |c: usize| rows.iter().map(|r| r[c].len()).max().unwrap_or(0);
    let widths: Vec<usize> = (0..columns).map(width).collect();
    let padded: Vec<Vec<String>> = rows
        .iter()
        .map(|row| {
            row.iter()
                .zip(&widths)
                .enumerate()
                .map(|(c, (s, &w))| {
                    if c == 0 {
                        s.clone()
                    } else {
                        format!("{s:>w$}")
                    }
                })
                .collect()
        })
        .collect();
    table(&padded)
}

/// Formats the growth of the time.
pub fn scaling(found: &Scaling) -> String {
    let b = &found.base;
    let mut text = format!(
        "{}: {}x{} pixels x {} bins, {} spots, {} triangles to {}: {} CPU s ({} paths a pixel, claimed {} %)\n",
        found.scene,
        b.pixels,
        b.pixels,
        b.bins,
        b.spots,
        b.triangles,
        asked(found.target),
        three_digits(b.cpu_s),
        b.samples,
        percent(b.claimed),
    );
    for axis in &found.axes {
        text += "\n";
        text += &growth(axis);
    }
    text
}

fn growth(axis: &Axis) -> String {
    let mut rows = vec![
        [
            axis.name,
            "CPU s",
            "wall s",
            "paths",
            "claimed %",
            "Mrays/s",
        ]
        .map(String::from)
        .to_vec(),
    ];
    for p in &axis.points {
        rows.push(vec![
            p.at.to_string(),
            three_digits(p.size.cpu_s),
            three_digits(p.size.wall_s),
            p.size.samples.to_string(),
            percent(p.size.claimed),
            three_digits(p.size.rays as f64 / 1e6 / p.size.cpu_s),
        ]);
    }
    let grows = axis
        .exponent
        .map_or(String::new(), |k| format!("CPU s ~ {}^{k:.2}\n", axis.name));
    right_aligned(&rows) + &grows
}
