//! Illumination spots: tracing beams to them, and how they scatter light into the scene.

use std::ops::Range;

use picofarm_scene::{Beam, Scene, Spot, Vec3};

use crate::{
    api::{BeamWidth, RenderError, Stop, Unstopped},
    beam_width,
    bsdf::Surface,
    bvh::Stack,
    contact,
    fresnel::split,
    glass::Crossing,
    lanes::{Wide, widest},
    lobes::{Lobes, Seen},
    spectra::{ONES, Ratios, times},
    world::{World, lift},
};

/// Mirrors a beam may meet before it is given up.
const MAX_REFLECTIONS: u32 = 64;
/// Least share of a beam's light that is followed where glass turns it aside.
const LEAST_BRANCH: f32 = 1.0 / 256.0;

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
fn follow(world: &World, stack: &mut Stack, origin: Vec3, direction: Vec3) -> Option<(Spot, f32)> {
    let mut ray = BeamRay::new(origin, direction);
    ray.follow(world, stack, &mut vec![], |_| {})
}

/// Where what glass turns aside of a ray of the laser ends, and the shares of its light: as far as they are
/// [`LEAST_BRANCH`] or more.
fn branches(world: &World, stack: &mut Stack, origin: Vec3, direction: Vec3) -> Vec<(Spot, f32)> {
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
fn through(world: &World, stack: &mut Stack, direction: Vec3, spot: &Spot) -> f32 {
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
fn ends_at(world: &World, stack: &mut Stack, direction: Vec3, spot: &Spot) -> Option<f32> {
    let (found, through) = follow(world, stack, world.laser, direction)?;
    let apart = world.inward(found.point) - world.inward(spot.point);
    (apart.length() < SAME_PLACE).then_some(through)
}

/// How far a stated spot may lie from where its beam ends, render units.
const SAME_PLACE: f32 = 1e-3;

/// A spot as a point source: unit power arrives along the beam and leaves by the BRDF.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Emitter {
    /// Index of the beam.
    pub beam: usize,
    /// Position, render units.
    pub p: Vec3,
    /// Normal on the lit side.
    pub n: Vec3,
    /// Unit direction back along the beam.
    pub back: Vec3,
    /// Optical path from the laser, metres.
    pub path_m: f64,
    /// Scattering on the lit side (black behind a one-sided surface), times the source's share of the beam: what glass lets through.
    pub surface: Surface,
    /// It is not the beam's own spot: glass turned that light aside.
    pub aside: bool,
    /// Ratios of the texture there.
    ratios: Ratios,
}

impl Emitter {
    fn new(
        world: &World,
        stack: &mut Stack,
        (beam, share): (usize, f32),
        spot: &Spot,
        material: u32,
    ) -> Self {
        let surface = world.surfaces[material as usize];
        let p = world.inward(spot.point);
        let p = contact::clear(world, stack, p, spot.normal, -spot.arriving);
        // The spot does not say whether its side is the facet's front: look at the facet beneath it.
        let beneath = world.closest(stack, lift(p, spot.normal), -spot.normal);
        // It also knows the texture there.
        let beneath = beneath.filter(|h| (h.p - p).length() < 1e-3);
        let surface = match beneath {
            Some(h) if !surface.two_sided() && h.surface.is_black() => surface.black(),
            Some(h) if material == world.surface[h.triangle as usize] => h.surface,
            _ => surface,
        };
        let ratios = match &beneath {
            Some(h) if material == world.surface[h.triangle as usize] => {
                world.texel_ratios(h.triangle, h.p)
            }
            _ => ONES,
        };
        let surface = match share == 1.0 {
            true => surface,
            false => surface.scaled(share),
        };
        Self {
            beam,
            p,
            n: spot.normal,
            back: -spot.arriving,
            path_m: f64::from(spot.path_m),
            surface,
            aside: false,
            ratios,
        }
    }

    /// Radiant intensity per unit power towards the unit direction `w`: f·cos.
    #[inline]
    pub fn intensity(&self, w: Vec3) -> f32 {
        self.surface.scatter(self.n, self.back, w)
    }

    /// The ratios of that.
    #[inline(always)]
    pub fn ratios(&self, world: &World, w: Vec3) -> Ratios {
        match world.is_spectral() {
            false => ONES,
            true => times(
                self.ratios,
                world.surface_ratios(&self.surface, self.n, self.back, w),
            ),
        }
    }
}

/// Point sources side by side, for loops over all of them.
#[derive(Debug, Default, Clone)]
pub(crate) struct Columns {
    pub px: Vec<f32>,
    pub py: Vec<f32>,
    pub pz: Vec<f32>,
    pub nx: Vec<f32>,
    pub ny: Vec<f32>,
    pub nz: Vec<f32>,
    /// Lambertian strength ρ/π; 0 where the source is not Lambertian.
    pub strength: Vec<f32>,
}

impl Columns {
    pub fn clear(&mut self) {
        for column in [
            &mut self.px,
            &mut self.py,
            &mut self.pz,
            &mut self.nx,
            &mut self.ny,
            &mut self.nz,
            &mut self.strength,
        ] {
            column.clear();
        }
    }

    pub fn push(&mut self, p: Vec3, n: Vec3, strength: f32) {
        self.px.push(p.x);
        self.py.push(p.y);
        self.pz.push(p.z);
        self.nx.push(n.x);
        self.ny.push(n.y);
        self.nz.push(n.z);
        self.strength.push(strength);
    }

    /// Writes strength · cos_s · cos_x / d² for a receiver at `x` with normal `n`: irradiance per unit
    /// power of each Lambertian source, unshadowed.
    #[inline]
    pub fn irradiance(&self, x: Vec3, n: Vec3, out: &mut [f32]) {
        self.irradiance_from(0, x, n, out);
    }

    /// The same of as many sources as `out` holds, from the `first` on.
    #[inline]
    pub fn irradiance_from(&self, first: usize, x: Vec3, n: Vec3, out: &mut [f32]) {
        widest(Irradiance {
            columns: self,
            first,
            x,
            n,
            out,
        });
    }
}

/// [`Columns::irradiance_from`].
pub(crate) struct Irradiance<'a> {
    pub columns: &'a Columns,
    pub first: usize,
    pub x: Vec3,
    pub n: Vec3,
    pub out: &'a mut [f32],
}

