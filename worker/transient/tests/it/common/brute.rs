//! An independent renderer of small scenes in f64, without a hierarchy and without code shared with
//! the renderer. Rays are tested against every triangle; integrals are computed by quadrature or
//! plain path tracing.

use std::f64::consts::PI;

use picofarm_scene::{Bsdf, Distribution, Scene, Vec3};
use picofarm_transient::Gate;

/// A point or direction, metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct P(pub f64, pub f64, pub f64);

impl P {
    pub fn dot(self, o: P) -> f64 {
        self.0 * o.0 + self.1 * o.1 + self.2 * o.2
    }
    pub fn cross(self, o: P) -> P {
        P(
            self.1 * o.2 - self.2 * o.1,
            self.2 * o.0 - self.0 * o.2,
            self.0 * o.1 - self.1 * o.0,
        )
    }
    pub fn length(self) -> f64 {
        self.dot(self).sqrt()
    }
    pub fn unit(self) -> P {
        self * (1.0 / self.length())
    }
}

impl std::ops::Add for P {
    type Output = P;
    fn add(self, o: P) -> P {
        P(self.0 + o.0, self.1 + o.1, self.2 + o.2)
    }
}

impl std::ops::Sub for P {
    type Output = P;
    fn sub(self, o: P) -> P {
        P(self.0 - o.0, self.1 - o.1, self.2 - o.2)
    }
}

impl std::ops::Mul<f64> for P {
    type Output = P;
    fn mul(self, s: f64) -> P {
        P(self.0 * s, self.1 * s, self.2 * s)
    }
}

impl From<Vec3> for P {
    fn from(v: Vec3) -> P {
        P(f64::from(v.x), f64::from(v.y), f64::from(v.z))
    }
}

/// A surface point: position, unit normal on the side it was seen from, scattering.
#[derive(Debug, Clone, Copy)]
pub struct Point {
    pub p: P,
    pub n: P,
    pub bsdf: Bsdf,
    pub t: f64,
}

/// A scene of few triangles, all of them two-sided.
pub struct Brute {
    triangles: Vec<([P; 3], P, Bsdf)>,
    scene: Scene,
}

impl Brute {
    pub fn new(scene: &Scene) -> Self {
        let mut triangles = vec![];
        for o in &scene.objects {
            for (t, &m) in o.mesh.triangles.iter().zip(&o.mesh.triangle_material) {
                let v = t.map(|i| P::from(o.to_world.point(o.mesh.positions[i as usize])));
                let n = (v[1] - v[0]).cross(v[2] - v[0]);
                if n.length() > 0.0 {
                    triangles.push((v, n.unit(), o.mesh.materials[m as usize].bsdf));
                }
            }
        }
        Self {
            triangles,
            scene: scene.clone(),
        }
    }

    /// Returns the first surface along a ray, beyond 1e-7.
    pub fn hit(&self, o: P, d: P) -> Option<Point> {
        let mut best: Option<Point> = None;
        for (v, n, bsdf) in &self.triangles {
            let (e, f) = (v[1] - v[0], v[2] - v[0]);
            let h = d.cross(f);
            let det = e.dot(h);
            if det == 0.0 {
                continue;
            }
            let s = o - v[0];
            let u = s.dot(h) / det;
            let q = s.cross(e);
            let w = d.dot(q) / det;
            let t = f.dot(q) / det;
            if u >= 0.0 && w >= 0.0 && u + w <= 1.0 && t > 1e-7 && best.is_none_or(|b| t < b.t) {
                let n = if n.dot(d) <= 0.0 { *n } else { *n * -1.0 };
                best = Some(Point {
                    p: o + d * t,
                    n,
                    bsdf: *bsdf,
                    t,
                });
            }
        }
        best
    }

    /// Returns true if nothing occludes the segment between two points (except their own surfaces).
    pub fn free(&self, a: P, b: P) -> bool {
        self.hit(a, b - a).is_none_or(|h| h.t > 1.0 - 1e-7)
    }

