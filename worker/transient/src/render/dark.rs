//! Gates that no light reaches, determined from lengths alone before any ray is traced.

use picofarm_scene::Vec3;

use crate::{api::Gate, light::emitters::Emitters, scene::world::World};

/// Relative rounding error of sums of lengths in f32.
const ROUNDING: f64 = 1e-5;

/// Returns whether all light arrives after the gate's end or before its start.
///
/// Every path is at least as long as the straight segments from the laser to its spot and from
/// there to the camera. A path of `max_bounces` bounces is at most as long as the segment to its
/// spot plus `max_bounces` diagonals of the scene. Without a bound on the bounces, paths can be
/// arbitrarily long, so no gate is too late.
pub(crate) fn is_dark(world: &World, emitters: &Emitters, gate: &Gate, max_bounces: u32) -> bool {
    let each = || emitters.list.iter();
    let first = each().map(|e| e.path_m + world.metres(e.p.length()));
    let first = first.fold(f64::INFINITY, f64::min);
    if first * (1.0 - ROUNDING) > gate.end_m() {
        return true;
    }
    // Light may travel back and forth within glass for long.
    if max_bounces == u32::MAX || world.has_glass() || world.has_bodies() {
        return false;
    }
    let corners = || world.triangles.iter().flatten().copied();
    let low = corners().fold(Vec3::ZERO, Vec3::min);
    let high = corners().fold(Vec3::ZERO, Vec3::max);
    let across = world.metres((high - low).length());
    let last = each().map(|e| e.path_m).fold(0.0, f64::max) + f64::from(max_bounces) * across;
    last * (1.0 + ROUNDING) < gate.start_m
}
