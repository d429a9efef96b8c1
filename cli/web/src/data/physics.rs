//! Whether a scene's light agrees with its geometry: energy by bounces, peak times, first light,
//! and the errors that its manifest states.

use rayon::prelude::*;
use serde_json::{Value, json};

use super::{Truth, histogram::two_bounce, volume::Volume};
use crate::answer::Problem;

/// Largest shift of the histograms against the predicted times that is tried, bins.
const SHIFT: i64 = 8;
/// Bins by which light may seem early, because a pixel and its bins have a width.
const EDGE: i64 = 2;
/// Share of pixels with earlier light above which a scene is doubtful.
const EARLY: f64 = 0.02;
/// Least brightness at predicted times, compared with that of times a few bins away.
const CONTRAST: f64 = 1.2;
/// Most bins between the brightest shift and none.
const OFF: f64 = 1.0;

/// Sums over pixels.
#[derive(Default)]
struct Sums {
    /// h at the predicted two-bounce times, by shift, as a share of the pixel's light. Pixels at a
    /// spot are left out.
    shifted: [f64; 2 * SHIFT as usize + 1],
    /// Pairs of pixel and lit spot.
    pairs: u64,
    /// h at times of one bounce, of two bounces, and at others.
    energy: [f64; 3],
    /// Pixels with light, and those with light before any possible path.
    lit: u64,
    early: u64,
}

/// Compares the light of all spots with the geometry of the ground truth. Mirrors are left out of
/// times, because light comes to them by other ways. `parts` are the light of two bounces, and of
/// three and more, where the render has them.
///
/// # Errors
/// Fails if an array that the times follow from is damaged.
pub fn verdict(
    truth: &Truth,
    volume: &Volume,
    parts: Option<[&Volume; 2]>,
) -> Result<Value, Problem> {
    let gate = &truth.spec.gate;
    let bin_of = |path: f64| {
        let bin = (path - gate.start_m) / gate.bin_width_m;
        bin.floor() as i64
    };
    let (spots, mirrors) = (truth.spots.as_ref()?, truth.specular.as_ref()?);
    let (masks, pixels) = (truth.visibility.as_ref()?, truth.spec.pixels());
    truth.depth.as_ref()?;
    truth.intrinsics.as_ref()?;
    let own = own_pixels(truth)?;
    let least = least_paths(truth, &own)?;
    let width = (truth.spec.width as usize).max(1);
    // The light of a spot itself would outshine that of two bounces.
    let mut at_spot = vec![false; pixels];
    for (pixel, _) in &own {
        neighbours(*pixel, width, pixels).for_each(|p| at_spot[p] = true);
    }
    let of_pixel = |mut sums: Sums, pixel: usize| -> Result<Sums, Problem> {
        let h = volume.histogram(pixel);
        let Some(first) = h.iter().position(|h| *h > 0.0) else {
            return Ok(sums);
        };
        let Some(point) = truth.point(pixel)? else {
            sums.energy[2] += total(&h);
            return Ok(sums);
        };
        let mut kinds = vec![2u8; h.len()];
        let mut mark = |bin: i64, kind: u8| {
            for b in bin - 1..=bin + 1 {
                if let Some(found) = usize::try_from(b).ok().and_then(|b| kinds.get_mut(b)) {
                    *found = kind.min(*found);
                }
            }
        };
        let within = |bin: i64| {
            let bin = usize::try_from(bin).ok();
            f64::from(bin.and_then(|bin| h.get(bin)).copied().unwrap_or(0.0))
        };
        // Bright pixels count no more than dark ones.
        let unit = total(&h).recip();
        for (index, spot) in spots.iter().enumerate() {
            let Some(spot) = spot else { continue };
            let bin = bin_of(two_bounce(spot, point));
            if masks[index * pixels + pixel] != 1 || mirrors[pixel] == 1 {
                continue;
            }
            mark(bin, 1);
            // Pairs whose shifts are all in the gate count alike for each.
            if bin >= SHIFT && bin + SHIFT < h.len() as i64 && !at_spot[pixel] {
                sums.pairs += 1;
                for (sum, shift) in sums.shifted.iter_mut().zip(-SHIFT..=SHIFT) {
                    *sum += unit * within(bin + shift);
                }
            }
        }
        for (_, path) in own.iter().filter(|(own, _)| *own == pixel) {
            mark(bin_of(*path), 0);
        }
        // A pixel at an edge also sees the surface of a neighbour.
        let earliest = neighbours(pixel, width, pixels).map(|p| least[p]);
        let earliest = earliest.fold(f64::INFINITY, f64::min);
        sums.lit += 1;
        sums.early += u64::from(earliest.is_finite() && first as i64 + EDGE < bin_of(earliest));
        for (h, kind) in h.iter().zip(&kinds) {
            sums.energy[usize::from(*kind)] += f64::from(*h);
        }
        Ok(sums)
    };
    // Rows are added in order, so that the figures do not depend on threads.
    let rows: Vec<Sums> = (0..truth.spec.height as usize)
        .into_par_iter()
        .map(|row| (row * width..(row + 1) * width).try_fold(Sums::default(), &of_pixel))
        .collect::<Result<_, Problem>>()?;
    let sums = rows.into_iter().fold(Sums::default(), join);
    let rendered = parts.map(|parts| {
        let [two, more] =
            parts.map(|part| (0..pixels).map(|p| total(&part.histogram(p))).sum::<f64>());
        let all: f64 = sums.energy.iter().sum();
        [(all - two - more).max(0.0), two, more]
    });
    Ok(assess(truth, &sums, rendered))
}

