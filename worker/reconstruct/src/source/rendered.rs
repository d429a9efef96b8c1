//! Measurements of a scene file: what has to be rendered for them.

use picofarm_scene::Scene;
use picofarm_settings::Sensor;
use picofarm_transient::{
    Budget, Gate, Progress, Rendered, Settings, Strategy, Wavelength, render,
};

use super::{Captures, LIT_THRESHOLD};
use crate::{Measured, ReconstructError};

/// Share of a capture's light outside the gate from which on its times are not to be trusted.
const MOST_OUTSIDE: f64 = 0.5;

/// How captures are rendered.
#[derive(Debug, Clone, PartialEq)]
pub struct CaptureSettings {
    /// The gate of the histograms.
    pub gate: Gate,
    /// Camera paths per pixel for three bounces and more.
    pub samples: u32,
    /// Seed of the renders, and of the detector's noise.
    pub seed: u64,
    /// The detector; `None`: what is rendered is what is measured.
    pub sensor: Option<Sensor>,
}

impl CaptureSettings {
    /// The renderer's settings for one capture.
    pub fn render_settings(&self) -> Settings {
        Settings {
            gate: self.gate,
            budget: Budget::Samples(self.samples),
            max_bounces: None,
            one_bounce: true,
            seed: self.seed,
            split: false,
            groups: Vec::new(),
            strategy: Strategy::default(),
            beam: None,
            fill_factor: 1.0,
            wavelengths_nm: Wavelength::NONE,
        }
    }
}

/// Ground truth and spots of a scene, at next to no cost: no histogram is rendered.
///
/// # Errors
/// [`ReconstructError::Render`].
pub fn truth_of(scene: &Scene, progress: &dyn Progress) -> Result<Rendered, ReconstructError> {
    let settings = Settings {
        gate: Gate {
            start_m: 0.0,
            bin_width_m: 1e6,
            bins: 1,
        },
        budget: Budget::Samples(1),
        max_bounces: Some(1),
        one_bounce: false,
        seed: 0,
        split: false,
        groups: Vec::new(),
        strategy: Strategy::default(),
        beam: None,
        fill_factor: 1.0,
        wavelengths_nm: Wavelength::NONE,
    };
    Ok(render(scene, &settings, progress)?)
}

/// Called with the progress of captures: the number of the capture, from 0, and the share of it that is done. Returns `false` to stop.
pub type CaptureProgress<'a> = &'a (dyn Fn(usize, f32) -> bool + Sync);

struct OfCapture<'a>(usize, CaptureProgress<'a>);

impl Progress for OfCapture<'_> {
    fn at(&self, done: f32) -> bool {
        (self.1)(self.0, done)
    }
}

/// Renders a capture of each beam by itself, all bounces, and measures times and masks in it.
///
/// # Errors
/// [`ReconstructError::Render`]; [`ReconstructError::Invalid`] where most of a capture's light lies outside the gate, and for a sensor that
/// cannot be.
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
