//! Light that the camera sees in near-mirrors, traced from the camera's side: see [`super::light`].

use std::f64::consts::PI;

use super::{
    brute::{Noise, P, f},
    light::{Source, Tracer, frame, is_mirror, mirror, scatter},
    tree::Vertex,
};

/// Range of angles of the lobes around mirror images, radians. It includes any lobe of a
/// near-mirror.
const ANGLES: [f64; 2] = [1e-6, PI];

/// A facet of a near-mirror and a spot that both the camera and the facet's lit side may see.
struct Pair<'a> {
    corners: [P; 3],
    area: f64,
    source: &'a Source,
    /// The position at which a perfect mirror in the facet's plane would show the spot.
    glint: P,
    /// The radius of the lobe around `glint`, metres.
    reach: f64,
    /// The sum of the probabilities of all pairs up to this one.
    chance: f64,
}

/// A plane that contains near-mirrors: a point and a unit normal.
type Plane = (P, P);

/// Returns the mirror image of a point in a plane.
fn image(p: P, (o, n): Plane) -> P {
    p - n * (2.0 * (p - o).dot(n))
}

impl Tracer {
    /// Returns the corners, unit normal, area and roughness of the facets of near-mirrors.
    fn facets(&self) -> Vec<([P; 3], P, f64, f64)> {
        let mut facets = vec![];
        for o in &self.scene.objects {
            for (t, &m) in o.mesh.triangles.iter().zip(&o.mesh.triangle_material) {
                let Some(alpha) = mirror(o.mesh.materials[m as usize].bsdf) else {
                    continue;
                };
                let v = t.map(|i| P::from(o.to_world.point(o.mesh.positions[i as usize])));
                let n = (v[1] - v[0]).cross(v[2] - v[0]);
                facets.push((v, n.unit(), 0.5 * n.length(), alpha));
            }
        }
        facets
    }

    /// Returns the planes of all near-mirrors, each once.
    fn planes(&self) -> Vec<Plane> {
        let mut planes: Vec<Plane> = vec![];
        for (v, n, ..) in self.facets() {
            let known = planes
                .iter()
                .any(|&(o, m)| m.dot(n).abs() > 1.0 - 1e-9 && (v[0] - o).dot(m).abs() < 1e-6);
            if !known {
                planes.push((v[0], n));
            }
        }
        planes
    }

