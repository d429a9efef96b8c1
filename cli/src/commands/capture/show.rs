//! `picofarm capture show`: what a capture has.

use std::path::Path;

use picofarm_dataset::SINGLE_PICTURE;
use picofarm_exchange::capture::{Beam, Capture};
use serde_json::{Value, json};

use super::read;
use crate::{error::Result, output::Output};

/// Lines of the table of spots that are printed.
const SHOWN: usize = 32;

/// Shows a capture.
///
/// # Errors
/// A folder that is no capture, or damaged.
pub fn run(folder: &Path, output: Output) -> Result<()> {
    let capture = read(folder)?;
    let mut facts = facts(&capture);
    facts["picture"] = json!(folder.join(SINGLE_PICTURE));
    output.result(&facts, || {
        let mut text = format!("{}: {}", folder.display(), describe(&capture));
        text += &spots(&capture, &facts);
        text + &format!("  picture: {}\n", folder.join(SINGLE_PICTURE).display())
    });
    Ok(())
}

/// Light of histograms `[pixel][bin]`.
struct Light {
    total: f64,
    /// The brightest bin.
    peak: f32,
    /// Path at the middle of that bin, metres.
    peak_m: f64,
    /// Mean of a pixel and bin in the quietest twentieth of the gate.
    background: f64,
}

impl Light {
    fn new(h: &[f32], capture: &Capture) -> Self {
        let (bins, gate) = (capture.gate.bins as usize, &capture.gate);
        let mut by_bin = vec![0.0f64; bins];
        let (mut peak, mut at) = (0.0f32, 0);
        for pixel in h.chunks_exact(bins) {
            for (bin, x) in pixel.iter().enumerate() {
                by_bin[bin] += f64::from(*x);
                if *x > peak {
                    (peak, at) = (*x, bin);
                }
            }
        }
        let window = (bins / 20).max(1);
        let quietest = by_bin
            .windows(window)
            .map(|w| w.iter().sum::<f64>())
            .fold(f64::INFINITY, f64::min);
        Self {
            total: by_bin.iter().sum(),
            peak,
            peak_m: gate.start_m + (at as f64 + 0.5) * gate.bin_width_m,
            background: quietest / (window * capture.pixels()) as f64,
        }
    }

    fn facts(&self) -> Value {
        json!({
            "photons": self.total, "peak": self.peak, "peak_m": self.peak_m, "background": self.background,
        })
    }
}

/// Returns what `--json` prints.
pub fn facts(capture: &Capture) -> Value {
    let i = capture.intrinsics;
    let beams = capture.beams.iter().enumerate().map(|(k, beam)| {
        let mut fact = match beam {
            Beam::Spot { position, path_m } => json!({"position_m": position, "path_m": path_m}),
            Beam::Direction(way) => json!({"direction": way}),
            Beam::Nothing => json!({"nothing": true}),
        };
        if let (Some(h), Some(fact)) = (capture.spot(k), fact.as_object_mut()) {
            fact.extend(
                Light::new(h, capture)
                    .facts()
                    .as_object()
                    .cloned()
                    .unwrap_or_default(),
            );
        }
        fact
    });
    let mut facts = json!({
        "name": capture.name,
        "format": capture.origin.format,
        "height": capture.height,
        "width": capture.width,
        "gate": capture.gate,
        "per_spot": capture.per_spot.is_some(),
        "intrinsics": {"fx": i.fx, "fy": i.fy, "cx": i.cx, "cy": i.cy},
        "laser_m": capture.laser,
        "depth": capture.depth.is_some(),
        "outside": capture.origin.outside,
        "cropped": capture.origin.cropped,
        "conversions": capture.origin.conversions,
        "spots": beams.collect::<Vec<_>>(),
    });
    let all = Light::new(&capture.sum, capture).facts();
    if let (Some(facts), Some(all)) = (facts.as_object_mut(), all.as_object()) {
        facts.extend(all.clone());
    }
    facts
}

/// Describes a capture in a few lines.
pub fn describe(capture: &Capture) -> String {
    let (gate, all) = (&capture.gate, Light::new(&capture.sum, capture));
    let known = capture.beams.iter();
    let known = known.filter(|b| matches!(b, Beam::Spot { .. })).count();
    let kept = match capture.per_spot {
        Some(_) => "a histogram for each spot",
        None => "one histogram of all spots",
    };
    let mut text = format!(
        "{}x{} pixels, {} bins of {:.4} m from {:.4} to {:.4} m of path; {} spots ({known} with a position), {kept}\n",
        capture.width,
        capture.height,
        gate.bins,
        gate.bin_width_m,
        gate.start_m,
        gate.end_m(),
        capture.beams.len(),
    );
    let each = all.total / capture.beams.len().max(1) as f64;
    text += &format!(
        "  light: {:.4e}, {each:.4e} a spot; brightest bin {} at {:.3} m; background {:.3e} a pixel and bin\n",
        all.total, all.peak, all.peak_m, all.background
    );
    if capture.origin.outside > 0.0 {
        let share = 100.0 * capture.origin.outside / (capture.origin.outside + all.total);
        text += &format!(
            "  outside the gate: {:.4e}, {share:.2} % of the light of the files\n",
            capture.origin.outside
        );
    }
    if capture.origin.cropped > 0.0 {
        text += &format!(
            "  of pixels that were cropped away: {:.4e}\n",
            capture.origin.cropped
        );
    }
    text
}

/// The table of spots.
fn spots(capture: &Capture, facts: &Value) -> String {
    let mut text = String::new();
    for (k, beam) in capture.beams.iter().enumerate().take(SHOWN) {
        let place = match beam {
            Beam::Spot {
                position: [x, y, z],
                path_m,
            } => {
                format!("at {x:.3}, {y:.3}, {z:.3} m, {path_m:.3} m from the laser")
            }
            Beam::Direction([x, y, z]) => format!("towards {x:.3}, {y:.3}, {z:.3}"),
            Beam::Nothing => "meets nothing".into(),
        };
        text += &format!("  spot {k}: {place}");
        let fact = &facts["spots"][k];
        if let (Some(photons), Some(peak)) = (fact["photons"].as_f64(), fact["peak_m"].as_f64()) {
            text += &format!("; light {photons:.4e}, brightest bin at {peak:.3} m");
        }
        text += "\n";
    }
    match capture.beams.len().saturating_sub(SHOWN) {
        0 => text,
        more => text + &format!("  and {more} spots more (--json has all)\n"),
    }
}
