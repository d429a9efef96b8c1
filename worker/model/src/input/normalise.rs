//! Converts histograms to planes: rebinned, scaled, bin by bin.

use super::Normalise;
use crate::scene::{Order, Scene};

/// The number of pixels that are transposed together from pixel order to bin order: they fill a
/// cache line of each bin's plane.
const BLOCK: usize = 16;
/// The number of pixels that are scaled together: 0.7 MB for 637 bins.
const STRIP: usize = 256;

/// Returns the number of adjacent bins of `stored` that are summed into one of `bins`. The bins
/// that remain at the end are dropped and must be fewer than those summed; otherwise most of a gate
/// could be dropped unnoticed.
///
/// # Errors
/// The fault, with the nearest valid numbers of bins.
pub fn merged(stored: usize, bins: usize) -> Result<usize, String> {
    if bins == 0 || bins > stored {
        return Err(format!(
            "{bins} is more than the data set's {stored} bins, or none at all; give fewer, or 0 for all"
        ));
    }
    let merged = stored / bins;
    let left = stored - merged * bins;
    if left < merged {
        return Ok(merged);
    }
    Err(format!(
        "{bins} bins of {merged} adjacent ones each leave out {left} of the data set's {stored}; give {} (sums of {merged}) or {} \
         (sums of {}), or 0 for all",
        stored / merged,
        stored / (merged + 1),
        merged + 1
    ))
}

/// Computes m of a scene, `[bin][row][column]`, with `bins` bins: adjacent bins are summed, the
/// rest at the end dropped, and the sums scaled; see [`merged`].
///
/// # Panics
/// If the scene has fewer bins.
pub fn planes(scene: &Scene, bins: usize, normalise: Normalise, out: &mut [f32]) {
    let pixels = scene.pixels();
    assert!(bins <= scene.bins, "bins are summed, not divided");
    assert_eq!(out.len(), bins * pixels, "room for each bin of each pixel");
    let merged = scene.bins / bins;
    if scene.order == Order::Bins {
        return strips(scene, bins, normalise, out);
    }
    let mut block = vec![0.0f32; BLOCK * bins];
    for (k, stored) in scene.histogram.chunks(BLOCK * scene.bins).enumerate() {
        let here = stored.len() / scene.bins;
        for (pixel, stored) in block
            .chunks_exact_mut(bins)
            .zip(stored.chunks_exact(scene.bins))
        {
            for (bin, of) in pixel.iter_mut().zip(stored.chunks_exact(merged)) {
                *bin = of.iter().sum();
            }
            scale(pixel, normalise);
        }
        for b in 0..bins {
            let row = &mut out[b * pixels + k * BLOCK..][..here];
            for (i, value) in row.iter_mut().enumerate() {
                *value = block[i * bins + b];
            }
        }
    }
}

/// Like [`planes`], but consumes the scene and takes a buffer of any length. If every number stays
/// in its place, the histogram is scaled there, and the scene receives the buffer of `out`.
///
/// # Panics
/// As for [`planes`].
pub fn planes_of(scene: &mut Scene, bins: usize, normalise: Normalise, out: &mut Vec<f32>) {
    if scene.order == Order::Bins && scene.bins == bins && normalise == Normalise::MinMax {
        std::mem::swap(&mut scene.histogram, out);
        return in_place(out, scene.pixels());
    }
    out.resize(bins * scene.pixels(), 0.0);
    planes(scene, bins, normalise, out);
}

/// Computes (h − min)/(max − min) for each pixel, bin by bin.
fn in_place(planes: &mut [f32], pixels: usize) {
    let (mut least, mut most) = ([0.0f32; STRIP], [0.0f32; STRIP]);
    for from in (0..pixels).step_by(STRIP) {
        let of = from..(from + STRIP).min(pixels);
        let (least, most) = (&mut least[..of.len()], &mut most[..of.len()]);
        least.fill(f32::INFINITY);
        most.fill(f32::NEG_INFINITY);
        for plane in planes.chunks_exact(pixels) {
            widen(&plane[of.clone()], least, most);
        }
        ranges(least, most);
        for plane in planes.chunks_exact_mut(pixels) {
            for (h, (least, range)) in plane[of.clone()].iter_mut().zip(least.iter().zip(&*most)) {
                *h = within(*h, *least, *range);
            }
        }
    }
}

