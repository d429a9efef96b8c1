//! The picture of one flash: intensity, depth, its error, and masks next to the true ones.

use picofarm_demultiplex::{Demultiplexed, Truth};
use picofarm_figures::{Canvas, TEXT, inferno, viridis};

use super::Flash;

/// Side of an image in pixels.
const CELL: usize = 192;
const GAP: usize = 4;
const HEAD: usize = TEXT + 8;
const BACKGROUND: [u8; 3] = [16, 16, 20];
const INK: [u8; 3] = [210, 210, 215];
/// The colour of a pixel that is in shadow but found lit.
const MISSED: [u8; 3] = [220, 60, 50];
/// The colour of a pixel that is lit but found in shadow.
const ADDED: [u8; 3] = [60, 90, 220];
/// Spots whose masks are shown.
const MASKS: usize = 4;
/// Error of depth that is drawn brightest, metres.
const ERROR_M: f32 = 0.2;

/// Draws it. The lower row has masks: white and grey where truth and answer agree, and the colours
/// of the legend where they do not.
pub fn draw(flash: &Flash, found: &Demultiplexed, truth: Option<&Truth>) -> Canvas {
    let i = &flash.camera.intrinsics;
    let size = (i.width as usize, i.height as usize);
    let pixels = size.0 * size.1;
    let width = GAP + MASKS * (CELL + GAP);
    let true_mask = truth.filter(|t| t.visibility.len() == found.lit.len());
    let rows = 2 * (HEAD + CELL + GAP);
    let mut canvas = Canvas::new(
        width,
        rows + if true_mask.is_some() { HEAD } else { 0 },
        BACKGROUND,
    );
    let mut cell = |n: usize, title: &str, colour: &dyn Fn(usize) -> [u8; 3]| {
        let at = (
            GAP + n % MASKS * (CELL + GAP),
            n / MASKS * (HEAD + CELL + GAP),
        );
        canvas.text(at.0, at.1 + 4, title, INK);
        canvas.image((at.0, at.1 + HEAD), CELL, size, colour);
    };
    let intensity: Vec<f32> = flash
        .histogram
        .chunks(flash.gate.bins as usize)
        .map(|h| h.iter().sum::<f32>().max(0.0).sqrt())
        .collect();
    let bright = quantile(&intensity, 0.98).max(f32::MIN_POSITIVE);
    cell(0, "intensity", &|p| inferno(intensity[p] / bright));
    let far = quantile(&found.depth_m, 0.99).max(f32::MIN_POSITIVE);
    cell(1, &format!("depth, 0 to {far:.1} m"), &|p| {
        viridis(found.depth_m[p] / far)
    });
    match truth {
        Some(truth) => cell(2, &format!("error, 0 to {ERROR_M} m"), &|p| {
            let z = truth.depth_m[p];
            match z > 0.0 {
                true => inferno((found.depth_m[p] - z).abs() / ERROR_M),
                false => BACKGROUND,
            }
        }),
        None => cell(2, "confidence", &|p| viridis(found.confidence[p])),
    }
    cell(3, "spots that light a pixel", &|p| {
        let lit = (0..found.places.len()).filter(|k| found.lit[k * pixels + p] >= 0.5);
        viridis(lit.count() as f32 / found.places.len() as f32)
    });
    for n in 0..MASKS.min(found.places.len()) {
        let k = (2 * n + 1) * found.places.len() / (2 * MASKS.min(found.places.len()));
        let title = format!("lit by beam {}", flash.beams[k]);
        cell(MASKS + n, &title, &|p| {
            let q = k * pixels + p;
            let grey = (found.lit[q] * 255.0) as u8;
            match true_mask.map(|t| (t.visibility[q] != 0, found.lit[q] >= 0.5)) {
                Some((false, true)) => MISSED,
                Some((true, false)) => ADDED,
                _ => [grey; 3],
            }
        });
    }
    if true_mask.is_some() {
        let legend = [("shadow missed", MISSED), ("shadow that is none", ADDED)];
        for (k, (text, colour)) in legend.into_iter().enumerate() {
            canvas.text(GAP + k * (CELL + GAP), rows + 2, text, colour);
        }
    }
    canvas
}

fn quantile(values: &[f32], share: f32) -> f32 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f32::total_cmp);
    let at = (share * sorted.len() as f32) as usize;
    sorted.get(at).copied().unwrap_or(0.0)
}
