//! Rays via glass: the legs of paths.

use picofarm_scene::Vec3;

use crate::{
    numeric::rng::Rng,
    scene::{
        bvh::tree::Stack,
        fresnel::{Body, split},
        hit::Hit,
        intersection::lift,
        panes::Crossing,
        world::World,
    },
    tuning::GlassTuning,
};

/// A ray on a leg.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Ray {
    /// Position, and the same position lifted off the surface there.
    pub position: Vec3,
    pub from: Vec3,
    /// Unit direction.
    pub w: Vec3,
    /// Index of refraction of the medium around it.
    pub medium: f32,
    /// Whether it carries radiance, from the camera, rather than flux.
    pub radiance: bool,
    /// On this leg: the remaining share, the optical path in metres, the numbers of reflections and
    /// turns.
    pub weight: f32,
    pub length_m: f64,
    pub reflections: u32,
    pub turns: u32,
    /// The last pane that reflected it.
    pub last: Option<u32>,
}

impl Ray {
    pub fn new(position: Vec3, from: Vec3, w: Vec3, (medium, radiance): (f32, bool)) -> Self {
        Self {
            position,
            from,
            w,
            medium,
            radiance,
            weight: 1.0,
            length_m: 0.0,
            reflections: 0,
            turns: 0,
            last: None,
        }
    }

    pub fn advance(&mut self, world: &World, p: Vec3) {
        self.length_m += world.metres((p - self.position).length()) * f64::from(self.medium);
        self.position = p;
    }

    pub fn reflect_at(&mut self, world: &World, pane: u32) {
        let panes = world.panes.as_ref().expect("there is a pane");
        let (p, n) = panes.point(pane, self.from, self.w);
        self.advance(world, p);
        self.w = (self.w - n * (2.0 * n.dot(self.w))).normalized();
        self.from = lift(p, n);
        self.reflections += 1;
        self.turns += 1;
        self.last = Some(pane);
    }

    pub fn turn_at(
        &mut self,
        world: &World,
        hit: &Hit,
        body: Body,
        tuning: &GlassTuning,
        rng: &mut Rng,
    ) {
        self.advance(world, hit.p);
        let outside = hit.n.dot(world.normals[hit.triangle as usize]) > 0.0;
        let (from, to) = match outside {
            true => (1.0, body.ior),
            false => (body.ior, 1.0),
        };
        let split = split(self.w, hit.n, (from, to));
        self.turns += 1;
        let chance = match split.reflects > 0.0 {
            true => split.reflects.max(tuning.reflect),
            false => 0.0,
        };
        if rng.uniform() < chance {
            self.weight *= split.reflects / chance;
            self.w = split.reflected;
            self.from = lift(hit.p, hit.n);
            self.reflections += 1;
            self.medium = from;
            return;
        }
        self.weight *= (1.0 - split.reflects) / (1.0 - chance) * body.transmittance;
        if self.radiance {
            self.weight *= (from / to) * (from / to);
        }
        self.w = split.refracted;
        self.from = lift(hit.p, -hit.n);
        self.medium = to;
    }
}

/// Shares of the light along a straight segment.
pub(crate) struct StraightShares {
    pub reflected: f32,
    /// Share that passes all panes, if there is a surface behind them.
    pub straight: f32,
}

impl StraightShares {
    pub fn new(crossings: &[Crossing], hit: Option<&Hit>) -> Self {
        let (mut reflected, mut reach) = (0.0, 1.0);
        for c in crossings {
            reflected += reach * c.reflects;
            reach *= c.passes;
        }
        Self {
            reflected,
            straight: if hit.is_some() { reach } else { 0.0 },
        }
    }
}

/// Returns the pane that `left` selects in proportion to the reflected shares.
pub(crate) fn pick(crossings: &[Crossing], mut left: f32) -> Option<u32> {
    let (mut reach, mut last) = (1.0, None);
    for c in crossings {
        let share = reach * c.reflects;
        if share > 0.0 {
            last = Some(c.pane);
            left -= share;
            if left < 0.0 {
                break;
            }
        }
        reach *= c.passes;
    }
    last
}

/// Follows a ray via glass to the next surface of another material. Before the first turn,
/// reflections by panes are chosen with a probability of at least `seek`.
pub(crate) fn follow(
    world: &World,
    mut ray: Ray,
    seek: f32,
    tuning: &GlassTuning,
    rng: &mut Rng,
    (stack, crossings): (&mut Stack, &mut Vec<Crossing>),
) -> Option<(Ray, Hit)> {
    for turn in 0..tuning.most_turns {
        if turn >= tuning.sure_turns && ray.weight < 1.0 {
            if rng.uniform() >= ray.weight {
                return None;
            }
            ray.weight = 1.0;
        }
        let hit = world.ahead(stack, ray.from, ray.w, crossings);
        let body = hit.as_ref().and_then(|h| world.body(h.triangle));
        let shares = StraightShares::new(crossings, hit.as_ref());
        let total = shares.reflected + shares.straight;
        if total <= 0.0 || ray.weight == 0.0 {
            return None;
        }
        let mut chance = shares.reflected / total;
        let both = shares.reflected > 0.0 && shares.straight > 0.0;
        if both && ray.turns == 0 && body.is_none() {
            chance = chance.max(seek);
        }
        if chance > 0.0 && rng.uniform() < chance {
            ray.weight *= shares.reflected / chance;
            let pane = pick(crossings, rng.uniform() * shares.reflected)?;
            ray.reflect_at(world, pane);
            continue;
        }
        let hit = hit?;
        ray.weight *= shares.straight / (1.0 - chance);
        let Some(body) = body else {
            ray.advance(world, hit.p);
            return Some((ray, hit));
        };
        ray.turn_at(world, &hit, body, tuning, rng);
    }
    None
}
