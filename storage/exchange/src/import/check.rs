//! Checks that the histograms fit the geometry: two-bounce light from a lit spot must arrive at its
//! time of flight.
//!
//! For a sample of pixels, the energy at the predicted bin of each lit spot, relative to the
//! pixel's total, is averaged. The same is done for some bins before and after. If gate, units,
//! depth, spots, masks and image axes are interpreted correctly, the average peaks at the predicted
//! bin. If another interpretation of the same files fits better, the import is refused.

use std::path::Path;

use serde_json::{Value, json};

use super::ImportError;
use super::masks;
use super::profile::{
    BETTER, Blame, CONTRAST, Geometry, MIN_PAIRS, Reading, TOLERANCE, Which, profile, profile_of,
    step,
};
use super::vector::norm;
use picofarm_dataset::Spot;

/// Maximum distance of spots from the surface in the depth image, relative to their depth.
const OFF_SURFACE: f64 = 0.05;

/// Checks a scene. Returns the results.
///
/// # Errors
/// [`ImportError::Refused`], with the interpretation that fits better, if there is one.
pub(super) fn check(g: &Geometry<'_>, blame: &Blame<'_>) -> Result<Value, ImportError> {
    let surface = on_surface(g, blame)?;
    let own = Reading::default();
    let hint = "see whether the files belong together, or import them as they are with --unchecked";
    let all = profile(g, own, Which::All);
    if all.pairs < MIN_PAIRS {
        let expected = format!(
            "at least {MIN_PAIRS} pairs of a sampled pixel and a spot, with light in the gate"
        );
        let found = format!("{}, too few to check anything", all.pairs);
        return Err(ImportError::refused(
            blame.histogram,
            "light",
            expected,
            found,
            hint,
        ));
    }
    // The polarity of the masks is checked last, because wrong masks must not be reported as a
    // wrong gate.
    let step = step(g) as f64 * g.shape.gate.bin_width_m;
    let peak = all.peak();
    let clear = all.at(peak) > all.background() * CONTRAST;
    if peak.abs() > TOLERANCE && all.at(peak) > all.hit() * BETTER && clear {
        let expected = format!(
            "two-bounce light at the time of flight that depth and spots predict, within {:.4} m of path",
            TOLERANCE as f64 * step
        );
        let found = format!(
            "it {:.4} m of path {} the prediction",
            peak.unsigned_abs() as f64 * step,
            if peak > 0 { "after" } else { "before" }
        );
        let hint = format!(
            "the gate may be another one: {}; or import as it is with --unchecked",
            blame.hint
        );
        return Err(ImportError::refused(
            blame.histogram,
            "gate",
            expected,
            found,
            hint,
        ));
    }
    readings(g, blame, all.excess())?;
    let lit = profile(g, own, Which::Lit);
    masks::polarity(g, blame, &lit)?;
    let separation = masks::order(g, blame, &lit)?;
    if lit.pairs < MIN_PAIRS {
        let expected =
            format!("at least {MIN_PAIRS} pairs of a sampled pixel and a spot that lights it");
        let found = format!("{}, too few to check anything", lit.pairs);
        return Err(ImportError::refused(
            blame.visibility,
            "lit pixels",
            expected,
            found,
            hint,
        ));
    }
    let (hit, background) = (lit.hit(), lit.background());
    if hit < background * CONTRAST || hit == 0.0 {
        let expected = format!(
            "energy at the predicted bins {CONTRAST} times that of the bins around them at least"
        );
        let found = format!("{:.2} times", hit / background.max(f64::MIN_POSITIVE));
        return Err(ImportError::refused(
            blame.histogram,
            "two-bounce light",
            expected,
            found,
            format!(
                "units, gate, intrinsics or the number of spots may be others: {}; or import as it is with --unchecked",
                blame.hint
            ),
        ));
    }
    let (weakest, contrast) = weakest_spot(g).unzip();
    Ok(json!({
        "weakest_spot": weakest, "weakest_spot_contrast": contrast.map(round),
        "pairs": lit.pairs, "tolerance_m": TOLERANCE as f64 * step, "peak_shift_m": peak as f64 * step,
        "energy_at_prediction": round(hit), "energy_around": round(background),
        "spots_off_surface": surface.map(round), "lit_over_shadow": separation.map(round),
    }))
}

/// Returns the spot with the weakest two-bounce light, and its energy at the prediction relative to
/// the surroundings.
fn weakest_spot(g: &Geometry<'_>) -> Option<(usize, f64)> {
    let of = |(mask, spot): (usize, &Option<Spot>)| -> Option<(usize, f64)> {
        let one = profile_of(g, Reading::default(), Which::Lit, &[(mask, (*spot)?)]);
        let contrast = one.hit() / one.background().max(f64::MIN_POSITIVE);
        (one.pairs >= MIN_PAIRS).then_some((mask, contrast))
    };
    let all = g.spots.iter().enumerate().filter_map(of);
    all.min_by(|a, b| a.1.total_cmp(&b.1))
}

/// Rounds to few digits, because people also read the manifest.
fn round(x: f64) -> f64 {
    libm::round(x * 1e6) / 1e6
}

