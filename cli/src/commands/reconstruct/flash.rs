//! `picofarm reconstruct --spots-from flash`: times and masks from a single histogram of all spots,
//! by physics. No ground truth is used: the input is the histogram and the positions of the spots.

use picofarm_demultiplex::{
    Capture, Place, Settings, Spot, Truth, VERSION, demultiplex, residual, score,
};
use picofarm_reconstruct::{
    Measured,
    source::{CaptureSettings, from_flash},
};
use picofarm_scene::Scene;
use picofarm_transient::render;
use serde_json::{Value, json};

use super::{fits_memory, refused, watch::Watch};
use crate::{
    args::Reconstruct,
    error::{CliError, Result},
};

/// Renders the histogram and takes it apart. Returns the measurements, and their errors for
/// metrics.json.
///
/// # Errors
/// Fails on a failed render, a gate that the method cannot use, or an interruption.
pub fn measure(
    args: &Reconstruct,
    scene: &Scene,
    threads: usize,
    watch: &Watch,
) -> Result<(Measured, Value)> {
    let settings = CaptureSettings {
        gate: args.gate.gate(),
        samples: args.samples,
        seed: args.seed,
        sensor: None,
    };
    fits_memory(&settings, scene, threads)?;
    let rendered = render(scene, &settings.render_settings(), &AllSpots(watch))
        .map_err(|e| refused(e.into()))?;
    let (beams, spots): (Vec<usize>, Vec<Spot>) = rendered
        .spots
        .iter()
        .enumerate()
        .filter_map(|(beam, spot)| {
            let spot = spot.as_ref()?;
            let place = Place {
                point: spot.point,
                path_m: spot.path_m,
            };
            let found = Spot {
                direction: scene.laser.beams[beam].direction,
                place: Some(place),
            };
            Some((beam, found))
        })
        .unzip();
    let capture = Capture {
        histogram: &rendered.transient,
        gate: settings.gate,
        camera: &scene.camera,
        laser: scene.laser.origin,
        spots: &spots,
    };
    watch.step("flash taken apart", 0.0);
    let found = demultiplex(&capture, &Settings::default())
        .map_err(|e| CliError::input(format!("{}: {e}", args.file.display())))?;
    let pixels = capture.pixels();
    let visibility: Vec<u8> = beams
        .iter()
        .flat_map(|beam| &rendered.truth.visibility[beam * pixels..][..pixels])
        .copied()
        .collect();
    let truth = Truth {
        depth_m: &rendered.truth.depth,
        specular: &rendered.truth.specular,
        visibility: &visibility,
    };
    let facts = json!({
        "version": VERSION,
        "residual": residual(&capture, &found),
        "depth": score::depth(&found.depth_m, &truth),
        "masks": score::masks(&found, &truth),
    });
    let measured = from_flash(&capture, &found, &beams).map_err(refused)?;
    Ok((measured, facts))
}

/// Forwards the render's progress.
pub(super) struct AllSpots<'a>(pub &'a Watch);

impl picofarm_transient::Progress for AllSpots<'_> {
    fn at(&self, done: f32) -> bool {
        self.0.step("capture of all spots", done)
    }
}
