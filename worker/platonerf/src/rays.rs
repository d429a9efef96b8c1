//! The rays from which a network learns, one for each spot and pixel in use, and the batches of a
//! step.

use picofarm_reconstruct::{Measured, ReconstructError};
use picofarm_scene::Vec3;

use crate::random::shuffled;

/// The rays of measurements.
#[derive(Debug, Clone)]
pub struct Pool {
    measured: Measured,
    /// The numbers spot · pixels + pixel of all rays in use, ascending.
    all: Vec<u32>,
    /// Those with a lit pixel.
    lit: Vec<u32>,
}

/// Some rays with their measurements, on the host. Vectors are x, y, z, one after the other.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Batch {
    /// The origin of all rays: the camera.
    pub origin: [f32; 3],
    /// The unit directions: (R, 3).
    pub direction: Vec<f32>,
    /// The spots L, metres: (R, 3).
    pub spot: Vec<f32>,
    /// The path from laser to spot, metres: (R).
    pub path_m: Vec<f32>,
    /// The two-bounce path, metres; 0 if not lit: (R).
    pub tau_m: Vec<f32>,
    /// 1 if lit, 0 in shadow: (R).
    pub lit: Vec<f32>,
}

impl Batch {
    /// Returns the number of rays.
    pub fn rays(&self) -> usize {
        self.lit.len()
    }

    /// Returns the number of lit rays.
    pub fn lit_rays(&self) -> usize {
        self.lit.iter().filter(|l| **l > 0.0).count()
    }

    /// Returns rays `from..to` of the batch.
    pub fn part(&self, from: usize, to: usize) -> Self {
        Self {
            origin: self.origin,
            direction: self.direction[3 * from..3 * to].to_vec(),
            spot: self.spot[3 * from..3 * to].to_vec(),
            path_m: self.path_m[from..to].to_vec(),
            tau_m: self.tau_m[from..to].to_vec(),
            lit: self.lit[from..to].to_vec(),
        }
    }
}

impl Pool {
    /// Returns the rays of measurements, with notes for users.
    ///
    /// # Errors
    /// [`ReconstructError::Invalid`] naming the unusable value.
    pub fn new(measured: Measured) -> Result<(Self, Vec<String>), ReconstructError> {
        let notes = measured.check()?;
        let used = (0..measured.used.len() as u32).filter(|&q| measured.used[q as usize] != 0);
        let all: Vec<u32> = used.collect();
        let is_lit = |q: &u32| measured.lit[*q as usize] != 0;
        let lit = all.iter().copied().filter(is_lit).collect();
        Ok((Self { measured, all, lit }, notes))
    }

    /// Returns the measurements.
    pub fn measured(&self) -> &Measured {
        &self.measured
    }

    /// Returns `rays` rays from a position in the endless shuffled order: of lit rays, or of all.
    pub fn batch(&self, lit_only: bool, seed: u64, place: u64, rays: usize) -> Batch {
        let of = if lit_only { &self.lit } else { &self.all };
        let m = &self.measured;
        let (count, pixels) = (of.len() as u64, m.pixels());
        let xyz = |v: Vec3| [v.x, v.y, v.z];
        let mut batch = Batch {
            origin: xyz(m.camera.origin),
            ..Batch::default()
        };
        for k in place..place + rays as u64 {
            let which = shuffled(seed, k / count, count, k % count);
            let number = of[which as usize] as usize;
            let (spot, lit) = (&m.spots[number / pixels], m.lit[number] != 0);
            batch.direction.extend(xyz(m.ray(number % pixels)));
            batch.spot.extend(xyz(spot.point));
            batch.path_m.push(spot.path_m);
            batch.tau_m.push(if lit { m.tau[number] } else { 0.0 });
            batch.lit.push(if lit { 1.0 } else { 0.0 });
        }
        batch
    }
}
