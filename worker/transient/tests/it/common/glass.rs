//! Glass in the independent tracer: reflection and transmission of thin panes and bodies, the path
//! legs that cross them, and the spots of the beams that they split.

use picofarm_scene::Bsdf;

use super::{
    brute::{Noise, P},
    light::{LONGEST, Source, Tracer, is_mirror},
    tree::{NONE, Vertex},
};

/// The minimum share of a beam's power for a part of the beam to be followed.
const LEAST_SHARE: f64 = 1.0 / 256.0;

/// Returns Fresnel's reflectance of one face, by polarisation (s, p), from the indices before and
/// behind it and the cosine of the angle before it.
pub fn fresnel(from: f64, to: f64, cos: f64) -> [f64; 2] {
    let sin2 = (from / to).powi(2) * (1.0 - cos * cos);
    if sin2 >= 1.0 {
        return [1.0; 2];
    }
    let inside = (1.0 - sin2).sqrt();
    let square = |a: f64, b: f64| ((a - b) / (a + b)).powi(2);
    [
        square(from * cos, to * inside),
        square(to * cos, from * inside),
    ]
}

/// The fractions of light that a pane transmits and reflects.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Shares {
    pub passes: f64,
    pub reflects: f64,
}

/// Returns the transmission and reflection of thin glass for light on its front or its back:
/// inter-reflections between the faces, summed one by one, with polarisations separate.
pub fn pane(glass: Bsdf, cos: f64, front: bool) -> Shares {
    let Bsdf::ThinDielectric {
        ior,
        transmittance,
        face,
    } = glass
    else {
        panic!("a pane is of thin glass");
    };
    let tint = f64::from(transmittance);
    let mut whole = Shares {
        passes: 0.0,
        reflects: 0.0,
    };
    for r in fresnel(1.0, f64::from(ior), cos) {
        whole.reflects += 0.5 * r;
        // Light within the pane, before it reaches its far face.
        let mut within = 1.0 - r;
        for _ in 0..10_000 {
            whole.passes += 0.5 * tint * within * (1.0 - r);
            whole.reflects += 0.5 * tint * tint * within * r * (1.0 - r);
            within *= r * r;
            if within < 1e-17 {
                break;
            }
        }
    }
    match (face, front) {
        (false, _) => whole,
        (true, true) => Shares {
            passes: whole.passes.sqrt(),
            ..whole
        },
        (true, false) => Shares {
            passes: whole.passes.sqrt(),
            reflects: 0.0,
        },
    }
}

/// Returns a direction after reflection at a surface of normal `n`.
pub fn mirrored(d: P, n: P) -> P {
    (d - n * (2.0 * n.dot(d))).unit()
}

/// Returns a direction after refraction at a surface with normal `n`, which faces the direction, or
/// `None` for total reflection.
pub fn refracted(d: P, n: P, from: f64, to: f64) -> Option<P> {
    // Snell: the component along the surface shrinks by the ratio of the indices.
    let along = (d - n * n.dot(d)) * (from / to);
    let rest = 1.0 - along.dot(along);
    (rest > 0.0).then(|| (along - n * rest.sqrt()).unit())
}

/// Returns the indices before and behind a glass surface that light hits.
fn indices(at: &Vertex, ior: f32) -> (f64, f64) {
    let body = f64::from(ior);
    if at.front { (1.0, body) } else { (body, 1.0) }
}

/// How legs are drawn.
#[derive(Debug, Clone, Copy)]
pub struct Draw {
    /// True if radiance is carried, from the camera's side: refraction scales it by the squared
    /// ratio of the indices. Otherwise flux is carried.
    pub camera: bool,
    /// True if panes reflect half of the legs that are straight so far, for callers that search for
    /// bent ones.
    pub bend: bool,
}

impl Draw {
    pub const LIGHT: Self = Self {
        camera: false,
        bend: false,
    };
    pub const CAMERA: Self = Self {
        camera: true,
        bend: false,
    };

    pub fn bending(self) -> Self {
        Self { bend: true, ..self }
    }
}

/// A leg of a path, up to the next surface other than glass.
#[derive(Debug, Clone, Copy)]
pub struct Leg {
    pub end: Vertex,
    /// Unit direction of arrival.
    pub d: P,
    /// Its fraction of the initial value, divided by its probability.
    pub weight: f64,
    pub reflections: u32,
    /// Whether it was reflected at glass, or refracted at a body's surface.
    pub bent: bool,
    /// Optical length, metres, and the index of refraction at its end.
    pub length: f64,
    pub index: f64,
}

