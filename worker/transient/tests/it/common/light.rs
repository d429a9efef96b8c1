//! An independent tracer in f64.
//!
//! Light paths start at a spot and scatter as the surfaces do, and each vertex outside near-mirrors
//! is connected to the camera. Light that the camera sees in near-mirrors is traced from the
//! camera's side: the glint of a spot by points drawn around its mirror image, all other light by
//! camera paths (both in [`super::seen`]). Glass is in [`super::glass`], and light that the camera
//! sees by its reflection and refraction in [`super::bent`]. The tracer shares no code with the
//! renderer.

use std::f64::consts::PI;

use picofarm_scene::{Bsdf, Distribution, Scene};

use super::{
    brute::{Noise, P, f},
    glass::Draw,
    tree::{NONE, Tree, Vertex},
};

/// A mean and its standard error.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Energy {
    pub mean: f64,
    pub se: f64,
}

impl Energy {
    /// Returns the mean and error of independent estimates of equal weight.
    pub fn of(all: &[f64]) -> Self {
        let n = all.len() as f64;
        let mean = all.iter().sum::<f64>() / n;
        let spread = all.iter().map(|x| (x - mean).powi(2)).sum::<f64>();
        let se = (spread / (n * (n - 1.0))).sqrt();
        Self { mean, se }
    }
}

impl std::ops::Add for Energy {
    type Output = Self;
    fn add(self, o: Self) -> Self {
        Self {
            mean: self.mean + o.mean,
            se: self.se.hypot(o.se),
        }
    }
}

/// Maximum bounces of light paths. Few reach it.
pub const LONGEST: u32 = 400;

/// Surfaces in f64 and a camera.
pub struct Tracer {
    pub tree: Tree,
    pub scene: Scene,
}

/// The start of light: a point in f64 that f32 could not represent, its normal, and the object of
/// its material, which is the object's first.
#[derive(Debug, Clone, Copy)]
pub struct Start {
    pub p: P,
    pub n: P,
    pub object: usize,
}

/// A spot: position, normal, unit direction back along the beam, scattering.
#[derive(Debug, Clone, Copy)]
pub struct Source {
    pub p: P,
    pub n: P,
    pub back: P,
    pub bsdf: Bsdf,
}

impl Source {
    /// Returns the radiant intensity per unit power towards a unit direction.
    pub fn intensity(&self, w: P) -> f64 {
        let c = self.n.dot(w);
        if c > 0.0 {
            f(self.bsdf, self.n, self.back, w) * c
        } else {
            0.0
        }
    }
}

/// Returns the roughness of a near-mirror. Beams are folded at near-mirrors, and the camera's side
/// takes over.
pub fn mirror(bsdf: Bsdf) -> Option<f64> {
    match bsdf {
        Bsdf::RoughConductor { alpha, .. } if alpha <= 0.1 => Some(f64::from(alpha)),
        _ => None,
    }
}

pub fn is_mirror(bsdf: Bsdf) -> bool {
    mirror(bsdf).is_some()
}

/// The bent legs of a path so far: reflected at glass, or refracted. A leg is the part of a path
/// between two vertices.
#[derive(Debug, Clone, Copy, Default)]
pub struct Bends {
    pub first: bool,
    pub any: bool,
    /// Whether any leg is not bent.
    pub straight: bool,
}

impl Bends {
    /// Returns the state after one more leg.
    pub fn and(self, bent: bool) -> Self {
        let none = !self.any && !self.straight;
        Self {
            first: if none { bent } else { self.first },
            any: self.any || bent,
            straight: self.straight || !bent,
        }
    }
}

/// The arrival of a light path: vertex, direction back, flux, bounces up to and including this one,
/// its legs.
#[derive(Debug, Clone, Copy)]
pub struct Arrival {
    pub at: Vertex,
    pub back: P,
    pub flux: f64,
    pub bounces: u32,
    pub bends: Bends,
}

impl Arrival {
    /// Returns the arrival of the laser at a spot.
    pub fn at_spot(s: &Source) -> Self {
        Self {
            at: Vertex {
                p: s.p,
                n: s.n,
                bsdf: s.bsdf,
                t: 0.0,
                front: true,
                triangle: NONE,
            },
            back: s.back,
            flux: 1.0,
            bounces: 1,
            bends: Bends::default(),
        }
    }
}