    /// Samples exactly two bounces, the second on a near-mirror: `samples` points on facets, drawn
    /// around the glints of the spots and evenly. Calls `add` for each with its pixel and
    /// contribution to the mean.
    pub fn glints(
        &self,
        sources: &[Source],
        samples: usize,
        rng: &mut Noise,
        mut add: impl FnMut(usize, f64),
    ) {
        let origin = self.origin();
        let mut pairs: Vec<Pair> = vec![];
        let mut total = 0.0;
        for (corners, n, area, alpha) in self.facets() {
            for source in sources {
                let (c, s) = ((origin - corners[0]).dot(n), (source.p - corners[0]).dot(n));
                if c * s <= 0.0 {
                    continue;
                }
                let glint = origin + (image(source.p, (corners[0], n)) - origin) * (c / (c + s));
                let (a, b) = ((glint - origin).length(), (source.p - glint).length());
                let cos = (glint - origin).unit().dot(n).abs();
                let reach = 4.0 * alpha * a * b / (a + b) / cos;
                let off = (0..3).map(|k| {
                    let (from, to) = (corners[k], corners[(k + 1) % 3]);
                    n.cross(to - from).unit().dot(from - glint).max(0.0)
                });
                let off = off.fold(0.0, f64::max) / reach;
                total += 1e-3 + (-off * off).exp();
                pairs.push(Pair {
                    corners,
                    area,
                    source,
                    glint,
                    reach,
                    chance: total,
                });
            }
        }
        if pairs.is_empty() {
            return;
        }
        for _ in 0..samples {
            let at = total * rng.next();
            let index = pairs
                .partition_point(|p| p.chance <= at)
                .min(pairs.len() - 1);
            let before = index.checked_sub(1).map_or(0.0, |k| pairs[k].chance);
            let Pair {
                corners,
                area,
                source,
                glint,
                reach,
                chance,
            } = &pairs[index];
            let share = (chance - before) / total;
            let (e, g) = (corners[1] - corners[0], corners[2] - corners[0]);
            let n = e.cross(g).unit();
            let p = if rng.next() < 0.5 {
                let (a, b) = (rng.next().sqrt(), rng.next());
                corners[0] + e * (a * (1.0 - b)) + g * (a * b)
            } else {
                let r = reach * (-(1.0 - rng.next()).ln()).sqrt();
                let (t, u) = frame(n);
                let angle = 2.0 * PI * rng.next();
                *glint + t * (r * angle.cos()) + u * (r * angle.sin())
            };
            // Barycentric coordinates from areas.
            let part = |a: P, b: P| (a - p).cross(b - p).dot(n);
            let inside = part(corners[0], corners[1]) >= 0.0
                && part(corners[1], corners[2]) >= 0.0
                && part(corners[2], corners[0]) >= 0.0;
            let Some(film) = self.film(p).filter(|_| inside) else {
                continue;
            };
            let to = p - origin;
            let w = to.unit();
            let limit = to.length() * (1.0 - 1e-9);
            if self.tree.hit(origin, w, limit).is_some() {
                continue;
            }
            // The hit on the facet itself, for the scattering of its side.
            let Some(vertex) = self.tree.hit(origin, w, to.length() * (1.0 + 1e-9)) else {
                continue;
            };
            let r = (p - *glint).length() / reach;
            let radial = (-r * r).exp() / (PI * reach * reach);
            let density = share * (0.5 / area + 0.5 * radial);
            let value = self.lit(&vertex, w * -1.0, source);
            let films = self.pixels_per_steradian(w) * vertex.n.dot(w * -1.0) / to.dot(to);
            let value = value * self.tree.through(origin, p);
            add(self.pixel(film), value * films / density / samples as f64);
        }
    }

    /// Returns the radiance towards `wo` by one scattering of a spot's light.
    pub fn lit(&self, x: &Vertex, wo: P, source: &Source) -> f64 {
        let to = source.p - x.p;
        let d = to.length();
        let w = to * (1.0 / d);
        let cos = x.n.dot(w);
        let intensity = source.intensity(w * -1.0);
        if !(cos > 0.0 && intensity > 0.0) {
            return 0.0;
        }
        let value = f(x.bsdf, x.n, wo, w) * cos * intensity / (d * d);
        if value > 0.0 && self.tree.free(x.p, source.p) {
            value * self.tree.through(x.p, source.p)
        } else {
            0.0
        }
    }

    /// Samples three bounces and more, the last on a near-mirror that the camera sees: `samples`
    /// camera paths, nine in ten through the pixels of `likely`. From other surfaces, half of the
    /// directions are drawn around the mirror images of the spots.
    pub fn through_mirrors(
        &self,
        sources: &[Source],
        likely: &[usize],
        samples: usize,
        rng: &mut Noise,
        mut add: impl FnMut(usize, f64),
    ) {
        let images: Vec<P> = self
            .planes()
            .iter()
            .flat_map(|&plane| sources.iter().map(move |s| image(s.p, plane)))
            .collect();
        if images.is_empty() {
            return;
        }
        let films = Films::new(self, likely);
        for sample in 0..samples {
            let (film, unit) = films.draw(sample, samples, rng);
            let d = self.ray(film);
            let Some(mut at) = self.tree.hit(self.origin(), d, f64::INFINITY) else {
                continue;
            };
            if !is_mirror(at.bsdf) {
                continue;
            }
            let unit = unit * self.tree.through(self.origin(), at.p);
            let (mut back, mut beta, mut got) = (d * -1.0, unit, 0.0);
            for bounces in 3..400 {
                let pair = [rng.next(), rng.next()];
                let drawn = match is_mirror(at.bsdf) {
                    true => scatter(&at, back, pair),
                    false => toward(&at, back, &images, pair, rng),
                };
                let Some((w, weight)) = drawn else { break };
                beta *= weight;
                if bounces > 8 {
                    if rng.next() > 0.7 {
                        break;
                    }
                    beta /= 0.7;
                }
                let Some(next) = self.tree.hit(at.p, w, f64::INFINITY) else {
                    break;
                };
                beta *= self.tree.through(at.p, next.p);
                (at, back) = (next, w * -1.0);
                let one = (rng.next() * sources.len() as f64) as usize;
                got += beta * sources.len() as f64 * self.lit(&at, back, &sources[one]);
            }
            add(self.pixel(film), got);
        }
    }
}