impl<'a> Wide for Irradiance<'a> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self {
            columns: c,
            first,
            x,
            n,
            out,
        } = self;
        let count = out.len();
        let of = |column: &'a [f32]| &column[first..first + count];
        let (px, py, pz) = (of(&c.px), of(&c.py), of(&c.pz));
        let (nx, ny, nz) = (of(&c.nx), of(&c.ny), of(&c.nz));
        let strength = of(&c.strength);
        for i in 0..count {
            let (dx, dy, dz) = (px[i] - x.x, py[i] - x.y, pz[i] - x.z);
            let d2 = dx * dx + dy * dy + dz * dz;
            let cx = n.x * dx + n.y * dy + n.z * dz;
            let cs = -(nx[i] * dx + ny[i] * dy + nz[i] * dz);
            let lit = (cx > 0.0) & (cs > 0.0);
            let value = strength[i] * cx * cs / (d2 * d2);
            out[i] = if lit { value } else { 0.0 };
        }
    }
}

/// All spots that exist, as sources; of beams with a width several for each, and of surfaces of several parts one for each part.
#[derive(Debug, Default)]
pub(crate) struct Emitters {
    /// The sources.
    pub list: Vec<Emitter>,
    /// Their places, lifted off the surface, for shadow rays.
    pub lifted: Vec<Vec3>,
    /// The Lambertian ones in columns.
    pub columns: Columns,
    /// Indices of the others.
    pub glossy: Vec<usize>,
    /// How each shines.
    lobes: Lobes,
    /// Indices of those on mirrors.
    pub on_mirror: Vec<usize>,
    /// Those of each ray of the beams: one range for all where beams have no width.
    pub rays: Vec<Range<usize>>,
}