fn total(h: &[f32]) -> f64 {
    h.iter().map(|h| f64::from(*h)).sum()
}

/// Returns the pixels that contain spots, each with the path of its one-bounce light.
fn own_pixels(truth: &Truth) -> Result<Vec<(usize, f64)>, Problem> {
    let mut found = Vec::new();
    for spot in truth.spots.as_ref()?.iter().flatten() {
        let Some([x, y]) = truth.film(spot)? else {
            continue;
        };
        let inside = |at: f32, size: u32| (0.0..size as f32).contains(&at);
        if inside(x, truth.spec.width) && inside(y, truth.spec.height) {
            let pixel = y as usize * truth.spec.width as usize + x as usize;
            let position = spot.position.map(f64::from);
            let path = f64::from(spot.path_m) + super::histogram::length(position);
            found.push((pixel, path));
        }
    }
    Ok(found)
}

/// Returns for each pixel the shortest path by any spot, lit or not: no light comes by a shorter
/// one. Infinite for pixels that see nothing.
fn least_paths(truth: &Truth, own: &[(usize, f64)]) -> Result<Vec<f64>, Problem> {
    let spots: Vec<_> = truth.spots.as_ref()?.iter().flatten().collect();
    let mut least = (0..truth.spec.pixels())
        .map(|pixel| {
            let point = truth.point(pixel)?;
            let paths = point.map(|point| spots.iter().map(move |spot| two_bounce(spot, point)));
            Ok(paths.into_iter().flatten().fold(f64::INFINITY, f64::min))
        })
        .collect::<Result<Vec<f64>, Problem>>()?;
    for (pixel, path) in own {
        least[*pixel] = least[*pixel].min(*path);
    }
    Ok(least)
}

/// Returns a pixel and those around it.
fn neighbours(pixel: usize, width: usize, pixels: usize) -> impl Iterator<Item = usize> {
    let (row, column) = (pixel / width, pixel % width);
    let near = |at: usize, end: usize| at.saturating_sub(1)..(at + 2).min(end);
    near(row, pixels / width).flat_map(move |r| near(column, width).map(move |c| r * width + c))
}

fn join(mut a: Sums, b: Sums) -> Sums {
    a.shifted
        .iter_mut()
        .zip(b.shifted)
        .for_each(|(a, b)| *a += b);
    a.energy.iter_mut().zip(b.energy).for_each(|(a, b)| *a += b);
    a.pairs += b.pairs;
    a.lit += b.lit;
    a.early += b.early;
    a
}