    /// Returns the surface point that the camera sees at a film position, and the unit direction
    /// back.
    pub fn seen(&self, x: f64, y: f64) -> Option<(Point, P)> {
        let c = &self.scene.camera;
        let i = &c.intrinsics;
        let (fx, fy) = (f64::from(i.fx), f64::from(i.fy));
        let d = P::from(c.right) * ((x - f64::from(i.cx)) / fx)
            + P::from(c.down) * ((y - f64::from(i.cy)) / fy)
            + P::from(c.forward);
        let hit = self.hit(P::from(c.origin), d)?;
        Some((hit, d.unit() * -1.0))
    }

    /// Returns beam `k`'s spot: position, normal, direction back to the laser, scattering, path
    /// length.
    pub fn spot(&self, k: usize) -> (Point, P, f64) {
        let s = self.scene.laser.beams[k].spot.expect("a stated spot");
        let bsdf = self.scene.objects[s.object as usize].mesh.materials[s.material as usize].bsdf;
        let point = Point {
            p: s.point.into(),
            n: s.normal.into(),
            bsdf,
            t: 0.0,
        };
        (point, P::from(s.arriving) * -1.0, f64::from(s.path_m))
    }

    /// Returns the radiance from `x` towards `wo` by one scattering of the light of spot `k`: its
    /// value and the path length from the laser to `x`.
    pub fn lit(&self, x: &Point, wo: P, k: usize) -> (f64, f64) {
        let (s, back, path) = self.spot(k);
        let to = s.p - x.p;
        let d = to.length();
        let w = to * (1.0 / d);
        let (cs, cx) = (-s.n.dot(w), x.n.dot(w));
        if !(cs > 0.0 && cx > 0.0 && self.free(x.p, s.p)) {
            return (0.0, 0.0);
        }
        let intensity = f(s.bsdf, s.n, back, w * -1.0) * cs;
        (f(x.bsdf, x.n, wo, w) * cx * intensity / (d * d), path + d)
    }

    /// Calls `value` with the surface point seen at each of `n`×`n` midpoints of a pixel, and the
    /// direction back. Midpoints without a surface are skipped.
    pub fn pixel(&self, col: usize, row: usize, n: usize, mut value: impl FnMut(&Point, P)) {
        for k in 0..n * n {
            let at = |i: usize| (i as f64 + 0.5) / n as f64;
            if let Some((x, wo)) = self.seen(col as f64 + at(k % n), row as f64 + at(k / n)) {
                value(&x, wo);
            }
        }
    }

    /// Plain path tracing with cosine-distributed directions. Returns the mean radiance of the
    /// image by number of bounces (index 2, 3, …) and its standard errors, from `paths` camera
    /// paths.
    pub fn trace(&self, longest: usize, paths: usize, seed: u64) -> Vec<(f64, f64)> {
        let i = self.scene.camera.intrinsics;
        let mut rng = Noise(seed);
        let mut sums = vec![(0.0f64, 0.0f64); longest + 1];
        for _ in 0..paths {
            let (x, y) = (
                rng.next() * f64::from(i.width),
                rng.next() * f64::from(i.height),
            );
            let Some((mut at, mut wo)) = self.seen(x, y) else {
                continue;
            };
            let mut beta = 1.0;
            for (bounces, sum) in sums.iter_mut().enumerate().skip(2) {
                let got = beta * self.lit(&at, wo, 0).0;
                sum.0 += got;
                sum.1 += got * got;
                if bounces == longest {
                    break;
                }
                let w = rng.cosine(at.n);
                beta *= f(at.bsdf, at.n, wo, w) * PI;
                let Some(next) = self.hit(at.p, w) else { break };
                (at, wo) = (next, w * -1.0);
            }
        }
        let n = paths as f64;
        sums.iter()
            .map(|&(a, b)| (a / n, ((b / n - (a / n).powi(2)) / n).max(0.0).sqrt()))
            .collect()
    }
}

