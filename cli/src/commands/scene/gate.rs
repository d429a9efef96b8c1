//! Chooses the time gate of a render.

use picofarm_figures::number::short;
use picofarm_scene::Scene;

use crate::args::{GateArgs, GateChoice, RenderArgs};

/// The least number of bins between a scene's first and last light for which the default gate is
/// kept.
const LEAST_BINS: f64 = 24.0;
/// How far a chosen gate reaches beyond the last light of two bounces, for longer paths.
const BEYOND: f64 = 1.25;

/// Returns the stated gate, or one that fits the scene. The choice is added to the scene's notes.
pub fn choose(args: &RenderArgs, scene: &mut Scene) -> GateArgs {
    let bins = args.gate.bins;
    let within = |[start, end]: [f64; 2]| GateArgs {
        gate_start_m: start,
        bin_width_m: (end - start) / f64::from(bins),
        bins,
    };
    let auto = match args.gate_choice {
        Some(GateChoice::Range(range)) => return within(range),
        Some(GateChoice::Auto) => true,
        None => false,
    };
    let stated = args.gate != GateArgs::USUAL;
    if stated && !auto {
        return args.gate;
    }
    let Some([first, last]) = scene.path_range_m() else {
        return args.gate;
    };
    let usual = args.gate.gate();
    let end = usual.start_m + usual.bin_width_m * f64::from(usual.bins);
    let fits =
        first >= usual.start_m && last <= end && last - first >= LEAST_BINS * usual.bin_width_m;
    if fits && !auto {
        return args.gate;
    }
    let start = 0.9 * first;
    let width = BEYOND * (last - start) / f64::from(bins);
    // Three digits, rounded up.
    let digits = 10f64.powf(2.0 - width.log10().floor());
    let width = (width * digits).ceil() / digits;
    let chosen = GateArgs {
        gate_start_m: (start * digits).floor() / digits,
        bin_width_m: width,
        bins,
    };
    scene.provenance.notes.insert(
        "chosen.gate".into(),
        format!(
            "{} bins of {} m from {} m, because light of one and two bounces arrives between {} and {} m; --gate changes it",
            bins,
            short(chosen.bin_width_m),
            short(chosen.gate_start_m),
            short(first),
            short(last)
        ),
    );
    chosen
}
