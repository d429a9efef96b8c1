//! Chooses the time gate of a render.

use picofarm_figures::number::short;
use picofarm_proto::spec::RenderSettings;
use picofarm_scene::Scene;

use crate::args::{GateArgs, GateChoice, RenderArgs};

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
    let Some(fitted) = scene.fitted_gate(args.gate.gate()) else {
        return args.gate;
    };
    if fitted.usual_fits && !auto {
        return args.gate;
    }
    let [first, last] = fitted.path_range_m;
    let chosen = GateArgs {
        gate_start_m: fitted.gate.start_m,
        // A scene of kilometres is most likely in another unit; it is rendered all the same.
        bin_width_m: fitted.gate.bin_width_m.min(RenderSettings::MAX_BIN_M),
        bins,
    };
    let unit = match chosen.bin_width_m < fitted.gate.bin_width_m {
        true => ", and --unit mm reads the file in millimetres",
        false => "",
    };
    scene.provenance.notes.insert(
        "chosen.gate".into(),
        format!(
            "{} bins of {} m from {} m, because light of one and two bounces arrives between {} and {} m; --gate changes it{unit}",
            bins,
            short(chosen.bin_width_m),
            short(chosen.gate_start_m),
            short(first),
            short(last)
        ),
    );
    chosen
}