/// Film positions: nine in ten are in pixels of a list, the others anywhere.
pub struct Films<'a> {
    likely: &'a [usize],
    listed: Vec<bool>,
    chosen: f64,
    width: usize,
}

impl<'a> Films<'a> {
    pub fn new(tracer: &Tracer, likely: &'a [usize]) -> Self {
        let i = &tracer.scene.camera.intrinsics;
        let mut listed = vec![false; (i.width * i.height) as usize];
        for &k in likely {
            listed[k] = true;
        }
        Self {
            likely,
            listed,
            chosen: if likely.is_empty() { 0.0 } else { 0.9 },
            width: i.width as usize,
        }
    }

    /// Returns one of `samples` positions, and its weight in the sum over the pixels of their
    /// means.
    pub fn draw(&self, sample: usize, samples: usize, rng: &mut Noise) -> ((f64, f64), f64) {
        let (chosen, pixels) = (self.chosen, self.listed.len() as f64);
        // Pixels are taken in turn, so that each gets its share.
        let turn = (sample as f64 + rng.next()) / samples as f64;
        let pixel = if turn < chosen {
            self.likely[(turn / chosen * self.likely.len() as f64) as usize]
        } else {
            ((turn - chosen) / (1.0 - chosen) * pixels) as usize
        };
        let mut density = (1.0 - chosen) / pixels;
        if self.listed[pixel] {
            density += chosen / self.likely.len() as f64;
        }
        let film = (
            (pixel % self.width) as f64 + rng.next(),
            (pixel / self.width) as f64 + rng.next(),
        );
        (film, 1.0 / (density * samples as f64))
    }
}

/// Returns a direction and f·cos/pdf: half of the directions are cosine-distributed, half are
/// around the directions of `images`.
fn toward(v: &Vertex, back: P, images: &[P], pair: [f64; 2], rng: &mut Noise) -> Option<(P, f64)> {
    let spread = (ANGLES[1] / ANGLES[0]).ln();
    let w = if rng.next() < 0.5 {
        let (t, u) = frame(v.n);
        let angle = 2.0 * PI * pair[0];
        let around = t * angle.cos() + u * angle.sin();
        around * pair[1].sqrt() + v.n * (1.0 - pair[1]).sqrt()
    } else {
        let one = (rng.next() * images.len() as f64) as usize;
        let axis = (images[one] - v.p).unit();
        let (t, u) = frame(axis);
        let angle = 2.0 * PI * pair[0];
        let off = ANGLES[0] * (spread * pair[1]).exp();
        let around = t * angle.cos() + u * angle.sin();
        (axis * off.cos() + around * off.sin()).unit()
    };
    let co = v.n.dot(w);
    if co <= 0.0 {
        return None;
    }
    let lobes: f64 = images
        .iter()
        .map(|&i| {
            let axis = (i - v.p).unit();
            let sin = axis.cross(w).length();
            let off = sin.atan2(axis.dot(w));
            match off > ANGLES[0] && off < ANGLES[1] && sin > 0.0 {
                true => 1.0 / (2.0 * PI * sin * off * spread),
                false => 0.0,
            }
        })
        .sum();
    let pdf = 0.5 * co / PI + 0.5 * lobes / images.len() as f64;
    Some((w, f(v.bsdf, v.n, back, w) * co / pdf))
}