/// Returns exactly two bounces by quadrature: `[pixel][bin]`.
pub fn two_by_quadrature(s: &Scene, g: &Gate, n: usize) -> Vec<f64> {
    let brute = Brute::new(s);
    let i = s.camera.intrinsics;
    let bins = g.bins as usize;
    let (w, h) = (i.width as usize, i.height as usize);
    let mut all = vec![0.0; w * h * bins];
    for k in 0..w * h {
        brute.pixel(k % w, k / w, n, |x, wo| {
            for spot in 0..s.laser.beams.len() {
                let (value, path) = brute.lit(x, wo, spot);
                let path = path + (x.p - P::from(s.camera.origin)).length();
                if let Some(b) = g.bin(path) {
                    all[k * bins + b as usize] += value / (n * n) as f64;
                }
            }
        });
    }
    all
}

/// Returns the BRDF, 1/sr, for unit directions that leave the surface.
pub fn f(bsdf: Bsdf, n: P, i: P, o: P) -> f64 {
    match bsdf {
        Bsdf::Diffuse { reflectance } => f64::from(reflectance) / PI,
        Bsdf::RoughConductor {
            alpha,
            distribution,
            reflectance,
        } => f64::from(reflectance) * conductor(f64::from(alpha), distribution, n, i, o),
        Bsdf::Mixed {
            reflectance,
            alpha,
            distribution,
            specular_reflectance,
            weight,
        } => {
            let w = f64::from(weight);
            let rough = conductor(f64::from(alpha), distribution, n, i, o);
            (1.0 - w) * f64::from(reflectance) / PI + w * f64::from(specular_reflectance) * rough
        }
        Bsdf::ThinDielectric { .. } | Bsdf::Dielectric { .. } => panic!("glass scatters nothing"),
    }
}

/// Walter et al. 2007, equations 20, 25 to 27, 33 and 34, with Fresnel term 1.
fn conductor(alpha: f64, distribution: Distribution, n: P, i: P, o: P) -> f64 {
    let (ci, co) = (n.dot(i), n.dot(o));
    if !(ci > 0.0 && co > 0.0) {
        return 0.0;
    }
    let c = n.dot((i + o).unit()).min(1.0);
    let tan2 = (1.0 - c * c) / (c * c);
    let a2 = alpha * alpha;
    let d = match distribution {
        Distribution::Beckmann => (-tan2 / a2).exp() / (PI * a2 * c.powi(4)),
        Distribution::Ggx => a2 / (PI * c.powi(4) * (a2 + tan2).powi(2)),
    };
    let g = |c: f64| {
        let tan = (1.0 - c * c).max(0.0).sqrt() / c;
        match distribution {
            Distribution::Ggx => 2.0 / (1.0 + (1.0 + a2 * tan * tan).sqrt()),
            Distribution::Beckmann => {
                let a = 1.0 / (alpha * tan);
                if a < 1.6 {
                    (3.535 * a + 2.181 * a * a) / (1.0 + 2.276 * a + 2.577 * a * a)
                } else {
                    1.0
                }
            }
        }
    };
    d * g(ci) * g(co) / (4.0 * ci * co)
}

/// SplitMix64.
pub struct Noise(pub u64);

impl Noise {
    pub fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    }

    fn cosine(&mut self, n: P) -> P {
        let side = if n.0.abs() > 0.7 {
            P(0.0, 1.0, 0.0)
        } else {
            P(1.0, 0.0, 0.0)
        };
        let t = n.cross(side).unit();
        let b = n.cross(t);
        let (angle, r2) = (2.0 * PI * self.next(), self.next());
        let r = r2.sqrt();
        t * (r * angle.cos()) + b * (r * angle.sin()) + n * (1.0 - r2).sqrt()
    }
}
