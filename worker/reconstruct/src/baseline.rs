//! Baseline methods that compute a field from the same measurements: bounce-flash lidar's space
//! carving, and a depth map alone. Their fields are scored like those of a reconstruction.

use picofarm_scene::Vec3;
use rayon::prelude::*;

use crate::{
    Depth, Measured, ReconstructError, Settings,
    closed_form::{closed_form, on_ellipsoid, smooth},
    field::{EMPTY, Field, SOLID, Skip},
    planes::{planes, settle},
    scale,
    start::{State, bounds, start},
};

/// The probability that a lit path goes through an occupied voxel (PlatoNeRF's run of bounce-flash
/// lidar; Henley et al. 2022).
const ETA: f64 = 0.05;
/// The probability that a path through an empty voxel is in shadow; same source.
const XI: f64 = 0.5;
/// The prior shares of empty and of occupied voxels; same source.
const PRIOR: [f64; 2] = [0.8, 0.2];
/// The probability from which a voxel is occupied; same source.
const OCCUPIED: f64 = 0.3;
/// The step along a path, voxels.
const STEP: f32 = 0.7;

/// The assumption about the space behind the surfaces that the camera sees.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Behind {
    /// Solid matter: the visible surface extruded away from the camera.
    Solid,
    /// Empty space.
    Empty,
}

/// Computes bounce-flash lidar: the median over the spots of the depths on their ellipsoids,
/// followed by space carving on a grid with `nodes` nodes along its longest side, in metres. If M
/// spots see a voxel by lit paths alone and N by any shadowed path, it is occupied with probability
/// p₁·ηᴹ·(1−η)ᴺ / (p₀·(1−ξ)ᴹ·ξᴺ + p₁·ηᴹ·(1−η)ᴺ); η = 0.05, ξ = 0.5, p₀ = 0.8, p₁ = 0.2, threshold
/// 0.3 (Henley et al. 2022; numbers of Klinghoffer et al., CVPR 2024). Paths end at the surface
/// point. Voxels that the camera sees, or sees through, are set from the depth. Planes of a room
/// are not used.
///
/// # Errors
/// [`ReconstructError::Invalid`] for measurements that cannot be used, or fewer than 16 nodes.
pub fn bounce_flash(measured: &Measured, nodes: u32) -> Result<Field, ReconstructError> {
    checked(&Settings {
        nodes,
        ..Settings::default()
    })?;
    measured.check()?;
    let depth = median_depth(measured);
    some_depth(&depth)?;
    let (lo, hi) = bounds(measured, &depth, nodes as usize);
    let mut field = Field::over(lo, hi, nodes as usize);
    let states = start(&mut field, measured, &depth, &[]);
    let unseen = |i: usize| states[i] == State::Unseen;
    let skip = Skip::to_nodes(&field, unseen);
    let mut counts = vec![[0u16; 2]; states.len()];
    for spot in 0..measured.spots.len() {
        let met = met(&field, &skip, measured, &depth, spot);
        counts.par_iter_mut().zip(met).for_each(|(c, met)| {
            c[0] += u16::from(met == LIT);
            c[1] += u16::from(met & SHADOWED != 0);
        });
    }
    let found = |i: usize, u: f32| match unseen(i) {
        false => u,
        true if occupied(counts[i]) > OCCUPIED => SOLID,
        true => EMPTY,
    };
    for (i, u) in field.logit.iter_mut().enumerate() {
        *u = found(i, *u);
    }
    Ok(field)
}

/// Computes a field from the depth map alone: the visible surface from times and planes as in a
/// reconstruction, without shadows.
///
/// # Errors
/// [`ReconstructError::Invalid`] for settings or measurements that cannot be used.
pub fn depth_alone(
    measured: &Measured,
    settings: &Settings,
    behind: Behind,
) -> Result<Field, ReconstructError> {
    checked(settings)?;
    measured.check()?;
    let mut measured = measured.clone();
    let factor = scale::factor(&measured);
    measured.scale(factor);
    let raw = closed_form(&mut measured).0;
    some_depth(&raw)?;
    let mut depth = smooth(&measured, &raw);
    let (walls, _) = match settings.planes {
        true => planes(&measured, &depth, (settings.seed, factor)),
        false => (Vec::new(), Vec::new()),
    };
    settle(&measured, &mut depth, &walls);
    let (lo, hi) = bounds(&measured, &depth, settings.nodes as usize);
    let mut field = Field::over(lo, hi, settings.nodes as usize);
    let states = start(&mut field, &measured, &depth, &walls);
    for (u, state) in field.logit.iter_mut().zip(states) {
        if state == State::Unseen {
            *u = match behind {
                Behind::Solid => SOLID,
                Behind::Empty => EMPTY,
            };
        }
    }
    field.scale(1.0 / factor);
    Ok(field)
}

