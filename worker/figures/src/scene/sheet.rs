//! The contact sheet: one row per scene, one column per quantity.

use super::{View, quantile};
use crate::{Canvas, TEXT, inferno, viridis};

const CELL: usize = 144;
const GAP: usize = 4;
const HEAD: usize = TEXT + 8;
const SIDE: usize = 56;
/// Shares of the energy that have arrived at the four slices of light in flight.
const SLICES: [f64; 4] = [0.05, 0.25, 0.5, 0.75];
const BACKGROUND: [u8; 3] = [16, 16, 20];
const INK: [u8; 3] = [210, 210, 215];
const MARK: [u8; 3] = [255, 64, 64];

/// Draws the sheet. Views are read one by one, because one may need hundreds of megabytes.
///
/// # Errors
/// Any error of `read`.
pub fn sheet<E>(scenes: &[u64], mut read: impl FnMut(u64) -> Result<View, E>) -> Result<Canvas, E> {
    let columns = 4 + 3 + SLICES.len();
    let width = SIDE + columns * (CELL + GAP);
    let mut canvas = Canvas::new(width, HEAD + scenes.len() * (CELL + GAP), BACKGROUND);
    let heads = [
        "RGB",
        "depth",
        "intensity",
        "mirrors",
        "lit by first",
        "lit by middle",
        "lit by last",
        "in flight",
        "",
        "",
        "",
    ];
    for (i, head) in heads.iter().enumerate() {
        canvas.text(SIDE + i * (CELL + GAP) + 2, 4, head, INK);
    }
    for (row, &scene) in scenes.iter().enumerate() {
        let view = read(scene)?;
        draw_row(&mut canvas, HEAD + row * (CELL + GAP), &view);
    }
    Ok(canvas)
}

fn draw_row(canvas: &mut Canvas, y: usize, v: &View) {
    canvas.text(4, y + CELL / 2, &v.scene.to_string(), INK);
    let size = (v.width, v.height);
    let at = |column: usize| (SIDE + column * (CELL + GAP), y);
    let rgb = |p: usize| [v.rgb[3 * p], v.rgb[3 * p + 1], v.rgb[3 * p + 2]];
    canvas.image(at(0), CELL, size, rgb);

    let (near, far) = (quantile(&v.depth, 0.001), quantile(&v.depth, 1.0));
    let depth = |p: usize| match v.depth[p] {
        d if d > 0.0 => viridis(1.0 - (d - near) / (far - near).max(1e-6)),
        _ => BACKGROUND,
    };
    canvas.image(at(1), CELL, size, depth);
    caption(canvas, at(1), &format!("{near:.1}-{far:.1} m"));

    let intensity = v.slice(0, v.bins);
    let white = quantile(&intensity, 0.995).max(f32::MIN_POSITIVE);
    canvas.image(at(2), CELL, size, |p| {
        inferno((intensity[p] / white).powf(0.5))
    });
    canvas.image(at(3), CELL, size, |p| {
        if v.specular[p] == 1 {
            [255; 3]
        } else {
            rgb(p).map(|c| c / 4)
        }
    });

    let spots = v.spots.len();
    for (i, spot) in [0, spots / 2, spots.saturating_sub(1)]
        .into_iter()
        .enumerate()
    {
        let mask = &v.visibility[spot * v.pixels()..(spot + 1) * v.pixels()];
        let lit = |p: usize| {
            if mask[p] == 1 {
                [225, 225, 215]
            } else {
                rgb(p).map(|c| c / 4)
            }
        };
        canvas.image(at(4 + i), CELL, size, lit);
        caption(canvas, at(4 + i), &format!("spot {}", spot + 1));
        if let Some([x, y]) = v.spots[spot] {
            let scaled = |p: f32, n: usize| (p / n as f32 * CELL as f32) as usize;
            let (x, y) = (scaled(x, v.width), scaled(y, v.height));
            if x < CELL && y < CELL {
                canvas.cross(at(4 + i).0 + x, at(4 + i).1 + y, MARK);
            }
        }
    }

    let energy = v.energy_by_bin();
    let total: f64 = energy.iter().sum();
    for (i, share) in SLICES.into_iter().enumerate() {
        let mut sum = 0.0;
        let bin = energy
            .iter()
            .position(|e| {
                sum += e;
                sum >= share * total
            })
            .unwrap_or(0);
        let (lo, hi) = (bin.saturating_sub(1), (bin + 2).min(v.bins));
        let slice = v.slice(lo, hi);
        let white = quantile(&slice, 0.998).max(f32::MIN_POSITIVE);
        canvas.image(at(7 + i), CELL, size, |p| {
            inferno((slice[p] / white).powf(0.6))
        });
        caption(canvas, at(7 + i), &format!("{:.1} ns", v.nanoseconds(bin)));
    }
}

fn caption(canvas: &mut Canvas, at: (usize, usize), text: &str) {
    let (x, y) = (at.0 + 3, at.1 + CELL - TEXT - 2);
    canvas.text(x + 1, y + 1, text, [0; 3]);
    canvas.text(x, y, text, [255; 3]);
}
