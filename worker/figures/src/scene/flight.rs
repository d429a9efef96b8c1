//! Light in flight: one scene's transient as an animated GIF, with a few bins per frame.

use super::{View, quantile};
use crate::animation;

/// Maximum number of frames; bins are summed to stay within it.
const FRAMES: usize = 160;
/// Duration of a frame in hundredths of a second.
const DELAY: u16 = 6;

/// Returns the animation. Exposure is common to all frames (the signal to the power 0.4), so
/// brightness can be compared over time. The palette is the colour map itself, so no colour is
/// approximated. A pixel is a square of `side` pixels of the animation.
pub fn flight(view: &View, map: fn(f32) -> [u8; 3], side: usize) -> Vec<u8> {
    let (first, last) = lively(&view.energy_by_bin());
    let step = (last - first).div_ceil(FRAMES).max(1);
    let white = exposure(view, step, first, last);
    let palette: Vec<u8> = (0..=255u8)
        .flat_map(|i| map(f32::from(i) / 255.0))
        .collect();
    let frame = |lo: usize| -> Vec<u8> {
        let slice = view.slice(lo, (lo + step).min(view.bins));
        let bright = |v: &f32| ((v / white).clamp(0.0, 1.0).powf(0.4) * 255.0).round() as u8;
        let bright: Vec<u8> = slice.iter().map(bright).collect();
        let rows = bright.chunks_exact(view.width.max(1));
        rows.flat_map(|row| {
            let wide: Vec<u8> = row.iter().flat_map(|v| vec![*v; side]).collect();
            wide.repeat(side)
        })
        .collect()
    };
    let mut frames = (first..last).step_by(step).map(frame);
    let size = (view.width * side, view.height * side);
    animation(size, &palette, DELAY, &mut frames)
}

/// Returns the bins between the first light and the arrival of 92 % of the energy. After that there
/// is only a faint, even glow.
fn lively(energy: &[f64]) -> (usize, usize) {
    let total: f64 = energy.iter().sum();
    let arrived = |share: f64| {
        let mut sum = 0.0;
        let reached = |e: &f64| {
            sum += e;
            sum > share * total
        };
        energy.iter().position(reached)
    };
    match (arrived(1e-6), arrived(0.92)) {
        (Some(first), Some(last)) => (first.saturating_sub(2), last + 1),
        _ => (0, energy.len()),
    }
}

/// Returns the value shown as white: a high quantile of the bright part of a few frames.
fn exposure(view: &View, step: usize, first: usize, last: usize) -> f32 {
    let probes: Vec<f32> = (1..8)
        .map(|k| first + (last - first) * k / 16)
        .flat_map(|lo| view.slice(lo, (lo + step).min(view.bins)))
        .filter(|v| *v > 0.0)
        .collect();
    quantile(&probes, 0.99).max(f32::MIN_POSITIVE)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_dark_scene_still_makes_a_picture() {
        let view = View {
            scene: 0,
            width: 4,
            height: 3,
            bins: 10,
            gate_start_m: 1.0,
            bin_width_m: 0.1,
            transient: vec![0.0; 120],
            depth: vec![0.0; 12],
            rgb: vec![0; 36],
            specular: vec![0; 12],
            visibility: vec![0; 12],
            spots: vec![None],
        };
        let gif = flight(&view, crate::inferno, 3);
        assert!(gif.starts_with(b"GIF89a\x0c\0\x09\0"));
    }
}