impl Emitters {
    pub fn new(scene: &Scene, world: &World, spots: &[Option<Spot>]) -> Result<Self, RenderError> {
        let mut stack = world.bvh.stack();
        let mut all = Self::default();
        for (beam, spot) in spots.iter().enumerate() {
            let along = scene.laser.beams.get(beam).map(|b| b.direction);
            let Some(spot) = spot else {
                if let Some(direction) = along {
                    let way = (world.laser, direction);
                    all.push_branches(world, &mut stack, (beam, 1.0), way);
                }
                continue;
            };
            let material = scene
                .objects
                .get(spot.object as usize)
                .and_then(|o| o.mesh.materials.get(spot.material as usize));
            if material.is_none() {
                return Err(RenderError::Invalid {
                    field: format!("laser.beams[{beam}].spot"),
                    what: format!(
                        "names object {} and material {}, which the scene does not have; drop the spot to have the beam traced",
                        spot.object, spot.material
                    ),
                });
            }
            let unit = |v: Vec3| v.is_finite() && (v.length() - 1.0).abs() < 1e-3;
            let far = |v: Vec3| v.x.abs().max(v.y.abs()).max(v.z.abs()) > 1e9;
            if far(spot.point - world.camera.origin) || !(0.0..=1e12).contains(&spot.path_m) {
                return Err(RenderError::Invalid {
                    field: format!("laser.beams[{beam}].spot"),
                    what: "needs a point within 1e9 m of the camera and a path of 0 to 1e12 m"
                        .into(),
                });
            }
            if !(spot.point.is_finite() && unit(spot.normal) && unit(spot.arriving)) {
                return Err(RenderError::Invalid {
                    field: format!("laser.beams[{beam}].spot"),
                    what: "needs a finite point and unit normal and arriving directions".into(),
                });
            }
            let surface = world.first_surface[spot.object as usize] + spot.material;
            let direction = along.unwrap_or(spot.arriving);
            let through = through(world, &mut stack, direction, spot);
            let of_beam = (beam, through);
            let source = Emitter::new(world, &mut stack, of_beam, spot, surface);
            all.push(world, source);
            let way = (world.laser, direction);
            all.push_branches(world, &mut stack, (beam, 1.0), way);
        }
        all.rays.push(0..all.list.len());
        Ok(all)
    }

    /// The sources of beams that have a width: as many for each beam as `width` has points, with equal shares of its light.
    /// What of a beam meets nothing is lost.
    ///
    /// # Errors
    /// [`RenderError::Invalid`] where the width cannot be used, or a beam does not end at the spot that the scene states for it.
    pub fn widened(scene: &Scene, world: &World, width: &BeamWidth) -> Result<Self, RenderError> {
        let invalid = |field: String, what: String| Err(RenderError::Invalid { field, what });
        if let Err((field, what)) = width.check() {
            return invalid(format!("beam.{field}"), what);
        }
        let mut stack = world.bvh.stack();
        let beams = || scene.laser.beams.iter().enumerate();
        for (beam, b) in beams() {
            if let Some(spot) = &b.spot
                && ends_at(world, &mut stack, b.direction, spot).is_none()
            {
                let what = "lies elsewhere than its beam ends, so that it cannot be said where the rays of a wide beam end; \
                            drop the spot to have the beam traced, or render without a width";
                return invalid(format!("laser.beams[{beam}].spot"), what.into());
            }
        }
        let mut all = Self::default();
        for place in beam_width::places(width.points) {
            let first = all.list.len();
            for (beam, b) in beams() {
                let ray = beam_width::ray(width, place, b.direction);
                let start = world.laser + ray.beside_m * world.scale;
                let share = 1.0 / width.points as f32;
                if let Some((spot, through)) = follow(world, &mut stack, start, ray.direction) {
                    let surface = world.first_surface[spot.object as usize] + spot.material;
                    let of_beam = (beam, through / width.points as f32);
                    let source = Emitter::new(world, &mut stack, of_beam, &spot, surface);
                    all.push(world, source);
                }
                all.push_branches(world, &mut stack, (beam, share), (start, ray.direction));
            }
            all.rays.push(first..all.list.len());
        }
        Ok(all)
    }