impl Tracer {
    /// Draws a leg along a ray that starts in a medium with an index of refraction. Reflection or
    /// transmission at glass is decided at random.
    pub fn leg(
        &self,
        (mut p, mut d): (P, P),
        mut index: f64,
        draw: Draw,
        rng: &mut Noise,
    ) -> Option<Leg> {
        let (mut left, mut weight, mut length) = (NONE, 1.0, 0.0);
        let (mut reflections, mut bent) = (0, false);
        // Without Russian roulette: light may circulate within a body for long, and loses nothing.
        for _ in 0..LONGEST {
            let surface = self.tree.hit_but(p, d, f64::INFINITY, left);
            let limit = surface.map_or(f64::INFINITY, |s| s.t);
            if let Some(at) = self.tree.pane(p, d, limit, left) {
                let all = pane(at.bsdf, at.n.dot(d).abs(), at.front);
                let chance = match draw.bend && !bent && all.reflects > 0.0 {
                    true => 0.5,
                    false => all.reflects / (all.reflects + all.passes),
                };
                length += index * at.t;
                (p, left) = (at.p, at.triangle);
                if chance > 0.0 && rng.next() < chance {
                    weight *= all.reflects / chance;
                    d = mirrored(d, at.n);
                    (reflections, bent) = (reflections + 1, true);
                } else {
                    weight *= all.passes / (1.0 - chance);
                }
                continue;
            }
            let at = surface?;
            let Bsdf::Dielectric { ior, transmittance } = at.bsdf else {
                length += index * at.t;
                return Some(Leg {
                    end: at,
                    d,
                    weight,
                    reflections,
                    bent,
                    length,
                    index,
                });
            };
            let (from, to) = indices(&at, ior);
            length += from * at.t;
            bent = true;
            (p, left) = (at.p, at.triangle);
            let [s, q] = fresnel(from, to, at.n.dot(d).abs());
            let onwards = match rng.next() < 0.5 * (s + q) {
                true => None,
                false => refracted(d, at.n, from, to),
            };
            (d, index) = match onwards {
                Some(d) => {
                    weight *= f64::from(transmittance);
                    if draw.camera {
                        weight *= (from / to).powi(2);
                    }
                    (d, to)
                }
                None => {
                    reflections += 1;
                    (mirrored(d, at.n), from)
                }
            };
        }
        None
    }

    /// Returns whether a ray from the camera hits glass first.
    pub fn meets_glass(&self, d: P) -> bool {
        let hit = self.tree.hit(self.origin(), d, f64::INFINITY);
        let limit = hit.map_or(f64::INFINITY, |h| h.t);
        let body = hit.is_some_and(|h| matches!(h.bsdf, Bsdf::Dielectric { .. }));
        body || self.tree.pane(self.origin(), d, limit, NONE).is_some()
    }

    /// Returns the spots of beam `k`: the stated spot, or the spots found by following the beam.
    /// The beam is folded at near-mirrors by exact reflection. At glass it is transmitted, and a
    /// part of it is reflected. The transmitted part comes first.
    pub fn sources(&self, k: usize) -> Vec<Source> {
        let beam = &self.scene.laser.beams[k];
        if let Some(s) = beam.spot {
            let materials = &self.scene.objects[s.object as usize].mesh.materials;
            return vec![Source {
                p: s.point.into(),
                n: s.normal.into(),
                back: P::from(s.arriving) * -1.0,
                bsdf: materials[s.material as usize].bsdf,
            }];
        }
        let from = P::from(self.scene.laser.origin);
        let mut all = vec![];
        let d = P::from(beam.direction).unit();
        self.follow((from, d), NONE, 1.0, 64, &mut all);
        all
    }

    /// Adds the spots of a part of a beam with this share of its power, after at most `more`
    /// surfaces.
    fn follow(&self, (p, d): (P, P), left: usize, share: f64, more: u32, all: &mut Vec<Source>) {
        if share < LEAST_SHARE || more == 0 {
            return;
        }
        let surface = self.tree.hit_but(p, d, f64::INFINITY, left);
        let limit = surface.map_or(f64::INFINITY, |s| s.t);
        let Some(at) = self.tree.pane(p, d, limit, left).or(surface) else {
            return;
        };
        let mut on = |d: P, part: f64| {
            self.follow((at.p, d), at.triangle, share * part, more - 1, all);
        };
        let cos = at.n.dot(d).abs();
        match at.bsdf {
            Bsdf::ThinDielectric { .. } => {
                let shares = pane(at.bsdf, cos, at.front);
                on(d, shares.passes);
                on(mirrored(d, at.n), shares.reflects);
            }
            Bsdf::Dielectric { ior, transmittance } => {
                let (from, to) = indices(&at, ior);
                let [s, q] = fresnel(from, to, cos);
                let reflects = 0.5 * (s + q);
                if let Some(d) = refracted(d, at.n, from, to) {
                    on(d, (1.0 - reflects) * f64::from(transmittance));
                }
                on(mirrored(d, at.n), reflects);
            }
            bsdf if is_mirror(bsdf) => on(mirrored(d, at.n), 1.0),
            bsdf => all.push(Source {
                p: at.p,
                n: at.n,
                back: d * -1.0,
                bsdf: bsdf.scaled(share as f32),
            }),
        }
    }
}
