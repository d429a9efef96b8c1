//! Tests of the fit: gradients, closed forms, bytes, refusals, and agreement with a twin in
//! PyTorch.

mod bytes;
mod gradients;
mod input;
mod twin;
mod volume;

use picofarm_reconstruct::{Measured, MeasuredSpot};
use picofarm_scene::{Camera, Intrinsics, Vec3};

use burn::tensor::Device;

use crate::{
    Settings,
    loss::Stage,
    rays::Pool,
    training::{State, gradients},
};

/// Returns a wall 2 m ahead with 16×16 pixels and three spots next to it; every third pixel is in
/// shadow. Times are exact.
fn room() -> Measured {
    let camera = Camera::look_at(
        Vec3::ZERO,
        Vec3::new(0.0, 0.0, 2.0),
        Intrinsics::from_fov(60.0, 16, 16),
    );
    let mut measured = Measured {
        camera,
        laser: Vec3::ZERO,
        spots: Vec::new(),
        tau: Vec::new(),
        lit: Vec::new(),
        used: Vec::new(),
        bin_width_m: 0.0,
        mirror: Vec::new(),
        computed: false,
        confidence: Vec::new(),
        unlit_range_m: Vec::new(),
        left_out: Vec::new(),
    };
    for (beam, at) in [[1.5, 0.3, 1.0], [-1.5, 0.1, 1.2], [0.2, 1.4, 0.8]]
        .into_iter()
        .enumerate()
    {
        let point = Vec3::from(at);
        measured.spots.push(MeasuredSpot {
            beam,
            direction: point.normalized(),
            point,
            path_m: point.length(),
            folded: false,
        });
        for pixel in 0..measured.pixels() {
            let ray = measured.ray(pixel);
            let range = 2.0 / ray.z;
            let lit = (pixel + beam) % 3 != 0;
            let tau = point.length() + (ray * range - point).length() + range;
            measured.tau.push(if lit { tau } else { 0.0 });
            measured.lit.push(u8::from(lit));
            measured.used.push(1);
        }
    }
    measured
}

/// Returns settings with steps of milliseconds.
fn small() -> Settings {
    Settings {
        width: 16,
        coarse: 16,
        fine: 16,
        batch: 80,
        distance_steps: 6,
        shadow_steps: 6,
        ..Settings::default()
    }
}

/// Returns the first weights that give both networks a density on the first step's rays.
fn alive(settings: &Settings) -> State {
    let (pool, _) = Pool::new(room()).unwrap();
    let batch = pool.batch(true, settings.seed, 0, settings.batch);
    let learns = |state: &State| {
        let (of, device) = (&state.weights, Device::flex());
        let found = gradients(settings, Stage::Distance, of, &batch, 0, &device, &|_| true);
        let (_, gradients) = found.unwrap();
        gradients.iter().all(|g| g.iter().any(|x| *x != 0.0))
    };
    let mut states = (0..100).map(|draw| State::begin(settings, draw));
    states.find(learns).unwrap()
}
