//! Small measuring rooms for tests.
#![allow(dead_code)]

use picofarm_reconstruct::{
    Measured, Settings,
    source::{Disturbed, from_truth, truth_of},
};
use picofarm_scene::{
    Scene,
    plato::{self, PlatoObject, PlatoSettings},
};
use picofarm_transient::{Progress, Rendered};

/// A progress callback that never stops the renderer.
pub struct Unstopped;

impl Progress for Unstopped {
    fn at(&self, _: f32) -> bool {
        true
    }
}

/// Returns PlatoNeRF's room with an object, and its truth.
pub fn room(object: PlatoObject, spots: usize, resolution: u32) -> (Scene, Rendered) {
    let settings = PlatoSettings {
        object,
        spots,
        resolution,
    };
    let scene = plato::generate(&settings).unwrap();
    let rendered = truth_of(&scene, &Unstopped).unwrap();
    (scene, rendered)
}

/// Returns its measurements in bins of 128 ps.
pub fn measured(scene: &Scene, rendered: &Rendered) -> Measured {
    let how = Disturbed {
        bin_width_m: 0.0384,
        ..Disturbed::default()
    };
    from_truth(scene, rendered, &how).unwrap()
}

/// Returns settings for a run of one second.
pub fn small() -> Settings {
    Settings {
        nodes: 64,
        iterations: 20,
        batch: 2048,
        ..Settings::default()
    }
}
