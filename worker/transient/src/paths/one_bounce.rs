//! Exactly one bounce: laser → spot → camera, a point of light in one pixel and one bin.

use crate::{
    api::Gate,
    light::emitters::Emitters,
    scene::{bvh::tree::Stack, world::World},
};

/// One spot that the camera sees directly.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Peak {
    /// Emitter index.
    pub spot: usize,
    /// Row-major pixel.
    pub pixel: usize,
    /// Optical path, metres.
    pub path_m: f64,
    /// Radiance averaged over the pixel, 1/(m² sr).
    pub value: f32,
}

/// Returns the peaks of all spots that the camera sees. A spot of intensity I at distance d and
/// angle θ from the optical axis gives I/(d² cos³θ) over the pixel's sensitive area on the film at
/// unit distance.
pub(crate) fn peaks(world: &World, stack: &mut Stack, emitters: &Emitters) -> Vec<Peak> {
    let c = &world.camera;
    let i = &c.intrinsics;
    let mut peaks = vec![];
    for (spot, e) in emitters.list.iter().enumerate() {
        let q = c.direction_to_camera(e.p);
        let d = e.p.length();
        let Some(pixel) = world.pixel(q).filter(|_| d > 0.0) else {
            continue;
        };
        let intensity = e.intensity(-e.p / d);
        if intensity == 0.0 {
            continue;
        }
        let seen = world.seen(stack, e.p, e.n);
        if seen == 0.0 {
            continue;
        }
        let cos = f64::from(q.z) / f64::from(d);
        let metres = world.metres(d);
        let area = f64::from(world.sensitive).powi(2) / (f64::from(i.fx) * f64::from(i.fy));
        let value = f64::from(intensity * seen) / (metres * metres * cos * cos * cos * area);
        peaks.push(Peak {
            spot,
            pixel,
            path_m: e.path_m + metres,
            value: value as f32,
        });
    }
    peaks
}

/// Adds a peak to a histogram. Returns false if it is outside the gate.
pub(crate) fn add(p: &Peak, gate: &Gate, transient: &mut [f32]) -> bool {
    let bin = gate.bin(p.path_m);
    if let Some(b) = bin {
        transient[p.pixel * gate.bins as usize + b as usize] += p.value;
    }
    bin.is_some()
}
