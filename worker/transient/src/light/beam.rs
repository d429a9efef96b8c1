//! Traces the laser's beams to their spots: straight through thin glass, refracted by bodies of
//! glass, and reflected by near-mirrors. The part of a beam that glass reflects makes spots of its
//! own.

use picofarm_scene::{Beam, Scene, Spot, Vec3};

use crate::{
    api::{RenderError, Stop, Unstopped},
    scene::{bvh::tree::Stack, fresnel::split, intersection::lift, panes::Crossing, world::World},
};

/// Largest number of turns of a beam before it is dropped.
const MAX_REFLECTIONS: u32 = 64;

/// Least share of a beam's light for which a reflection by glass is followed.
const LEAST_BRANCH: f32 = 1.0 / 256.0;

/// Largest distance between a stated spot and the end of its beam, render units.
const SAME_PLACE: f32 = 1e-3;

/// Returns the spots of a scene's beams in order; `None` if a beam hits nothing. A spot stated by
/// the beam is taken as it is; otherwise the beam is followed, through mirrors
/// (`Material::is_specular`) by exact reflection, to the first other surface.
///
/// # Errors
/// [`RenderError::Scene`] if the scene is invalid.
pub fn trace_spots(scene: &Scene) -> Result<Vec<Option<Spot>>, RenderError> {
    scene.validate()?;
    let world = World::new(scene, f64::INFINITY, Stop(&Unstopped))?;
    Ok(find_spots(&world, &scene.laser.beams))
}

pub(crate) fn find_spots(world: &World, beams: &[Beam]) -> Vec<Option<Spot>> {
    let mut stack = world.bvh.stack();
    let mut end = |b: &Beam| Some(follow(world, &mut stack, world.laser, b.direction)?.0);
    beams.iter().map(|b| b.spot.or_else(|| end(b))).collect()
}

/// Returns the end of a laser ray that starts at `origin`, and the share of its light that glass
/// transmits to there.
pub(crate) fn follow(
    world: &World,
    stack: &mut Stack,
    origin: Vec3,
    direction: Vec3,
) -> Option<(Spot, f32)> {
    let mut ray = BeamRay::new(origin, direction);
    ray.follow(world, stack, &mut vec![], |_| {})
}

/// Returns the ends of the rays that glass reflects off a laser ray, with their shares of its
/// light. Only shares of [`LEAST_BRANCH`] or more are followed.
pub(crate) fn branches(
    world: &World,
    stack: &mut Stack,
    origin: Vec3,
    direction: Vec3,
) -> Vec<(Spot, f32)> {
    if !world.has_glass() && !world.has_bodies() {
        return vec![];
    }
    let (mut crossings, mut ends) = (vec![], vec![]);
    let mut left = vec![];
    BeamRay::new(origin, direction).follow(world, stack, &mut crossings, |b| left.push(b));
    while let Some(mut ray) = left.pop() {
        let aside = |b: BeamRay| left.push(b);
        ends.extend(ray.follow(world, stack, &mut crossings, aside));
    }
    ends
}

/// A laser ray in flight.
#[derive(Debug, Clone, Copy)]
struct BeamRay {
    /// Its position, and the same position lifted off the surface there.
    from: Vec3,
    start: Vec3,
    direction: Vec3,
    /// Optical path, metres.
    path: f64,
    /// Share of the beam's light.
    share: f32,
    /// Index of refraction of the medium around it.
    medium: f32,
    /// Number of reflections and refractions so far.
    turns: u32,
}

impl BeamRay {
    fn new(origin: Vec3, direction: Vec3) -> Self {
        Self {
            from: origin,
            start: origin,
            direction,
            path: 0.0,
            share: 1.0,
            medium: 1.0,
            turns: 0,
        }
    }