/// The camera's view of a light path's vertex, by a straight leg.
#[derive(Debug, Clone, Copy)]
pub struct Seen {
    pub pixel: usize,
    /// Three bounces and more.
    pub more: bool,
    /// Contribution to the mean.
    pub value: f64,
    /// Scattering of the vertex.
    pub bsdf: Bsdf,
    /// The legs except the one at the camera.
    pub bends: Bends,
}

impl Tracer {
    pub fn new(scene: &Scene) -> Self {
        Self {
            tree: Tree::new(scene),
            scene: scene.clone(),
        }
    }

    pub fn origin(&self) -> P {
        P::from(self.scene.camera.origin)
    }

    /// Returns the film position of a point, pixels, or `None` outside the image.
    pub fn film(&self, p: P) -> Option<(f64, f64)> {
        let c = &self.scene.camera;
        let i = &c.intrinsics;
        let to = p - self.origin();
        let depth = to.dot(c.forward.into());
        let x = f64::from(i.fx) * to.dot(c.right.into()) / depth + f64::from(i.cx);
        let y = f64::from(i.fy) * to.dot(c.down.into()) / depth + f64::from(i.cy);
        let inside = x >= 0.0 && y >= 0.0 && x < f64::from(i.width) && y < f64::from(i.height);
        (depth > 0.0 && inside).then_some((x, y))
    }

    /// Returns the unit direction of a film position.
    pub fn ray(&self, (x, y): (f64, f64)) -> P {
        let c = &self.scene.camera;
        let i = &c.intrinsics;
        let right = (x - f64::from(i.cx)) / f64::from(i.fx);
        let down = (y - f64::from(i.cy)) / f64::from(i.fy);
        (P::from(c.right) * right + P::from(c.down) * down + P::from(c.forward)).unit()
    }

    /// Returns the pixels of the film per unit of solid angle in the direction `w` from the camera.
    pub fn pixels_per_steradian(&self, w: P) -> f64 {
        let i = &self.scene.camera.intrinsics;
        let cos = P::from(self.scene.camera.forward).dot(w);
        f64::from(i.fx) * f64::from(i.fy) / cos.powi(3)
    }

    /// Returns the index of the pixel at a film position.
    pub fn pixel(&self, (x, y): (f64, f64)) -> usize {
        y as usize * self.scene.camera.intrinsics.width as usize + x as usize
    }

    /// Returns the pixel that sees a vertex of unit flux, and the radiance summed over the pixels.
    fn seen(&self, v: &Vertex, back: P) -> Option<(usize, f64)> {
        let film = self.film(v.p)?;
        let to = v.p - self.origin();
        let d = to.length();
        let w = to * (-1.0 / d);
        let co = v.n.dot(w);
        let free = co > 0.0 && self.tree.hit(v.p, w, d * (1.0 - 1e-9)).is_none();
        free.then(|| {
            let density = self.pixels_per_steradian(w * -1.0);
            let through = self.tree.through(v.p, self.origin());
            (
                self.pixel(film),
                f(v.bsdf, v.n, back, w) * co * density / (d * d) * through,
            )
        })
    }

    /// Returns the energy of the image by exactly two bounces, and by three and more, of the light
    /// of beam `k` that starts at `start`. Near-mirrors are treated like any other surface.
    pub fn energies(&self, k: usize, start: Start, paths: usize, seed: u64) -> [Energy; 2] {
        const BATCHES: usize = 50;
        let spot = self.scene.laser.beams[k].spot.expect("a stated spot");
        let source = Source {
            p: start.p,
            n: start.n,
            back: P::from(spot.arriving) * -1.0,
            bsdf: self.scene.objects[start.object].mesh.materials[0].bsdf,
        };
        let mut rng = Noise(seed);
        let batches: Vec<[f64; 2]> = (0..BATCHES)
            .map(|_| {
                let mut got = [0.0; 2];
                let all = (paths / BATCHES, LONGEST);
                self.carry(&source, all, &mut rng, |s| {
                    got[usize::from(s.more)] += s.value;
                });
                got
            })
            .collect();
        [0, 1].map(|part| Energy::of(&batches.iter().map(|b| b[part]).collect::<Vec<_>>()))
    }

