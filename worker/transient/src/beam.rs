//! The laser's beams on their way to their spots: straight through thin glass, refracted by bodies of glass, folded by near-mirrors. What
//! glass reflects of a beam makes spots of its own.

use picofarm_scene::{Beam, Scene, Spot, Vec3};

use crate::{
    api::{RenderError, Stop, Unstopped},
    bvh::Stack,
    fresnel::split,
    glass::Crossing,
    world::{World, lift},
};

/// Mirrors a beam may meet before it is given up.
const MAX_REFLECTIONS: u32 = 64;
/// Least share of a beam's light that is followed where glass turns it aside.
const LEAST_BRANCH: f32 = 1.0 / 256.0;
/// How far a stated spot may lie from where its beam ends, render units.
const SAME_PLACE: f32 = 1e-3;

/// The spots of a scene's beams in their order; `None` where a beam meets nothing. A spot stated by the
/// beam is taken as it is; otherwise the beam is followed, through mirrors (`Material::is_specular`) by
/// exact reflection, to the first other surface.
///
/// # Errors
/// [`RenderError::Scene`] where the scene is invalid.
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

/// Where a ray of the laser that starts at `origin` ends, and the share of its light that glass lets through to there.
pub(crate) fn follow(
    world: &World,
    stack: &mut Stack,
    origin: Vec3,
    direction: Vec3,
) -> Option<(Spot, f32)> {
    let mut ray = BeamRay::new(origin, direction);
    ray.follow(world, stack, &mut vec![], |_| {})
}

/// Where what glass turns aside of a ray of the laser ends, and the shares of its light: as far as they are
/// [`LEAST_BRANCH`] or more.
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

/// A ray of the laser on its way.
#[derive(Debug, Clone, Copy)]
struct BeamRay {
    /// Where it is, and the same lifted off the surface there.
    from: Vec3,
    start: Vec3,
    direction: Vec3,
    /// Optical path, metres.
    path: f64,
    /// Share of the beam's light.
    share: f32,
    /// Index of refraction around it.
    medium: f32,
    /// How often it was reflected or refracted.
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

    /// Reflected at a place on glass, whose unit normal faces it, with a share of its light.
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

    /// Follows it straight through thin glass, refracted by bodies of glass and folded by near-mirrors, to where it ends, with its
    /// share of the light; what glass reflects of it goes to `aside`.
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
            // Where the beam meets that facet without the lift off the mirror before it.
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

/// The share of a beam's light that glass lets through to its spot: along the beam, or in a straight line where the spot is
/// stated elsewhere.
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

/// The share of a beam's light that glass lets through, if the beam ends at `spot`.
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
