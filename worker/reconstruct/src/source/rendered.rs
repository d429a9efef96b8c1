//! Measurements of a scene file, and the renders that they require.

use picofarm_scene::Scene;
use picofarm_settings::Sensor;
use picofarm_transient::{Budget, Gate, Progress, Rendered, Settings, render};

use super::{Captures, LIT_THRESHOLD};
use crate::{Measured, ReconstructError};

/// The share of a capture's light outside the gate from which its times are unreliable.
const MOST_OUTSIDE: f64 = 0.5;

/// The settings for rendering captures.
#[derive(Debug, Clone, PartialEq)]
pub struct CaptureSettings {
    /// The gate of the histograms.
    pub gate: Gate,
    /// The number of camera paths per pixel for three bounces and more.
    pub samples: u32,
    /// The seed of the renders, and of the detector's noise.
    pub seed: u64,
    /// The detector; if `None`, the rendered light is measured without noise.
    pub sensor: Option<Sensor>,
}

impl CaptureSettings {
    /// Returns the renderer's settings for one capture.
    pub fn render_settings(&self) -> Settings {
        Settings {
            one_bounce: true,
            seed: self.seed,
            ..Settings::new(self.gate, Budget::Samples(self.samples))
        }
    }
}

/// Computes the ground truth and spots of a scene, which is fast because no histogram is rendered.
///
/// # Errors
/// [`ReconstructError::Render`].
pub fn truth_of(scene: &Scene, progress: &dyn Progress) -> Result<Rendered, ReconstructError> {
    let gate = Gate {
        start_m: 0.0,
        bin_width_m: 1e6,
        bins: 1,
    };
    let settings = Settings {
        max_bounces: Some(1),
        ..Settings::new(gate, Budget::Samples(1))
    };
    Ok(render(scene, &settings, progress)?)
}

/// A callback for the progress of captures: the number of the capture, from 0, and its finished
/// share. It returns `false` to stop.
pub type CaptureProgress<'a> = &'a (dyn Fn(usize, f32) -> bool + Sync);

struct OfCapture<'a>(usize, CaptureProgress<'a>);

impl Progress for OfCapture<'_> {
    fn at(&self, done: f32) -> bool {
        (self.1)(self.0, done)
    }
}

/// Renders a separate capture of each beam, with all bounces, and measures times and masks in it.
///
/// # Errors
/// [`ReconstructError::Render`]; [`ReconstructError::Invalid`] if most of a capture's light is
/// outside the gate, or if the sensor is invalid.
pub fn captures_of(
    scene: &Scene,
    settings: &CaptureSettings,
    progress: CaptureProgress,
) -> Result<Measured, ReconstructError> {
    let laser = scene.laser.clone();
    let mut captures = Captures::new(scene.camera, laser, settings.gate, LIT_THRESHOLD);
    if let Some(sensor) = &settings.sensor {
        captures = captures.behind(sensor, settings.seed)?;
    }
    let mut alone = scene.clone();
    for (beam, of) in scene.laser.beams.iter().enumerate() {
        alone.laser.beams = vec![*of];
        let rendered = render(
            &alone,
            &settings.render_settings(),
            &OfCapture(beam, progress),
        )?;
        if rendered.overflow.share > MOST_OUTSIDE {
            let gate = &settings.gate;
            let end = gate.start_m + gate.bin_width_m * f64::from(gate.bins);
            let what = format!(
                "holds paths of {} to {end:.2} m, and {:.0} % of the light of beam {beam} lies outside; widen it",
                gate.start_m,
                rendered.overflow.share * 100.0
            );
            return Err(ReconstructError::invalid("gate", what));
        }
        captures.add(beam, &rendered.transient)?;
    }
    Ok(captures.finish())
}