fn checked(settings: &Settings) -> Result<(), ReconstructError> {
    settings
        .check()
        .map_err(|(field, what)| ReconstructError::invalid(field, what))
}

fn some_depth(depth: &Depth) -> Result<(), ReconstructError> {
    match depth.range.iter().any(|r| r.is_finite()) {
        true => Ok(()),
        false => Err(ReconstructError::invalid(
            "tau",
            "no time gives a depth: all are shorter than the way by the spot; check the gate and the laser's place",
        )),
    }
}

/// Returns each pixel's median over its lit spots, without normals.
fn median_depth(measured: &Measured) -> Depth {
    let pixels = measured.pixels();
    let of = |p: usize| {
        let ray = measured.ray(p);
        let on = |(s, spot): (usize, &crate::MeasuredSpot)| {
            let q = s * pixels + p;
            let known = measured.lit[q] != 0 && measured.used[q] != 0;
            let l = spot.point - measured.camera.origin;
            let d = on_ellipsoid(measured.tau[q] - spot.path_m, l, ray);
            (known && d.is_finite() && d > 0.0).then_some(d)
        };
        let mut found: Vec<f32> = measured.spots.iter().enumerate().filter_map(on).collect();
        found.sort_by(f32::total_cmp);
        match found.len() {
            0 => f32::NAN,
            n => 0.5 * (found[(n - 1) / 2] + found[n / 2]),
        }
    };
    let range: Vec<f32> = (0..pixels).into_par_iter().map(of).collect();
    Depth {
        error: range.iter().map(|r| r * 0.0 + 1.0).collect(),
        normal: vec![Vec3::ZERO; pixels],
        range,
    }
}

const LIT: u8 = 1;
const SHADOWED: u8 = 2;

/// Returns the kinds of paths of one spot that pass each node.
fn met(field: &Field, skip: &Skip, measured: &Measured, depth: &Depth, spot: usize) -> Vec<u8> {
    let mut met = vec![0u8; field.logit.len()];
    let [_, y, z] = field.strides();
    let pixels = measured.pixels();
    let from = measured.spots[spot].point;
    for (p, &range) in depth.range.iter().enumerate() {
        let q = spot * pixels + p;
        if measured.used[q] == 0 || !range.is_finite() {
            continue;
        }
        let way = measured.camera.origin + measured.ray(p) * range - from;
        let length = way.length();
        let kind = if measured.lit[q] != 0 { LIT } else { SHADOWED };
        let step = (STEP * field.spacing, 0.0);
        field.march(
            skip,
            (from, way / length),
            (0.0, length),
            step,
            |_, cell, f| {
                let [a, b, c] = f.map(|x| usize::from(x >= 0.5));
                met[cell + a + b * y + c * z] |= kind;
                true
            },
        );
    }
    met
}

/// Returns the posterior probability that a voxel is occupied, if M spots see it by lit paths alone
/// and N by shadowed ones.
fn occupied([lit, shadowed]: [u16; 2]) -> f64 {
    let power = |base: f64, n: u16| (0..n).fold(1.0, |x, _| x * base);
    let solid = PRIOR[1] * power(ETA, lit) * power(1.0 - ETA, shadowed);
    let empty = PRIOR[0] * power(1.0 - XI, lit) * power(XI, shadowed);
    solid / (empty + solid)
}

#[cfg(test)]
mod tests {
    use super::occupied;

    #[test]
    fn the_posterior_is_that_of_the_formula() {
        assert!((occupied([0, 0]) - 0.2).abs() < 1e-12);
        // 0.2 · 0.95 / (0.8 · 0.5 + 0.2 · 0.95)
        assert!((occupied([0, 1]) - 0.19 / 0.59).abs() < 1e-12);
        // 0.2 · 0.05 / (0.8 · 0.5 + 0.2 · 0.05)
        assert!((occupied([1, 0]) - 0.01 / 0.41).abs() < 1e-12);
        assert!(occupied([1, 4]) < 0.3 && occupied([1, 5]) > 0.3);
    }
}
