//! Gates that no light reaches: known from lengths alone, before any ray is traced.

use picofarm_scene::Vec3;

use crate::{api::Gate, emitter::Emitters, world::World};

/// What sums of lengths in f32 may be off, as a share of them.
const ROUNDING: f64 = 1e-5;

/// Whether all light comes after the gate's end, or before its start. Every path is at least as long as the
/// straight ways to its spot and from there to the camera. One of `max_bounces` is at most as long as the
/// way to its spot and as many times the way across the scene. What comes late by ever more bounces never
/// ends, so that without a bound no gate is too late.
pub(super) fn is_dark(world: &World, emitters: &Emitters, gate: &Gate, max_bounces: u32) -> bool {
    let each = || emitters.list.iter();
    let first = each().map(|e| e.path_m + world.metres(e.p.length()));
    let first = first.fold(f64::INFINITY, f64::min);
    if first * (1.0 - ROUNDING) > gate.end_m() {
        return true;
    }
    // Within glass light may go to and fro for long.
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