/// Updates the least and the greatest value of each pixel.
#[inline]
fn widen(plane: &[f32], least: &mut [f32], most: &mut [f32]) {
    for ((h, least), most) in plane.iter().zip(least).zip(most) {
        // This gives the same results as `f32::min` and `max`, which compilers do not translate to
        // one instruction.
        *least = if *h < *least { *h } else { *least };
        *most = if *h > *most { *h } else { *most };
    }
}

/// Replaces the greatest value of each pixel by its range.
fn ranges(least: &mut [f32], most: &mut [f32]) {
    for (least, most) in least.iter_mut().zip(most) {
        // An infinite range makes all values zero.
        let range = *most - *least;
        *most = match range > 0.0 && range.is_finite() {
            true => range,
            false => f32::INFINITY,
        };
        if !least.is_finite() {
            *least = 0.0;
        }
    }
}

/// Computes [`planes`] of a histogram in bin order, with the same bits. A strip of pixels is read
/// twice, and stays in the second-level cache meanwhile.
fn strips(scene: &Scene, bins: usize, normalise: Normalise, out: &mut [f32]) {
    let (pixels, merged) = (scene.pixels(), scene.bins / bins);
    let (mut least, mut most) = ([0.0f32; STRIP], [0.0f32; STRIP]);
    let mut sums = [0.0f32; STRIP];
    for from in (0..pixels).step_by(STRIP) {
        let of = from..(from + STRIP).min(pixels);
        let len = of.len();
        let stored = |plane: usize| &scene.histogram[plane * pixels..][of.clone()];
        let (least, most) = (&mut least[..len], &mut most[..len]);
        least.fill(f32::INFINITY);
        most.fill(f32::NEG_INFINITY);
        for (b, plane) in out.chunks_exact_mut(pixels).enumerate() {
            let sum = match merged {
                1 => stored(b),
                _ => {
                    let sums = &mut sums[..len];
                    sums.copy_from_slice(stored(b * merged));
                    for k in 1..merged {
                        let more = stored(b * merged + k);
                        sums.iter_mut().zip(more).for_each(|(sum, h)| *sum += h);
                    }
                    plane[of.clone()].copy_from_slice(sums);
                    &*sums
                }
            };
            widen(sum, least, most);
        }
        if let Normalise::Log { .. } = normalise {
            for (b, plane) in out.chunks_exact_mut(pixels).enumerate() {
                let plane = &mut plane[of.clone()];
                if merged == 1 {
                    plane.copy_from_slice(stored(b));
                }
                scale(plane, normalise);
            }
            continue;
        }
        ranges(least, most);
        for (b, plane) in out.chunks_exact_mut(pixels).enumerate() {
            let plane = &mut plane[of.clone()];
            if merged == 1 {
                let of_bin = plane.iter_mut().zip(stored(b));
                for ((to, h), (least, range)) in of_bin.zip(least.iter().zip(most.iter())) {
                    *to = within(*h, *least, *range);
                }
            } else {
                for (h, (least, range)) in plane.iter_mut().zip(least.iter().zip(most.iter())) {
                    *h = within(*h, *least, *range);
                }
            }
        }
    }
}