    /// Returns the ray reflected at a point on glass with the unit normal that faces it, carrying
    /// `share` of its light.
    fn reflected(&self, world: &World, (p, n): (Vec3, Vec3), share: f32) -> Self {
        let w = self.direction;
        Self {
            from: p,
            start: lift(p, n),
            direction: (w - n * (2.0 * n.dot(w))).normalized(),
            path: self.path + world.metres((p - self.from).length()) * f64::from(self.medium),
            share: self.share * share,
            turns: self.turns + 1,
            ..*self
        }
    }

    /// Follows the ray straight through thin glass, refracted by bodies of glass and reflected by
    /// near-mirrors. Returns its end and its share of the light. The rays that glass reflects off
    /// it go to `aside`.
    fn follow(
        &mut self,
        world: &World,
        stack: &mut Stack,
        crossings: &mut Vec<Crossing>,
        mut aside: impl FnMut(Self),
    ) -> Option<(Spot, f32)> {
        let mut branch = |ray: Self| {
            if ray.share >= LEAST_BRANCH {
                aside(ray);
            }
        };
        while self.turns < MAX_REFLECTIONS {
            self.turns += 1;
            let hit = world.ahead(stack, self.start, self.direction, crossings);
            let mut passes = 1.0;
            for c in crossings.iter() {
                if let Some(panes) = world.panes.as_ref().filter(|_| c.reflects > 0.0) {
                    let at = panes.point(c.pane, self.start, self.direction);
                    branch(self.reflected(world, at, passes * c.reflects));
                }
                passes *= c.passes;
            }
            let mut hit = hit?;
            self.share *= passes;
            // The beam's intersection with that facet without the lift off the previous mirror.
            hit.p = world.point(hit.triangle, self.from, self.direction);
            let (p, n) = (hit.p, hit.n);
            if let Some(body) = world.body(hit.triangle) {
                let outside = n.dot(world.normals[hit.triangle as usize]) > 0.0;
                let (a, b) = match outside {
                    true => (1.0, body.ior),
                    false => (body.ior, 1.0),
                };
                let split = split(self.direction.normalized(), n, (a, b));
                let reflected = self.reflected(world, (p, n), split.reflects);
                if split.reflects == 1.0 {
                    *self = reflected;
                    continue;
                }
                branch(reflected);
                self.path = reflected.path;
                self.share *= (1.0 - split.reflects) * body.transmittance;
                self.direction = split.refracted;
                self.from = p;
                self.start = lift(p, -n);
                self.medium = b;
                continue;
            }
            self.path += world.metres((p - self.from).length()) * f64::from(self.medium);
            if hit.surface.specular() && !hit.surface.is_black() {
                self.direction = (self.direction - n * (2.0 * n.dot(self.direction))).normalized();
                self.from = p;
                self.start = lift(p, n);
                continue;
            }
            let t = hit.triangle as usize;
            let spot = Spot {
                point: world.outward(p),
                normal: n,
                arriving: self.direction,
                path_m: self.path as f32,
                object: world.object[t],
                material: world.material[world.surface[t] as usize],
            };
            return Some((spot, self.share));
        }
        None
    }
}

/// Returns the share of a beam's light that glass transmits to its spot: along the beam, or in a
/// straight line if the stated spot is elsewhere.
pub(crate) fn through(world: &World, stack: &mut Stack, direction: Vec3, spot: &Spot) -> f32 {
    if !world.has_glass() && !world.has_bodies() {
        return 1.0;
    }
    let p = world.inward(spot.point);
    match ends_at(world, stack, direction, spot) {
        Some(through) => through,
        None => world.glass(stack, world.laser, lift(p, spot.normal)),
    }
}

/// Returns the share of a beam's light that glass transmits, if the beam ends at `spot`.
pub(crate) fn ends_at(
    world: &World,
    stack: &mut Stack,
    direction: Vec3,
    spot: &Spot,
) -> Option<f32> {
    let (found, through) = follow(world, stack, world.laser, direction)?;
    let apart = world.inward(found.point) - world.inward(spot.point);
    (apart.length() < SAME_PLACE).then_some(through)
}