    /// Traces light paths from a source, as [`Tracer::arrivals`] draws them. Calls `add` with each
    /// vertex that the camera sees.
    pub fn carry(
        &self,
        source: &Source,
        many: (usize, u32),
        rng: &mut Noise,
        mut add: impl FnMut(Seen),
    ) {
        self.arrivals(source, many, Draw::LIGHT, rng, |a| {
            if let Some((pixel, value)) = self.seen(&a.at, a.back) {
                add(Seen {
                    pixel,
                    more: a.bounces > 2,
                    value: a.flux * value,
                    bsdf: a.at.bsdf,
                    bends: a.bends,
                });
            }
            true
        });
    }

    /// Traces `paths` light paths from a source, of `longest` bounces at most, with stratified
    /// first directions. Calls `visit` with each vertex after the source; it returns whether the
    /// path continues.
    pub fn arrivals(
        &self,
        source: &Source,
        (paths, longest): (usize, u32),
        draw: Draw,
        rng: &mut Noise,
        mut visit: impl FnMut(&Arrival) -> bool,
    ) {
        let at = Vertex {
            p: source.p,
            n: source.n,
            bsdf: source.bsdf,
            t: 0.0,
            front: true,
            triangle: NONE,
        };
        let side = (paths as f64).sqrt() as usize;
        for path in 0..side * side {
            let mut a = Arrival {
                at,
                back: source.back,
                flux: 1.0 / (side * side) as f64,
                bounces: 1,
                bends: Bends::default(),
            };
            let mut index = 1.0;
            let cell = ((path % side) as f64, (path / side) as f64);
            let mut pair = [cell.0, cell.1].map(|k| (k + rng.next()) / side as f64);
            while a.bounces < longest {
                let Some((w, weight)) = scatter(&a.at, a.back, pair) else {
                    break;
                };
                a.flux *= weight;
                if a.bounces > 7 {
                    if rng.next() > 0.7 {
                        break;
                    }
                    a.flux /= 0.7;
                }
                let Some(leg) = self.leg((a.at.p, w), index, draw, rng) else {
                    break;
                };
                index = leg.index;
                a = Arrival {
                    at: leg.end,
                    back: leg.d * -1.0,
                    flux: a.flux * leg.weight,
                    bounces: a.bounces + 1 + leg.reflections,
                    bends: a.bends.and(leg.bent),
                };
                if a.bounces > longest || !visit(&a) {
                    break;
                }
                pair = [rng.next(), rng.next()];
            }
        }
    }
}

/// Returns two unit vectors at right angles to `n` and to each other.
pub fn frame(n: P) -> (P, P) {
    let side = if n.0.abs() > 0.7 {
        P(0.0, 1.0, 0.0)
    } else {
        P(1.0, 0.0, 0.0)
    };
    let t = n.cross(side).unit();
    (t, n.cross(t))
}

/// Returns a direction and f·cos/pdf from two numbers in [0, 1): cosine-distributed for Lambertian
/// surfaces, by Beckmann's half vectors for conductors.
pub fn scatter(v: &Vertex, back: P, [a, b]: [f64; 2]) -> Option<(P, f64)> {
    let mut alpha = None;
    if let Bsdf::RoughConductor {
        alpha: rough,
        distribution,
        ..
    } = v.bsdf
    {
        assert_eq!(distribution, Distribution::Beckmann);
        alpha = Some(f64::from(rough));
    }
    let (t, u) = frame(v.n);
    let angle = 2.0 * PI * a;
    let around = t * angle.cos() + u * angle.sin();
    let (w, pdf) = match alpha {
        None => {
            let z = (1.0 - b).sqrt();
            (around * b.sqrt() + v.n * z, z / PI)
        }
        Some(alpha) => {
            let slope = alpha * (-(1.0 - b).ln()).sqrt();
            let h = (around * slope + v.n).unit();
            let ih = back.dot(h);
            let ch = v.n.dot(h);
            let tan2 = (1.0 - ch * ch) / (ch * ch);
            let d = (-tan2 / (alpha * alpha)).exp() / (PI * alpha * alpha * ch.powi(4));
            (h * (2.0 * ih) - back, d * ch / (4.0 * ih))
        }
    };
    let co = v.n.dot(w);
    (co > 0.0 && pdf > 0.0).then(|| (w, f(v.bsdf, v.n, back, w) * co / pdf))
}