/// Returns an error if another interpretation fits better.
fn readings(g: &Geometry<'_>, blame: &Blame<'_>, own: f64) -> Result<(), ImportError> {
    let depth = Reading {
        other_depth: true,
        ..Reading::default()
    };
    let spots = |x, y| Reading {
        flip_spots: [x, y],
        ..Reading::default()
    };
    let image = |x, y| Reading {
        flip_image: [x, y],
        ..Reading::default()
    };
    let turn = "turn the array round, or import as it is with --unchecked";
    let others = [
        (
            depth,
            blame.depth,
            "kind of depth",
            if g.of_range {
                "distances along the rays, as was said"
            } else {
                "z-depth"
            },
            if g.of_range {
                "a better fit as z-depth"
            } else {
                "a better fit as distances along the rays"
            },
            "say so (--depth z or range, or the depth's kind in scene.json), or import as it is with --unchecked",
        ),
        (
            spots(true, false),
            blame.spots,
            "x axis of the spots",
            "x to the right",
            "a better fit with x to the left",
            turn,
        ),
        (
            spots(false, true),
            blame.spots,
            "y axis of the spots",
            "y downwards",
            "a better fit with y upwards",
            turn,
        ),
        (
            spots(true, true),
            blame.spots,
            "axes of the spots",
            "x to the right, y downwards",
            "a better fit with both turned round",
            turn,
        ),
        (
            image(true, false),
            blame.histogram,
            "columns",
            "the depth image's order",
            "a better fit from right to left",
            turn,
        ),
        (
            image(false, true),
            blame.histogram,
            "rows",
            "the depth image's order",
            "a better fit from bottom to top",
            turn,
        ),
        (
            image(true, true),
            blame.histogram,
            "rows and columns",
            "the depth image's order",
            "a better fit with both turned round",
            turn,
        ),
    ];
    let mut best: Option<(f64, &Path, &str, &str, &str, &str)> = None;
    for (reading, file, field, expected, found, hint) in others {
        let other = profile(g, reading, Which::All);
        let excess = other.excess();
        let beaten = best.as_ref().is_none_or(|(e, ..)| excess > *e);
        if other.pairs >= MIN_PAIRS && excess > own.max(0.0) * BETTER + 1e-6 && beaten {
            let clear = other.hit() > other.background() * CONTRAST;
            if clear {
                best = Some((excess, file, field, expected, found, hint));
            }
        }
    }
    match best {
        None => Ok(()),
        Some((excess, file, field, expected, found, hint)) => {
            let found = format!(
                "{found} ({:.5} of a pixel's energy stands out at the predicted bins, instead of {:.5})",
                excess,
                own.max(0.0)
            );
            Err(ImportError::refused(file, field, expected, found, hint))
        }
    }
}

/// Returns the distance of the spots from the depth image, as the median of |Δz|/z, where z is
/// between a pixel's depth and its neighbours'. This requires a laser at the camera, so that the
/// spots are visible.
fn on_surface(g: &Geometry<'_>, blame: &Blame<'_>) -> Result<Option<f64>, ImportError> {
    if norm(g.laser.map(f64::from)) > 0.02 {
        return Ok(None);
    }
    let i = g.intrinsics;
    let mut seen: Vec<(f64, f64)> = Vec::new();
    for spot in g.spots.iter().flatten() {
        let [x, y, z] = spot.position.map(f64::from);
        if z <= 0.0 {
            continue;
        }
        let column = libm::floor(f64::from(i.fx) * x / z + f64::from(i.cx));
        let row = libm::floor(f64::from(i.fy) * y / z + f64::from(i.cy));
        let (w, h) = (g.shape.width as usize, g.shape.height as usize);
        if !(0.0..w as f64).contains(&column) || !(0.0..h as f64).contains(&row) {
            continue;
        }
        let (row, column) = (row as usize, column as usize);
        let depth = f64::from(g.depth[row * w + column]);
        if depth <= 0.0 || g.specular[row * w + column] != 0 {
            continue;
        }
        // A pixel's depth belongs to its centre, so the spot's depth is between those of the
        // surrounding pixels.
        let rows = row.saturating_sub(1)..(row + 2).min(h);
        let near = rows.flat_map(|r| {
            let columns = column.saturating_sub(1)..(column + 2).min(w);
            columns.map(move |c| f64::from(g.depth[r * w + c]))
        });
        let near = near.filter(|d| *d > 0.0);
        let (low, high) = near.fold((depth, depth), |(a, b), d| (a.min(d), b.max(d)));
        let off = (low - z).max(z - high).max(0.0);
        seen.push((off / depth, z / depth));
    }
    if seen.is_empty() {
        return Ok(None);
    }
    let median = |mut all: Vec<f64>| {
        all.sort_by(f64::total_cmp);
        all[all.len() / 2]
    };
    let off = median(seen.iter().map(|s| s.0).collect());
    if off > OFF_SURFACE {
        let ratio = median(seen.iter().map(|s| s.1).collect());
        return Err(ImportError::refused(
            blame.spots,
            "positions",
            format!(
                "spots on the surface of {}, in metres",
                blame.depth.display()
            ),
            format!(
                "z of the spots {ratio:.3} times the depth where they project to (median of {})",
                seen.len()
            ),
            format!(
                "units or axes may be others: {}; or import as they are with --unchecked",
                blame.hint
            ),
        ));
    }
    Ok(Some(off))
}