    /// Adds the sources of what glass turns aside of a ray of a beam that has a share of its light.
    fn push_branches(
        &mut self,
        world: &World,
        stack: &mut Stack,
        (beam, share): (usize, f32),
        (origin, direction): (Vec3, Vec3),
    ) {
        for (spot, of_ray) in branches(world, stack, origin, direction) {
            let surface = world.first_surface[spot.object as usize] + spot.material;
            let of_beam = (beam, share * of_ray);
            let source = Emitter::new(world, stack, of_beam, &spot, surface);
            self.push(
                world,
                Emitter {
                    aside: true,
                    ..source
                },
            );
        }
    }

    /// Adds a source; one for each part of a surface of several.
    fn push(&mut self, world: &World, e: Emitter) {
        match e.surface.parts_of_several() {
            None => self.push_one(e),
            Some((index, factor)) => {
                for part in &world.several[index] {
                    let surface = part.scaled(factor);
                    self.push_one(Emitter { surface, ..e });
                }
            }
        }
    }

    fn push_one(&mut self, e: Emitter) {
        let index = self.list.len();
        let strength = if e.surface.diffuse() {
            e.surface.lambertian()
        } else {
            0.0
        };
        // A beam that arrives from behind its own normal lights nothing.
        let strength = if e.n.dot(e.back) > 0.0 { strength } else { 0.0 };
        self.columns.push(e.p, e.n, strength);
        let place = Seen {
            p: e.p,
            n: e.n,
            i: e.back,
        };
        self.lobes.push(&place, &e.surface);
        if !e.surface.diffuse() {
            self.glossy.push(index);
            if e.surface.specular() {
                self.on_mirror.push(index);
            }
        }
        self.lifted.push(lift(e.p, e.n));
        self.list.push(e);
    }

    /// Writes the unshadowed contribution of every source to a surface point, per unit power: f_s cos_s
    /// f_x cos_x / d². `buffer` is overwritten.
    #[inline]
    pub fn weights(&self, of: (Seen, &Surface), buffer: &mut Vec<f32>, out: &mut [f32]) {
        self.weights_of(0..self.list.len(), of, buffer, out);
    }

    /// The same for the sources of a range; what `out` holds of others stays.
    #[inline]
    pub fn weights_of(
        &self,
        range: Range<usize>,
        (place, surface): (Seen, &Surface),
        buffer: &mut Vec<f32>,
        out: &mut [f32],
    ) {
        let Seen { p: x, n, i: wo } = place;
        if !(surface.diffuse() && self.glossy.is_empty()) && self.lobes.complete() {
            buffer.resize(range.len(), 0.0);
            let own = &mut out[range.clone()];
            let of = (&place, surface);
            if self.lobes.between(range.clone(), of, own, buffer).is_some() {
                return;
            }
        }
        if surface.diffuse() {
            let own = &mut out[range.clone()];
            self.columns.irradiance_from(range.start, x, n, own);
            for w in own {
                *w *= surface.lambertian();
            }
            for &i in self.glossy.iter().filter(|i| range.contains(i)) {
                out[i] = self.weight(i, x, n, wo, surface);
            }
        } else {
            for i in range {
                out[i] = self.weight(i, x, n, wo, surface);
            }
        }
    }

    /// The same for one source.
    #[inline]
    pub fn weight(&self, i: usize, x: Vec3, n: Vec3, wo: Vec3, surface: &Surface) -> f32 {
        let e = &self.list[i];
        let to = e.p - x;
        let (cx, cs) = (n.dot(to), -e.n.dot(to));
        if !(cx > 0.0 && cs > 0.0) {
            return 0.0;
        }
        let d2 = to.dot(to);
        let w = to / d2.sqrt();
        let f = surface.scatter(n, wo, w);
        if f == 0.0 {
            return 0.0;
        }
        f * e.intensity(-w) / d2
    }

    /// Shortest optical path from the laser by way of a spot to `x`, metres.
    pub fn shortest_m(&self, world: &World, x: Vec3) -> f64 {
        let each = self.list.iter();
        each.fold(f64::INFINITY, |a, e| {
            a.min(e.path_m + world.metres((x - e.p).length()))
        })
    }
}
