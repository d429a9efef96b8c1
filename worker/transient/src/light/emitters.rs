//! Illumination spots as light sources that scatter the laser's light into the scene.

use std::ops::Range;

use picofarm_scene::{Scene, Spot, Vec3};

use crate::{
    api::{BeamWidth, RenderError},
    light::{beam::Beams, beam_width, columns::Columns, emitter::Emitter},
    scene::{
        bvh::tree::Stack,
        intersection::lift,
        lobes::{Lobes, ShadingPoint},
        surface::Surface,
        world::World,
    },
};

/// All spots that exist, as sources; of beams with a width several for each.
#[derive(Debug, Default)]
pub(crate) struct Emitters {
    /// The sources.
    pub list: Vec<Emitter>,
    /// Their positions, lifted off the surface, for shadow rays.
    pub lifted: Vec<Vec3>,
    /// All sources in columns; the strength of those that are not Lambertian is 0.
    pub columns: Columns,
    /// Indices of the sources that are not Lambertian.
    pub glossy: Vec<usize>,
    /// The lobe of each source.
    lobes: Lobes,
    /// Indices of the sources on mirrors.
    pub on_mirror: Vec<usize>,
    /// The range of sources of each ray of the beams; a single range for all if beams have no
    /// width.
    pub rays: Vec<Range<usize>>,
}

impl Emitters {
    /// Returns an empty set of sources.
    pub fn none() -> Self {
        Self {
            rays: std::iter::once(0..0).collect(),
            ..Self::default()
        }
    }

    pub fn new(
        scene: &Scene,
        beam_tracer: Beams<'_>,
        spots: &[Option<Spot>],
    ) -> Result<Self, RenderError> {
        let world = beam_tracer.world;
        let mut stack = world.bvh.stack();
        let mut all = Self::default();
        for (beam, spot) in spots.iter().enumerate() {
            let along = scene.laser.beams.get(beam).map(|b| b.direction);
            let Some(spot) = spot else {
                if let Some(direction) = along {
                    let way = (world.laser, direction);
                    all.push_branches(beam_tracer, &mut stack, (beam, 1.0), way);
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
            let through = beam_tracer.through(&mut stack, direction, spot);
            let of_beam = (beam, through);
            let source = Emitter::new(world, &mut stack, of_beam, spot, surface);
            all.push(source);
            let way = (world.laser, direction);
            all.push_branches(beam_tracer, &mut stack, (beam, 1.0), way);
        }
        all.rays.push(0..all.list.len());
        Ok(all)
    }

    /// Returns the sources of beams with a width: one for each of the `width.points` rays of a
    /// beam, with equal shares of its light. Rays that hit nothing are lost.
    ///
    /// # Errors
    /// [`RenderError::Invalid`] if the width is unusable, or if a beam does not end at the
    /// spot that the scene states for it.
    pub fn widened(
        scene: &Scene,
        beam_tracer: Beams<'_>,
        width: &BeamWidth,
    ) -> Result<Self, RenderError> {
        let world = beam_tracer.world;
        let invalid = |field: String, what: String| Err(RenderError::Invalid { field, what });
        let mut stack = world.bvh.stack();
        let beams = || scene.laser.beams.iter().enumerate();
        for (beam, b) in beams() {
            if let Some(spot) = &b.spot
                && beam_tracer.ends_at(&mut stack, b.direction, spot).is_none()
            {
                let what = "lies elsewhere than its beam ends, so that it cannot be said where the rays receiver a wide beam end; \
                            drop the spot to have the beam traced, or render without a width";
                return invalid(format!("laser.beams[{beam}].spot"), what.into());
            }
        }
        let mut all = Self::default();
        for place in beam_width::places(width.points) {
            let first = all.list.len();
            for (beam, b) in beams() {
                let ray = beam_width::ray(width, place, b.direction);
                let start = world.laser + ray.offset_m * world.scale;
                let share = 1.0 / width.points as f32;
                if let Some((spot, through)) = beam_tracer.follow(&mut stack, start, ray.direction)
                {
                    let surface = world.first_surface[spot.object as usize] + spot.material;
                    let of_beam = (beam, through / width.points as f32);
                    let source = Emitter::new(world, &mut stack, of_beam, &spot, surface);
                    all.push(source);
                }
                all.push_branches(
                    beam_tracer,
                    &mut stack,
                    (beam, share),
                    (start, ray.direction),
                );
            }
            all.rays.push(first..all.list.len());
        }
        Ok(all)
    }

    /// Adds the sources of the light that glass reflects off a ray of a beam; the ray carries a
    /// share of the beam's light.
    fn push_branches(
        &mut self,
        beam_tracer: Beams<'_>,
        stack: &mut Stack,
        (beam, share): (usize, f32),
        (origin, direction): (Vec3, Vec3),
    ) {
        let world = beam_tracer.world;
        for (spot, of_ray) in beam_tracer.branches(stack, origin, direction) {
            let surface = world.first_surface[spot.object as usize] + spot.material;
            let of_beam = (beam, share * of_ray);
            let source = Emitter::new(world, stack, of_beam, &spot, surface);
            self.push(Emitter {
                aside: true,
                ..source
            });
        }
    }

    /// Adds a source.
    fn push(&mut self, e: Emitter) {
        let index = self.list.len();
        let strength = if e.surface.diffuse() {
            e.surface.lambertian()
        } else {
            0.0
        };
        // A beam that arrives from behind the spot's normal lights nothing.
        let strength = if e.n.dot(e.back) > 0.0 { strength } else { 0.0 };
        self.columns.push(e.p, e.n, strength);
        let place = ShadingPoint {
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

    /// Writes the unshadowed contribution of every source to a surface point, per unit power: f_s
    /// cos_s f_x cos_x / d². `buffer` is overwritten.
    #[inline]
    pub fn weights(
        &self,
        receiver: (ShadingPoint, &Surface),
        buffer: &mut Vec<f32>,
        out: &mut [f32],
    ) {
        self.weights_of(0..self.list.len(), receiver, buffer, out);
    }

    /// Like [`Emitters::weights`], for the sources of a range; the other entries of `out` do not
    /// change.
    #[inline]
    pub fn weights_of(
        &self,
        range: Range<usize>,
        (place, surface): (ShadingPoint, &Surface),
        buffer: &mut Vec<f32>,
        out: &mut [f32],
    ) {
        let ShadingPoint { p: x, n, .. } = place;
        let own = &mut out[range.clone()];
        if surface.diffuse() && self.glossy.is_empty() {
            self.columns.irradiance_from(range.start, x, n, own);
            for w in own {
                *w *= surface.lambertian();
            }
            return;
        }
        buffer.resize(range.len(), 0.0);
        self.lobes.between(range, (&place, surface), own, buffer);
    }

    /// Like [`Emitters::weights`], for one source.
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

    /// Returns the shortest optical path from the laser via a spot to `x`, metres.
    pub fn shortest_m(&self, world: &World, x: Vec3) -> f64 {
        let each = self.list.iter();
        each.fold(f64::INFINITY, |a, e| {
            a.min(e.path_m + world.metres((x - e.p).length()))
        })
    }
}
