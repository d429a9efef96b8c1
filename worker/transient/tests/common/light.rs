//! An independent tracer of light paths in f64: from a spot by the surfaces' own scattering, each vertex connected to the
//! camera. It shares no code with the renderer, and no estimator: the renderer has no such paths but in special cases.

use std::f64::consts::PI;

use picofarm_scene::{Bsdf, Distribution, Scene};

use super::brute::{Noise, P, f};

/// A mean and its standard error.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Energy {
    pub mean: f64,
    pub se: f64,
}

/// A vertex: place, unit normal on the side of the light, scattering.
#[derive(Clone, Copy)]
struct Vertex {
    p: P,
    n: P,
    bsdf: Bsdf,
}

/// Triangles in f64 and a camera.
pub struct Tracer {
    triangles: Vec<([P; 3], P, Bsdf)>,
    scene: Scene,
}

/// Where light starts: a point in f64 that f32 could not hold, its normal, and the object whose first material it has.
#[derive(Debug, Clone, Copy)]
pub struct Start {
    pub p: P,
    pub n: P,
    pub object: usize,
}

impl Tracer {
    pub fn new(scene: &Scene) -> Self {
        let mut triangles = vec![];
        for o in &scene.objects {
            for (t, &m) in o.mesh.triangles.iter().zip(&o.mesh.triangle_material) {
                let v = t.map(|i| P::from(o.to_world.point(o.mesh.positions[i as usize])));
                let n = (v[1] - v[0]).cross(v[2] - v[0]);
                triangles.push((v, n.unit(), o.mesh.materials[m as usize].bsdf));
            }
        }
        Self {
            triangles,
            scene: scene.clone(),
        }
    }

    /// The first surface beyond 1e-11 along a unit direction.
    fn hit(&self, o: P, d: P, limit: f64) -> Option<Vertex> {
        let (mut nearest, mut best) = (limit, None);
        for (v, n, bsdf) in &self.triangles {
            let (e, f) = (v[1] - v[0], v[2] - v[0]);
            let h = d.cross(f);
            let det = e.dot(h);
            if det.abs() < 1e-30 {
                continue;
            }
            let s = o - v[0];
            let (u, q) = (s.dot(h) / det, s.cross(e));
            let (w, t) = (d.dot(q) / det, f.dot(q) / det);
            let inside = u >= -1e-12 && w >= -1e-12 && u + w <= 1.0 + 1e-12;
            if inside && t > 1e-11 && t < nearest {
                nearest = t;
                let n = if n.dot(d) <= 0.0 { *n } else { *n * -1.0 };
                best = Some(Vertex {
                    p: o + d * t,
                    n,
                    bsdf: *bsdf,
                });
            }
        }
        best
    }

    /// What a vertex of unit flux sends to the camera: the sum over the pixels of the radiance they see.
    fn seen(&self, v: &Vertex, back: P) -> f64 {
        let c = &self.scene.camera;
        let i = &c.intrinsics;
        let to = v.p - P::from(c.origin);
        let q = P(
            to.dot(c.right.into()),
            to.dot(c.down.into()),
            to.dot(c.forward.into()),
        );
        let d = to.length();
        let (fx, fy) = (f64::from(i.fx), f64::from(i.fy));
        let (x, y) = (
            fx * q.0 / q.2 + f64::from(i.cx),
            fy * q.1 / q.2 + f64::from(i.cy),
        );
        let inside = x >= 0.0 && y >= 0.0 && x < f64::from(i.width) && y < f64::from(i.height);
        let w = to * (-1.0 / d);
        let co = v.n.dot(w);
        if !(q.2 > 0.0 && inside && co > 0.0) || self.hit(v.p, w, d * (1.0 - 1e-9)).is_some() {
            return 0.0;
        }
        let cos = q.2 / d;
        f(v.bsdf, v.n, back, w) * co * fx * fy / (d * d * cos * cos * cos)
    }

    /// Energy of the image by exactly two bounces, and by three and more, of the light of beam `k` that starts at `start`.
    pub fn energies(&self, k: usize, start: Start, paths: usize, seed: u64) -> [Energy; 2] {
        let spot = self.scene.laser.beams[k].spot.expect("a stated spot");
        let first = Vertex {
            p: start.p,
            n: start.n,
            bsdf: self.scene.objects[start.object].mesh.materials[0].bsdf,
        };
        let mut rng = Noise(seed);
        let mut sums = [(0.0f64, 0.0f64); 2];
        for _ in 0..paths {
            let mut got = [0.0; 2];
            let (mut at, mut back, mut flux) = (first, P::from(spot.arriving) * -1.0, 1.0);
            for bounces in 2..400 {
                let Some((w, weight)) = scatter(&at, back, &mut rng) else {
                    break;
                };
                flux *= weight;
                if bounces > 8 {
                    if rng.next() > 0.7 {
                        break;
                    }
                    flux /= 0.7;
                }
                let Some(next) = self.hit(at.p, w, f64::INFINITY) else {
                    break;
                };
                (at, back) = (next, w * -1.0);
                got[usize::from(bounces > 2)] += flux * self.seen(&at, back);
            }
            for (sum, got) in sums.iter_mut().zip(got) {
                sum.0 += got;
                sum.1 += got * got;
            }
        }
        let n = paths as f64;
        sums.map(|(a, b)| Energy {
            mean: a / n,
            se: ((b / n - (a / n).powi(2)) / n).max(0.0).sqrt(),
        })
    }
}

/// A direction and f·cos/pdf: cosine-distributed for Lambertians, by Beckmann's half vectors for conductors.
fn scatter(v: &Vertex, back: P, rng: &mut Noise) -> Option<(P, f64)> {
    let mut alpha = None;
    if let Bsdf::RoughConductor {
        alpha: a,
        distribution,
        ..
    } = v.bsdf
    {
        assert_eq!(distribution, Distribution::Beckmann);
        alpha = Some(f64::from(a));
    }
    let side = if v.n.0.abs() > 0.7 {
        P(0.0, 1.0, 0.0)
    } else {
        P(1.0, 0.0, 0.0)
    };
    let t = v.n.cross(side).unit();
    let b = v.n.cross(t);
    let angle = 2.0 * PI * rng.next();
    let around = t * angle.cos() + b * angle.sin();
    let (w, pdf) = match alpha {
        None => {
            let r2 = rng.next();
            let z = (1.0 - r2).sqrt();
            (around * r2.sqrt() + v.n * z, z / PI)
        }
        Some(alpha) => {
            let slope = alpha * (-(1.0 - rng.next()).ln()).sqrt();
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
