//! Histograms as planes: rebinned, scaled, bin by bin.

use super::Normalise;
use crate::scene::Scene;

/// m of a scene, `[bin][row][column]`, with `bins` bins: adjacent ones are summed, those left over at the end dropped, then
/// scaled.
///
/// # Panics
/// Where the scene has fewer.
pub fn planes(scene: &Scene, bins: usize, normalise: Normalise, out: &mut [f32]) {
    let pixels = scene.pixels();
    assert!(bins <= scene.bins, "bins are summed, not divided");
    assert_eq!(out.len(), bins * pixels, "room for each bin of each pixel");
    let merged = scene.bins / bins;
    let mut pixel = vec![0.0f32; bins];
    for (p, stored) in scene.histogram.chunks_exact(scene.bins).enumerate() {
        for (bin, of) in pixel.iter_mut().zip(stored.chunks_exact(merged)) {
            *bin = of.iter().sum();
        }
        scale(&mut pixel, normalise);
        for (b, value) in pixel.iter().enumerate() {
            out[b * pixels + p] = *value;
        }
    }
}

fn scale(pixel: &mut [f32], normalise: Normalise) {
    match normalise {
        Normalise::MinMax => min_max(pixel),
        Normalise::Log { greatest } => {
            let whole = (f64::from(greatest).log10() + 8.0).max(f64::MIN_POSITIVE);
            for h in pixel {
                let log = libm::log10(f64::from(*h) + 1e-8) + 8.0;
                *h = (log / whole).clamp(0.0, 1.0) as f32;
            }
        }
    }
}

/// (h − min)/(max − min); zeros where all are equal, and where a value is not finite.
fn min_max(values: &mut [f32]) {
    let (mut least, mut most) = (f32::INFINITY, f32::NEG_INFINITY);
    for h in values.iter() {
        least = least.min(*h);
        most = most.max(*h);
    }
    let range = most - least;
    if !(range > 0.0 && range.is_finite()) {
        return values.fill(0.0);
    }
    for h in values {
        let scaled = (*h - least) / range;
        *h = if scaled.is_finite() { scaled } else { 0.0 };
    }
}

/// Σ_b h, scaled to 0..1 over the image.
pub fn intensity(scene: &Scene, out: &mut [f32]) {
    for (sum, h) in out.iter_mut().zip(scene.histogram.chunks_exact(scene.bins)) {
        *sum = h.iter().sum();
    }
    min_max(out);
}

#[cfg(test)]
mod tests {
    use super::*;

    fn one(histogram: &[f32]) -> Scene {
        Scene {
            height: 1,
            width: 1,
            bins: histogram.len(),
            histogram: histogram.to_vec(),
            ..Scene::default()
        }
    }

    fn scaled(histogram: &[f32], bins: usize) -> Vec<f32> {
        let mut out = vec![f32::NAN; bins];
        planes(&one(histogram), bins, Normalise::MinMax, &mut out);
        out
    }

    #[test]
    fn empty_constant_spiked_and_saturated_histograms_stay_in_0_to_1() {
        assert_eq!(scaled(&[0.0; 4], 4), [0.0; 4]);
        assert_eq!(scaled(&[7.0; 4], 4), [0.0; 4]);
        assert_eq!(scaled(&[0.0, 3.0, 0.0, 0.0], 4), [0.0, 1.0, 0.0, 0.0]);
        assert_eq!(scaled(&[1.0, f32::MAX, 1.0, 1.0], 4), [0.0, 1.0, 0.0, 0.0]);
        assert_eq!(scaled(&[1.0, f32::INFINITY], 2), [0.0, 0.0]);
        assert_eq!(scaled(&[1e-30, 2e-30], 2), [0.0, 1.0]);
    }

    #[test]
    fn rebinning_sums_before_scaling() {
        assert_eq!(scaled(&[1.0, 1.0, 5.0, 1.0, 2.0, 2.0], 3), [0.0, 1.0, 0.5]);
    }

    #[test]
    fn the_logarithm_is_0_for_darkness_and_1_for_the_greatest() {
        let log = Normalise::Log { greatest: 10.0 };
        let mut out = vec![0.0; 3];
        planes(&one(&[0.0, 10.0, 1e3]), 3, log, &mut out);
        assert_eq!(out, [0.0, 1.0, 1.0]);
    }
}
