//! Selects the camera: random positions near the walls, rejected until the view is acceptable.

use crate::{
    Aim, Camera, Intrinsics, Laser, MAX_DEPTH_M, MIN_DEPTH_M, Vec3,
    rng::Rng,
    view::{acceptance, beams_land, coarse_view, full_view, is_specular},
};

use super::{FurnishedSettings, plan::Plan};

/// The number of cameras to try for one room.
const CAMERAS: u32 = 160;
/// The least number of pieces of furniture in view.
const MIN_SEEN: usize = 5;
/// The least number of coarse pixels (of 576) for an object to count as visible.
const SEEN_PIXELS: u32 = 2;
/// The least number of coarse pixels for a near-mirror to count as visible.
const MIRROR_PIXELS: u32 = 5;
/// The greatest number of coarse pixels of one piece of furniture, so that a wardrobe does not fill
/// the view.
const FILL_PIXELS: u32 = 200;
/// The bounds of z-depth, metres.
const DEPTH_M: [f32; 2] = [MIN_DEPTH_M, MAX_DEPTH_M];
/// The least distance of the camera from every box, metres.
const CLEARANCE: f32 = 0.12;

/// An accepted camera with its laser.
#[derive(Debug)]
pub(super) struct View {
    pub(super) camera: Camera,
    pub(super) laser: Laser,
    /// The smallest and largest z-depth, metres.
    pub(super) depth: [f32; 2],
}

/// Returns the first acceptable camera among the first [`CAMERAS`], if there is one.
pub(super) fn choose(
    rng: &mut Rng,
    settings: &FurnishedSettings,
    aim: &Aim,
    plan: &Plan<'_>,
) -> Option<View> {
    let (world, objects) = (plan.world(), plan.objects());
    let (fov, width, height) = (settings.fov_deg, settings.width, settings.height);
    let accepted = acceptance(fov, width, height);
    for _ in 0..CAMERAS {
        let gap = rng.range(0.0, 0.35);
        let (at, _) = plan
            .room
            .against_wall(rng.below(4), rng.range(-1.0, 1.0), [0.15; 2], gap);
        let eye = Vec3::new(at[0], rng.range(1.0, 1.8), at[1]);
        let target = Vec3::new(
            rng.range(-0.25, 0.25) * plan.room.width,
            rng.range(0.5, 1.1),
            rng.range(-0.25, 0.25) * plan.room.depth,
        );
        let blocked = |foot: &crate::layout::Footprint| foot.contains(eye, CLEARANCE);
        if plan
            .placed
            .iter()
            .filter_map(|p| p.foot.as_ref())
            .chain(&plan.solid)
            .any(blocked)
        {
            continue;
        }
        let mut camera = Camera::look_at(eye, target, accepted);
        let Some(seen) = coarse_view(&world, &camera, DEPTH_M, objects.len()) else {
            continue;
        };
        let furniture = plan
            .placed
            .iter()
            .zip(&seen)
            .filter(|(p, pixels)| p.foot.is_some() && **pixels >= SEEN_PIXELS)
            .count();
        let specular = objects
            .iter()
            .zip(&seen)
            .filter(|(o, pixels)| **pixels >= MIRROR_PIXELS && is_specular(o))
            .count();
        let crowded = plan
            .placed
            .iter()
            .zip(&seen)
            .any(|(p, pixels)| p.foot.is_some() && *pixels > FILL_PIXELS);
        if crowded || furniture < MIN_SEEN || specular < settings.specular_at_least as usize {
            continue;
        }
        let Some(laser) = aim.laser_at(&camera, settings.laser_m.into(), &world) else {
            continue;
        };
        if !beams_land(&world, &laser, &objects) {
            continue;
        }
        if let Some(depth) = full_view(&world, &camera, DEPTH_M) {
            camera.intrinsics = Intrinsics::from_fov(fov, width, height);
            return Some(View {
                camera,
                laser,
                depth,
            });
        }
    }
    None
}