fn assess(truth: &Truth, sums: &Sums, rendered: Option<[f64; 3]>) -> Value {
    let bin_m = truth.spec.gate.bin_width_m;
    let (peak, contrast) = match sums.pairs {
        0 => (None, None),
        _ => (peak(&sums.shifted), contrast(&sums.shifted)),
    };
    let early = match sums.lit {
        0 => None,
        lit => Some(sums.early as f64 / lit as f64),
    };
    let mut reasons = Vec::new();
    if let Some(peak) = peak.filter(|peak| peak.abs() > OFF) {
        reasons.push(format!(
            "two-bounce peaks are {peak:+.1} bins ({:+.3} m) from their predicted times",
            peak * bin_m
        ));
    }
    if let Some(contrast) = contrast.filter(|contrast| *contrast < CONTRAST) {
        reasons.push(format!(
            "predicted times are only {contrast:.2} times as bright as others"
        ));
    }
    if let Some(early) = early.filter(|early| *early > EARLY) {
        reasons.push(format!(
            "{:.1} % of the pixels have light before any path can bring it",
            100.0 * early
        ));
    }
    let compared = peak.is_some() && early.is_some();
    let verdict = match (compared, reasons.is_empty()) {
        (false, _) => "nothing to compare",
        (true, true) => "agrees",
        (true, false) => "does not agree",
    };
    let energy = rendered.unwrap_or(sums.energy);
    let all: f64 = energy.iter().sum();
    let shares = (all > 0.0).then(|| energy.map(|e| e / all));
    let manifest = &truth.manifest;
    let plan = &manifest.provenance.plan;
    json!({
        "verdict": verdict, "reasons": reasons,
        "shares": shares, "rendered_apart": rendered.is_some(),
        "peak_bins": peak, "peak_m": peak.map(|peak| peak * bin_m), "contrast": contrast,
        "pairs": sums.pairs, "early": early,
        "error": plan["error"], "outside": plan["overflow"]["share"],
        "coding_rms_sigma": manifest.error.rms_sigma,
    })
}

/// Returns the shift of the brightest sum, by a parabola through it and its neighbours.
fn peak(sums: &[f64]) -> Option<f64> {
    let at = (0..sums.len()).max_by(|a, b| sums[*a].total_cmp(&sums[*b]))?;
    let shift = at as f64 - SHIFT as f64;
    if sums[at] <= 0.0 {
        return None;
    }
    let (Some(before), Some(after)) = (at.checked_sub(1).map(|b| sums[b]), sums.get(at + 1)) else {
        return Some(shift);
    };
    let curve = before - 2.0 * sums[at] + after;
    let part = if curve < 0.0 {
        0.5 * (before - after) / curve
    } else {
        0.0
    };
    Some(shift + part)
}

/// Returns the brightness at the predicted times over the mean of those four bins and more away.
fn contrast(sums: &[f64]) -> Option<f64> {
    let middle = SHIFT as usize;
    let far = |(at, _): &(usize, &f64)| at.abs_diff(middle) >= 4;
    let (count, sum) = sums
        .iter()
        .enumerate()
        .filter(far)
        .fold((0.0, 0.0), |(n, sum), (_, s)| (n + 1.0, sum + s));
    (sum > 0.0).then(|| sums[middle] / (sum / count))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_shift_is_found_to_a_part_of_a_bin() {
        let shape = |centre: f64| -> Vec<f64> {
            (-SHIFT..=SHIFT)
                .map(|shift| (-(shift as f64 - centre).powi(2) / 8.0).exp())
                .collect()
        };
        for centre in [0.0, 2.25, -3.5] {
            let found = peak(&shape(centre)).unwrap();
            assert!((found - centre).abs() < 0.1, "{found} {centre}");
        }
        assert!(contrast(&shape(0.0)).unwrap() > 2.0);
        assert!(contrast(&shape(6.0)).unwrap() < 1.0);
        assert_eq!(peak(&[0.0; 17]), None);
    }
}
