//! The glass of a scene that turns light.

use picofarm_scene::Vec3;

use crate::{
    api::{RenderError, Stop},
    film::{slots::Film, splat::Splat},
    light::targets::{Target, Targets},
    paths::{
        glass::{aim::Aim, buffers::Buffers, images::Images, lit_points::Areas},
        tracer::Walk,
    },
    scene::{bvh::tree::Stack, centres::Centres, world::World},
};

/// Probability of a camera path in a pixel that sees no glass: its least value, and the factor on
/// the share of glass, weighted by reflectance, in the area of all surfaces. A small area of glass
/// contributes little.
const ELSEWHERE: f32 = 0.125;
const BY_AREA: f32 = 100.0;

/// Weight of panes in which spots have images as targets of light paths, as a share of the weight
/// of other panes.
const IMAGED: f32 = 0.1;

/// Glass as a target of light paths.
#[derive(Debug)]
pub(crate) struct ByGlass {
    pub targets: Targets,
    /// Index among the targets by pane, and by triangle; [`NONE`] if it is not a target.
    pub of_pane: Vec<u32>,
    pub of_triangle: Vec<u32>,
    pub images: Images,
    /// The splats that each pass draws of the spots that the camera sees in planar panes.
    pub seen: Vec<Splat>,
    /// The glass that camera paths aim at.
    pub aim: Aim,
    /// Surface areas, for sampling the points of [`Lit`].
    pub areas: Areas,
    /// By row-major pixel: whether the pixel or one of its neighbours sees glass.
    pub sees: Vec<bool>,
    /// Probability of a camera path in other pixels.
    pub elsewhere: f32,
    /// Index of refraction around the camera.
    pub around: f32,
}

const NONE: u32 = u32::MAX;

/// Index of refraction outside of all bodies.
const AIR: f32 = 1.0;

impl ByGlass {
    /// Returns the glass of a scene that turns light; `None` if there is none.
    ///
    /// # Errors
    /// [`RenderError::Stopped`] if the render was stopped.
    pub fn find(
        (walk, film): (&Walk, &Film),
        centres: &Centres,
        stop: Stop,
    ) -> Result<Option<Self>, RenderError> {
        let (world, emitters) = (walk.world, walk.emitters);
        let images = Images::find(world, stop);
        let area = |[a, b, c]: [Vec3; 3]| 0.5 * (b - a).cross(c - a).length();
        let mut glass = 0.0;
        let (mut all, mut aimed_at) = (vec![], vec![]);
        let mut of_pane = vec![];
        let mut of_triangle = vec![NONE; world.triangles.len()];
        for (k, (corners, normal)) in world.panes.iter().flat_map(|p| p.triangles()).enumerate() {
            let panes = world.panes.as_ref().expect("there is a pane");
            let share = panes.reflectance(k);
            // Such panes are targets only for light with further turns after the pane.
            let rest = if images.has(k as u32) { IMAGED } else { 1.0 };
            of_pane.push(NONE);
            glass += share * area(corners);
            if share > 0.0 && normal != Vec3::ZERO {
                of_pane[k] = all.len() as u32;
                if !images.has(k as u32) {
                    aimed_at.push(corners);
                }
                all.push(Target {
                    corners,
                    normal,
                    two_sided: panes.two_sided(k),
                    counts: world.near(&corners),
                    share: rest * share,
                });
            }
        }
        if world.has_bodies() {
            for (k, &corners) in world.triangles.iter().enumerate() {
                if world.body(k as u32).is_some() && world.normals[k] != Vec3::ZERO {
                    glass += area(corners);
                    of_triangle[k] = all.len() as u32;
                    aimed_at.push(corners);
                    all.push(Target {
                        corners,
                        normal: world.normals[k],
                        two_sided: true,
                        counts: world.counts(k),
                        share: 1.0,
                    });
                }
            }
        }
        if all.is_empty() || emitters.list.is_empty() || walk.max_bounces < 2 {
            return Ok(None);
        }
        let areas = Areas::of(world, stop);
        let targets = Targets::new(&all, emitters, stop);
        stop.check()?;
        let mut stack = world.bvh.stack();
        let around = world.medium(&mut stack, Vec3::ZERO, world.camera.forward);
        let seen = match around == AIR {
            true => images.seen((walk, film), &mut Buffers::new(walk), stop),
            false => vec![],
        };
        stop.check()?;
        Ok(targets.map(|targets| Self {
            seen,
            targets,
            elsewhere: (BY_AREA * glass / areas.whole() as f32).clamp(ELSEWHERE, 1.0),
            areas,
            images,
            aim: Aim::at(aimed_at),
            of_pane,
            of_triangle,
            sees: sees(world, centres, &mut stack),
            around,
        }))
    }

    /// Returns whether spots that planar panes show are points of light: true unless the camera is
    /// in a body of glass.
    pub fn points_of_light(&self) -> bool {
        self.around == AIR
    }

    /// Returns the splats that each pass draws of the spots that the camera sees in planar panes.
    pub fn seen(&self) -> &[Splat] {
        &self.seen
    }

    /// Returns the probability that a pixel gets a camera path in a pass.
    pub fn chance(&self, pixel: u32) -> f32 {
        match self.sees[pixel as usize] {
            true => 1.0,
            false => self.elsewhere,
        }
    }
}

/// Returns, by pixel, whether the centre of the pixel or of a neighbour sees glass.
fn sees(world: &World, centres: &Centres, stack: &mut Stack) -> Vec<bool> {
    let i = &world.camera.intrinsics;
    let (width, height) = (i.width as usize, i.height as usize);
    let mut crossings = vec![];
    let each = centres.hits.iter().enumerate();
    let middle: Vec<bool> = each
        .map(|(k, hit)| {
            let body = hit.as_ref().and_then(|h| world.body(h.triangle));
            let (row, col) = (k / width, k % width);
            body.is_some() || {
                let ray = world.camera.ray(col as f32 + 0.5, row as f32 + 0.5);
                world.across(
                    stack,
                    (Vec3::ZERO, ray.normalized()),
                    hit.as_ref(),
                    &mut crossings,
                );
                crossings.iter().any(|c| c.reflects > 0.0)
            }
        })
        .collect();
    (0..width * height)
        .map(|k| {
            let (row, col) = (k / width, k % width);
            let rows = row.saturating_sub(1)..(row + 2).min(height);
            rows.into_iter().any(|r| {
                let cols = col.saturating_sub(1)..(col + 2).min(width);
                cols.into_iter().any(|c| middle[r * width + c])
            })
        })
        .collect()
}
