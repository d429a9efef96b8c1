//! Plots size against error.

use std::path::Path;

use super::{Report, Row, method::Kind};
use crate::axes::{Axes, INK, LETTER, Span};
use picofarm_cli::{error::Result, picture::save};
use picofarm_figures::Canvas;

const SIZE: (usize, usize) = (1140, 760);
const LEFT: usize = 72;
const TOP: usize = 64;
const BELOW: usize = 72;
const LEGEND: usize = 370;
const ROW: usize = 16;
/// Position of methods without any error on the logarithmic axis.
const EXACT: f64 = 1e-3;
const TARGET: [u8; 3] = [170, 170, 170];
/// The default profile's goal: terabytes and rms σ.
const PROMISE: (f64, f64) = (2.0, 0.06);

fn colour(kind: Kind) -> [u8; 3] {
    match kind {
        Kind::Profile => [213, 94, 0],
        Kind::Candidate => [0, 114, 178],
        Kind::Unreadable => [204, 121, 167],
        Kind::Other => [90, 90, 90],
    }
}

/// Returns rms σ as drawn.
fn shown(row: &Row) -> f64 {
    row.loss.rms_sigma.max(EXACT)
}

/// Draws a numbered mark per method: discs for profiles, squares for the rest.
///
/// # Errors
/// Fails if the file cannot be written.
pub fn draw(report: &Report, path: &Path) -> Result<()> {
    let rows = &report.rows;
    let xs = rows.iter().map(|r| r.tb).chain([PROMISE.0]);
    let ys = rows.iter().map(shown).chain([PROMISE.1]);
    let mut axes = Axes {
        canvas: Canvas::new(SIZE.0, SIZE.1, [255; 3]),
        left: LEFT,
        top: TOP,
        width: SIZE.0 - LEFT - LEGEND,
        height: SIZE.1 - TOP - BELOW,
        x: Span::around(xs),
        y: Span::around(ys),
    };
    axes.draw("TB of 97,432 scenes", "rms error, sigma (0.001 = none)");
    let corner = axes.at(PROMISE.0, PROMISE.1);
    let (left, bottom) = (axes.left as f64, (axes.top + axes.height) as f64);
    axes.line(corner, (corner.0, bottom), 4, TARGET);
    axes.line((left, corner.1), corner, 4, TARGET);
    let x = axes.left + axes.width + 16;
    // Profiles last, so that they are on top.
    let mut order: Vec<usize> = (0..rows.len()).collect();
    order.sort_by_key(|k| rows[*k].kind == Kind::Profile);
    let marks: Vec<(f64, f64)> = rows.iter().map(|row| axes.at(row.tb, shown(row))).collect();
    for k in &order {
        axes.marker(
            marks[*k],
            rows[*k].kind == Kind::Profile,
            colour(rows[*k].kind),
        );
    }
    // If many marks overlap, only the first one's number is drawn. The legend has all figures.
    let mut numbered: Vec<(f64, f64)> = Vec::new();
    for k in order.into_iter().rev() {
        let (px, py) = marks[k];
        let near = |n: &(f64, f64)| (n.0 - px).abs() < 28.0 && (n.1 - py).abs() < 14.0;
        if !numbered.iter().any(near) {
            let place = (px as usize + 7, (py as usize).saturating_sub(10));
            axes.text(
                place.0,
                place.1,
                &(k + 1).to_string(),
                1,
                colour(rows[k].kind),
            );
            numbered.push((px, py));
        }
    }
    for (k, row) in rows.iter().enumerate() {
        let line = TOP + k * ROW;
        axes.text(x, line, &(k + 1).to_string(), 1, colour(row.kind));
        axes.text(
            x + 3 * LETTER,
            line,
            &format!("{:5.2} {}", row.tb, row.name),
            1,
            INK,
        );
    }
    save(&axes.canvas, path)
}
