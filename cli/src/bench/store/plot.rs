//! The picture of size against error.

use std::path::Path;

use super::{Report, method::Kind};
use crate::{
    bench::axes::{Axes, INK, LETTER, Span},
    error::Result,
    picture::canvas::Canvas,
};

const SIZE: (usize, usize) = (1100, 760);
const LEFT: usize = 72;
const TOP: usize = 64;
const BELOW: usize = 72;
const LEGEND: usize = 330;
const ROW: usize = 16;
/// Where ways without any error are drawn.
const EXACT: f64 = 1e-3;
const TARGET: [u8; 3] = [170, 170, 170];
/// The default's promise: terabytes and rms σ.
const PROMISE: (f64, f64) = (2.0, 0.06);

fn colour(kind: Kind) -> [u8; 3] {
    match kind {
        Kind::Profile => [213, 94, 0],
        Kind::Candidate => [0, 114, 178],
        Kind::Unreadable => [204, 121, 167],
        Kind::Other => [90, 90, 90],
    }
}

/// Draws a numbered mark a way: profiles are discs, the rest squares.
///
/// # Errors
/// The file cannot be written.
pub fn draw(report: &Report, path: &Path) -> Result<()> {
    let y = |sigma: f64| sigma.max(EXACT);
    let rows = &report.rows;
    let xs = rows.iter().map(|r| r.tb).chain([PROMISE.0]);
    let ys = rows.iter().map(|r| y(r.loss.rms_sigma)).chain([PROMISE.1]);
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
    for (k, row) in rows.iter().enumerate() {
        let at = axes.at(row.tb, y(row.loss.rms_sigma));
        let (round, colour) = (row.kind == Kind::Profile, colour(row.kind));
        axes.marker(at, round, colour);
        let number = (k + 1).to_string();
        axes.text(
            at.0 as usize + 7,
            (at.1 as usize).saturating_sub(10),
            &number,
            1,
            colour,
        );
        axes.text(x, TOP + k * ROW, &number, 1, colour);
        axes.text(x + 3 * LETTER, TOP + k * ROW, &row.name, 1, INK);
    }
    axes.canvas.save(path)
}