/// Returns (h − least)/range, or 0 if that value is NaN or infinite.
#[inline]
fn within(h: f32, least: f32, range: f32) -> f32 {
    let scaled = (h - least) / range;
    if scaled.abs() <= f32::MAX {
        scaled
    } else {
        0.0
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

/// Computes (h − min)/(max − min); zeros if all values are equal or one is NaN or infinite.
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

/// Computes Σ_b h, scaled to 0..1 over the image.
pub fn intensity(scene: &Scene, out: &mut [f32]) {
    match scene.order {
        Order::Pixels => {
            for (sum, h) in out.iter_mut().zip(scene.histogram.chunks_exact(scene.bins)) {
                *sum = h.iter().sum();
            }
        }
        Order::Bins => {
            // Starts from the initial value of a sum, so that the bits are the same.
            out.fill(std::iter::empty::<f32>().sum());
            for plane in scene.histogram.chunks_exact(out.len()) {
                out.iter_mut().zip(plane).for_each(|(sum, h)| *sum += h);
            }
        }
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
    fn bin_by_bin_gives_the_bits_of_pixel_by_pixel() {
        let odd = [f32::INFINITY, f32::MAX, 0.0, 1e-30];
        let value = |i: usize| match i % 37 {
            0 => odd[i / 37 % 4],
            k => (k as f32).sin().powi(4) * 1e3,
        };
        // More pixels than a strip has, and one pixel that is dark.
        let (height, width, bins) = (50, 41, 13);
        let pixels = height * width;
        let mut pixel_by_pixel: Vec<f32> = (0..pixels * bins).map(value).collect();
        pixel_by_pixel[7 * bins..8 * bins].fill(0.0);
        let bin_by_bin = (0..pixels * bins).map(|i| pixel_by_pixel[i % pixels * bins + i / pixels]);
        let scene = |order, histogram| Scene {
            height,
            width,
            bins,
            histogram,
            order,
            ..Scene::default()
        };
        let other = scene(Order::Bins, bin_by_bin.collect());
        let one = scene(Order::Pixels, pixel_by_pixel);
        let bits = |values: &[f32]| values.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
        for normalise in [Normalise::MinMax, Normalise::Log { greatest: 50.0 }] {
            for bins in [13, 6, 4, 1] {
                let mut out = [(); 2].map(|()| vec![f32::NAN; bins * pixels]);
                planes(&one, bins, normalise, &mut out[0]);
                planes(&other, bins, normalise, &mut out[1]);
                assert_eq!(bits(&out[0]), bits(&out[1]), "{normalise:?} {bins}");
                for scene in [&one, &other] {
                    let mut room = vec![f32::NAN; 7];
                    planes_of(&mut scene.clone(), bins, normalise, &mut room);
                    assert_eq!(bits(&out[0]), bits(&room), "{normalise:?} {bins}");
                }
            }
        }
        let mut out = [(); 2].map(|()| vec![f32::NAN; pixels]);
        intensity(&one, &mut out[0]);
        intensity(&other, &mut out[1]);
        assert_eq!(bits(&out[0]), bits(&out[1]));
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
    fn bins_that_leave_out_a_part_of_the_gate_are_refused_with_those_that_do_not() {
        for (stored, bins, sums) in [
            (637, 637, 1),
            (637, 318, 2),
            (637, 127, 5),
            (1502, 375, 4),
            (64, 16, 4),
            (7, 1, 7),
        ] {
            assert_eq!(merged(stored, bins), Ok(sums), "{bins} of {stored}");
        }
        let said = merged(637, 320).unwrap_err();
        assert!(
            said.contains("leave out 317") && said.contains("637 (sums of 1) or 318 (sums of 2)"),
            "{said}"
        );
        for (stored, bins) in [(637, 128), (10, 6), (8, 0), (8, 9)] {
            assert!(merged(stored, bins).is_err(), "{bins} of {stored}");
        }
        // The numbers that an error suggests are themselves valid.
        for (stored, bins) in [(637, 320), (637, 128), (100, 30)] {
            let k = stored / bins;
            assert_eq!(merged(stored, stored / k), Ok(k));
            assert_eq!(merged(stored, stored / (k + 1)), Ok(k + 1));
        }
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
