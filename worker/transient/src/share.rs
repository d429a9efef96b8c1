//! Path reuse: three bounces and more for a tile of neighbouring pixels at once.
//!
//! Every pixel of a tile brings one *gather point*: the first surface point along a camera path that is
//! not a near-mirror. *Shared vertices* are drawn from the gather points' scattering and from the spots',
//! and every gather point is connected to every shared vertex (Bekaert, Sbert and Halton, EGWR 2002;
//! vertices from the light side as in Segovia et al., EGSR 2006). A shared vertex sends out its direct
//! light from all spots, found exactly, and what a few random walks bring: one shadow ray carries a whole
//! list of arrivals to a pixel. All ways of drawing a shared vertex are joined by the balance heuristic
//! with visibility in the densities, so both 1/d² singularities, at the gather point and at the spot, stay
//! bounded.
//!
//! What only one pixel can see, namely light by way of a near-mirror or a glossy surface, is walked for
//! that pixel alone.

use std::f32::consts::PI;

use picofarm_scene::Vec3;

use crate::{
    bsdf::{Surface, frame},
    ellipsoid::{Patches, Shells},
    emitter::Columns,
    film::{Film, PixelSink},
    rng::{Rng, Stream},
    walk::{ALL, Lights, Scratch, Sink, Vertex, Walk},
    world::{Hit, lift},
};

/// How much a pass does.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Effort {
    /// Side of a tile in pixels.
    pub side: u32,
    /// Shared vertices drawn from gather points, for each pixel.
    pub camera: f32,
    /// Shared vertices drawn from spots, for each pixel.
    pub light: f32,
    /// Shared vertices drawn in a narrow gate's shells, for each pixel.
    pub shell: f32,
    /// Walks from each shared vertex.
    pub walks: u32,
    /// Light vertices that walks of one pass connect to.
    pub pool: u32,
    /// Light paths by way of near-mirrors, for each pixel, where there are any.
    pub beyond: f32,
}

/// Light vertices beyond near-mirrors that a gather point is connected to at most.
const BEYOND: u32 = 2;
/// Glossy light vertices that a gather point is connected to at most.
const GLOSSY: u32 = 2;

impl Effort {
    /// The effort for tiles of `side` pixels. The numbers minimise error² × CPU time on furnished rooms
    /// with 1 and 25 spots, where the optimum is flat: twice as many vertices or walks cost within 10 %.
    pub fn new(side: u32, narrow: bool) -> Self {
        Self {
            side,
            camera: 1.0,
            light: 0.5,
            shell: if narrow { 1.0 } else { 0.0 },
            walks: 1,
            pool: 16,
            beyond: 1.0,
        }
    }
}

/// A vertex that all gather points of a tile share.
#[derive(Debug, Clone, Copy)]
struct Shared {
    hit: Hit,
    /// Expected number of such vertices per area, from the spots' side and in a narrow gate's shells.
    light: f32,
    /// Its arrivals.
    first: usize,
    end: usize,
}

/// What arrives at a shared vertex and goes on, per unit solid angle, to every side.
#[derive(Debug, Default)]
struct Arrivals {
    /// Optical path from the laser, in bins.
    bins: Vec<f32>,
    value: Vec<f32>,
    spot: Vec<u16>,
    /// Bounces of the whole path where the gather point is the first.
    bounces: Vec<u8>,
}

/// Adds arrivals; lengths counted from `base_m`.
struct ArrivalSink<'a> {
    list: &'a mut Arrivals,
    base_m: f64,
    per_metre: f64,
    factor: f32,
}

impl Sink for ArrivalSink<'_> {
    #[inline]
    fn add(&mut self, path_m: f64, value: f32, spot: usize, bounces: u32) {
        let list = &mut *self.list;
        list.bins
            .push(((path_m - self.base_m) * self.per_metre) as f32);
        list.value.push(self.factor * value);
        list.spot.push(spot as u16);
        list.bounces.push(bounces.min(255) as u8);
    }
}

/// Where a pass stands: the tile's first pixel and its columns, the image's width, and the pass' number.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Tile {
    pub row: u32,
    pub col: u32,
    pub cols: u32,
    pub width: u32,
    pub seed: u64,
    pub pass: u64,
}

/// Buffers of one thread's passes.
#[derive(Debug, Default)]
pub(crate) struct Sharing {
    gathers: Vec<(Vertex, usize)>,
    columns: Columns,
    /// Indices of gather points that are not Lambertian.
    glossy: Vec<usize>,
    shared: Vec<Shared>,
    arrivals: Arrivals,
    /// Segments of one shared vertex: where they end, of what, and whether something is in the way.
    ends: Vec<Vec3>,
    ends_of: Vec<usize>,
    blocked: Vec<bool>,
    /// `[shared][gather]`: value of an arrival at the pixel, and path in bins to add.
    weight: Vec<f32>,
    offset: Vec<f32>,
    shells: Shells,
}

impl Sharing {
    /// One pass over a tile. `pixels` holds its pixels' slots row by row, as [`Film::pixel`] each, and is
    /// added to.
    pub fn pass(
        &mut self,
        (walk, film, effort): (&Walk, &Film, &Effort),
        tile: &Tile,
        scratch: &mut Scratch,
        pixels: &mut [f32],
    ) {
        let first = u64::from(tile.row) * u64::from(tile.width) + u64::from(tile.col);
        let mut rng = Rng::new(tile.seed, Stream::Paths, first, tile.pass);
        self.gathers.clear();
        self.shared.clear();
        let a = &mut self.arrivals;
        a.bins.clear();
        a.value.clear();
        a.spot.clear();
        a.bounces.clear();
        let size = film.pixel();
        for (k, pixel) in pixels.chunks_mut(size).enumerate() {
            let (row, col) = (
                tile.row + k as u32 / tile.cols,
                tile.col + k as u32 % tile.cols,
            );
            let mut sink = PixelSink {
                film,
                pixel,
                factor: 1.0,
            };
            let (x, y) = (col as f32 + rng.uniform(), row as f32 + rng.uniform());
            if let Some(v) = gather_point(walk, &mut rng, (x, y), scratch, &mut sink) {
                self.gathers.push((v, k));
            }
        }
        if self.gathers.is_empty() {
            return;
        }
        self.index();
        let count = (pixels.len() / size) as f32;
        if walk.lights {
            let few = effort.pool.min((count * 4.0) as u32);
            let Scratch { pool, stack, .. } = scratch;
            pool.fill(walk, few, &mut rng, stack);
        }
        self.beyond_mirrors((walk, film, effort), &mut rng, scratch, pixels);
        let camera = (count * effort.camera).round().max(1.0) as u32;
        let light = (count * effort.light).round().max(1.0) as u32;
        self.draw_from_camera((walk, film), camera, &mut rng, scratch, pixels);
        self.draw_from_spots(walk, light, &mut rng, scratch);
        if let Some(patches) = walk.patches {
            let count = (count * effort.shell).round().max(1.0) as u32;
            self.draw_in_shells((walk, patches), count, &mut rng);
        }
        self.light_up((walk, film, effort), light, &mut rng, scratch);
        self.connect((walk, film), camera, scratch);
        self.spread((walk, film), pixels);
    }

    /// Lays the gather points out in columns.
    fn index(&mut self) {
        self.columns.clear();
        self.glossy.clear();
        for (i, (v, _)) in self.gathers.iter().enumerate() {
            let diffuse = v.hit.surface.diffuse();
            if !diffuse {
                self.glossy.push(i);
            }
            self.columns
                .push(v.hit.p, v.hit.n, if diffuse { 1.0 } else { 0.0 });
        }
    }

    /// Draws light vertices beyond near-mirrors for this pass and connects the gather points to them.
    fn beyond_mirrors(
        &mut self,
        (walk, film, effort): (&Walk, &Film, &Effort),
        rng: &mut Rng,
        scratch: &mut Scratch,
        pixels: &mut [f32],
    ) {
        let Some(caustics) = walk.caustics else {
            return;
        };
        let size = film.pixel();
        let count = (effort.beyond * (pixels.len() / size) as f32).max(8.0) as u32;
        let Scratch {
            caustics: pool,
            stack,
            ..
        } = scratch;
        pool.fill_beyond((walk, caustics), count, rng, stack);
        for (v, k) in &self.gathers {
            let mut sink = PixelSink {
                film,
                pixel: &mut pixels[k * size..(k + 1) * size],
                factor: 1.0,
            };
            walk.light(rng, v, Lights::Beyond, BEYOND, scratch, &mut sink);
        }
    }

    /// Draws shared vertices by the scattering of gather points in turn. A vertex that cannot be shared is
    /// walked on for its own pixel.
    fn draw_from_camera(
        &mut self,
        (walk, film): (&Walk, &Film),
        count: u32,
        rng: &mut Rng,
        scratch: &mut Scratch,
        pixels: &mut [f32],
    ) {
        let size = film.pixel();
        let points = self.gathers.len();
        let turns = Turns::new(count, rng);
        for j in 0..count {
            let at = turns.choice(j, points);
            let (vertex, k) = self.gathers[at];
            if !walk.goes_on(&vertex) {
                continue;
            }
            let mut sink = PixelSink {
                film,
                pixel: &mut pixels[k * size..(k + 1) * size],
                factor: points as f32 / count as f32,
            };
            let aims = walk.aim(rng, &vertex, 1.0, scratch, &mut sink);
            walk.light(rng, &vertex, Lights::Glossy, GLOSSY, scratch, &mut sink);
            let h = &vertex.hit;
            let Some(drawn) = turns.direction(j, &h.surface, h.n, vertex.wo, rng) else {
                continue;
            };
            let Some((step, mut next)) = walk.follow(&vertex, drawn, aims, &mut scratch.stack)
            else {
                continue;
            };
            walk.choose_lobe(rng, &mut next.hit);
            if next.hit.surface.strength == 0.0 {
                continue;
            }
            if next.hit.surface.diffuse() {
                self.shared.push(Shared {
                    hit: next.hit,
                    light: 0.0,
                    first: 0,
                    end: 0,
                });
            } else {
                walk.connect(rng, &next, Some(&step), ALL, scratch, &mut sink);
                walk.run(rng, next, scratch, &mut sink);
            }
        }
    }

    /// Draws shared vertices by the scattering of the spots in turn.
    fn draw_from_spots(&mut self, walk: &Walk, count: u32, rng: &mut Rng, scratch: &mut Scratch) {
        let spots = &walk.emitters.list;
        let turns = Turns::new(count, rng);
        for j in 0..count {
            let e = &spots[turns.choice(j, spots.len())];
            let Some((w, weight, _)) = turns.direction(j, &e.surface, e.n, e.back, rng) else {
                continue;
            };
            let hit = walk
                .world
                .closest(&mut scratch.stack, lift(e.p, e.n), w)
                .filter(|_| weight > 0.0);
            let Some(mut hit) = hit else { continue };
            walk.choose_lobe(rng, &mut hit);
            if hit.surface.strength > 0.0 && hit.surface.diffuse() {
                self.shared.push(Shared {
                    hit,
                    light: 0.0,
                    first: 0,
                    end: 0,
                });
            }
        }
    }

    /// Draws shared vertices in the shells of a narrow gate.
    fn draw_in_shells(&mut self, (walk, patches): (&Walk, &Patches), count: u32, rng: &mut Rng) {
        let place = (walk.world, patches);
        self.shells
            .lay((walk.world, patches, walk.gate), &self.gathers, count);
        let start = f64::from(rng.uniform());
        for j in 0..count {
            let at = (f64::from(j) + start) / f64::from(count);
            let Some(mut hit) = self.shells.draw(place, at, rng) else {
                continue;
            };
            walk.choose_lobe(rng, &mut hit);
            if hit.surface.diffuse() {
                self.shared.push(Shared {
                    hit,
                    light: 0.0,
                    first: 0,
                    end: 0,
                });
            }
        }
    }

    /// Finds what arrives at every shared vertex: from all spots directly, from beyond by walks.
    fn light_up(
        &mut self,
        (walk, film, effort): (&Walk, &Film, &Effort),
        drawn: u32,
        rng: &mut Rng,
        scratch: &mut Scratch,
    ) {
        let emitters = walk.emitters;
        let per_metre = 1.0 / film.gate.bin_width_m;
        let nearest = self
            .gathers
            .iter()
            .fold(f64::INFINITY, |a, (v, _)| a.min(v.length_m));
        let lowest = self.gathers.iter().map(|(v, _)| v.bounce).min();
        let bounce = lowest.unwrap_or(1) + 1;
        let share = drawn as f32 / emitters.list.len() as f32;
        for y in &mut self.shared {
            y.first = self.arrivals.bins.len();
            y.end = y.first;
            let h = &y.hit;
            let window = walk
                .window
                .map(|w| self.shells.window(walk.world, &w, h.p, nearest));
            let walk = &Walk { window, ..*walk };
            if !walk.in_time(h.p, nearest) {
                continue;
            }
            let mut sink = ArrivalSink {
                list: &mut self.arrivals,
                base_m: nearest,
                per_metre,
                factor: 1.0,
            };
            let mut density = 0.0;
            let vertex = Vertex {
                hit: *h,
                wo: h.n,
                beta: 1.0,
                length_m: nearest,
                bounce,
                after_mirror: false,
                open_before: false,
            };
            let mut walk_on = |sink: &mut ArrivalSink, scratch: &mut Scratch| {
                sink.factor = 1.0 / effort.walks.max(1) as f32;
                for _ in 0..effort.walks {
                    walk.run(rng, vertex, scratch, sink);
                }
                sink.factor = 1.0;
            };
            if walk.window.is_some() {
                walk_on(&mut sink, scratch);
            }
            emitters.weights(h.p, h.n, h.n, &h.surface, &mut scratch.weights);
            if sink.list.bins.len() == y.first
                && !walk.any_in_window(h.p, nearest, &scratch.weights)
            {
                continue;
            }
            self.ends.clear();
            self.ends_of.clear();
            for (spot, &w) in scratch.weights.iter().enumerate() {
                if w > 0.0 {
                    self.ends.push(emitters.lifted[spot]);
                    self.ends_of.push(spot);
                }
            }
            self.blocked.resize(self.ends.len(), false);
            walk.world.bvh.occluded_bundle(
                &mut scratch.stack,
                lift(h.p, h.n),
                &self.ends,
                &mut self.blocked,
            );
            for (&spot, &blocked) in self.ends_of.iter().zip(&self.blocked) {
                let (e, w) = (&emitters.list[spot], scratch.weights[spot]);
                if !blocked {
                    let to = h.p - e.p;
                    let d2 = to.dot(to);
                    let d = d2.sqrt();
                    let strength = emitters.columns.strength[spot];
                    density += if strength > 0.0 {
                        w / (strength * h.surface.strength * PI)
                    } else {
                        let out = to / d;
                        e.surface.pdf(e.n, e.back, out) * h.n.dot(out).abs() / d2
                    };
                    let path = nearest + walk.world.metres(d) + e.path_m;
                    if walk.window.is_none_or(|w| w.holds(path)) {
                        sink.add(path, w, spot, bounce + 1);
                    }
                }
            }
            y.light = density * share;
            if let Some(patches) = walk.patches {
                y.light += self.shells.density((walk.world, patches), h);
            }
            if walk.window.is_none() {
                walk_on(&mut sink, scratch);
            }
            y.end = sink.list.bins.len();
        }
    }

    /// Weighs every pair of shared vertex and gather point.
    fn connect(&mut self, (walk, film): (&Walk, &Film), drawn: u32, scratch: &mut Scratch) {
        let count = self.gathers.len();
        self.weight.clear();
        self.offset.clear();
        self.weight.resize(count * self.shared.len(), 0.0);
        self.offset.resize(count * self.shared.len(), 0.0);
        let per_metre = 1.0 / film.gate.bin_width_m;
        let nearest = self
            .gathers
            .iter()
            .fold(f64::INFINITY, |a, (v, _)| a.min(v.length_m));
        let share = drawn as f32 / count as f32;
        let rows = self
            .weight
            .chunks_mut(count)
            .zip(self.offset.chunks_mut(count));
        for (y, (weight, offset)) in self.shared.iter().zip(rows) {
            if walk.window.is_some() && y.first == y.end {
                continue;
            }
            let h = &y.hit;
            self.columns.irradiance(h.p, h.n, weight);
            for &i in &self.glossy {
                let x = &self.gathers[i].0.hit;
                let to = x.p - h.p;
                let seen = h.n.dot(to) > 0.0 && x.n.dot(to) < 0.0;
                weight[i] = if seen { 1.0 } else { 0.0 };
            }
            self.ends.clear();
            self.ends_of.clear();
            for (i, (w, (v, _))) in weight.iter().zip(&self.gathers).enumerate() {
                if *w > 0.0 {
                    self.ends.push(lift(v.hit.p, v.hit.n));
                    self.ends_of.push(i);
                }
            }
            self.blocked.resize(self.ends.len(), false);
            walk.world.bvh.occluded_bundle(
                &mut scratch.stack,
                lift(h.p, h.n),
                &self.ends,
                &mut self.blocked,
            );
            for (&i, &blocked) in self.ends_of.iter().zip(&self.blocked) {
                if blocked {
                    weight[i] = 0.0;
                }
            }
            let mut density = 0.0;
            for ((w, o), (v, _)) in weight.iter_mut().zip(offset).zip(&self.gathers) {
                if *w == 0.0 {
                    continue;
                }
                let x = &v.hit;
                let to = h.p - x.p;
                let d2 = to.dot(to);
                let d = d2.sqrt();
                if x.surface.diffuse() {
                    density += *w / PI;
                    *w *= v.beta * x.surface.strength;
                } else {
                    let w_in = to / d;
                    let cos = h.n.dot(w_in).abs() / d2;
                    density += x.surface.pdf(x.n, v.wo, w_in) * cos;
                    *w = v.beta * x.surface.scatter(x.n, v.wo, w_in) * cos;
                }
                *o = ((v.length_m - nearest + walk.world.metres(d) - film.gate.start_m + nearest)
                    * per_metre) as f32;
            }
            let density = density * share + y.light;
            let inverse = if density > 0.0 { 1.0 / density } else { 0.0 };
            for w in weight.iter_mut() {
                *w *= inverse;
            }
        }
    }

    /// Carries the arrivals to the pixels.
    fn spread(&self, (walk, film): (&Walk, &Film), pixels: &mut [f32]) {
        let count = self.gathers.len();
        let size = film.pixel();
        let last = film.slots as f32 - 1.0;
        let lowest = self.gathers.iter().map(|(v, _)| v.bounce).min();
        let lowest = lowest.unwrap_or(1);
        let bounded = walk.max_bounces < u32::MAX;
        for (i, (v, k)) in self.gathers.iter().enumerate() {
            let pixel = &mut pixels[k * size..(k + 1) * size];
            let deeper = v.bounce - lowest;
            for (y, row) in self
                .shared
                .iter()
                .zip(self.weight.chunks(count).zip(self.offset.chunks(count)))
            {
                let (weight, offset) = (row.0[i], row.1[i] + 1.0);
                if weight == 0.0 {
                    continue;
                }
                let range = y.first..y.end;
                let a = &self.arrivals;
                let (bins, values) = (&a.bins[range.clone()], &a.value[range.clone()]);
                if film.channels == 1 && !bounded {
                    let pixel = &mut pixel[..film.slots];
                    // Slots eight at a time: that part the compiler can do side by side.
                    for (bins, values) in bins.chunks(8).zip(values.chunks(8)) {
                        let mut slots = [0u32; 8];
                        for (slot, &b) in slots.iter_mut().zip(bins) {
                            *slot = floor(b + offset, last);
                        }
                        for (&slot, &value) in slots.iter().zip(values) {
                            pixel[slot as usize] += weight * value;
                        }
                    }
                    continue;
                }
                let rest = a.spot[range.clone()].iter().zip(&a.bounces[range]);
                for ((&b, &value), (&spot, &bounces)) in bins.iter().zip(values).zip(rest) {
                    if u32::from(bounces) + deeper > walk.max_bounces {
                        continue;
                    }
                    let slot = floor(b + offset, last) as usize;
                    film.add(pixel, slot, weight * value, usize::from(spot));
                }
            }
        }
    }
}

/// ⌊x⌋ within 0..=last, for last < 2²². Half an ulp of 2²³ is ½: adding it leaves the integer in the low
/// bits, without the checks of a cast. (An x within rounding of an integer may fall to either side.)
#[inline(always)]
fn floor(x: f32, last: f32) -> u32 {
    let half = x.max(0.5).min(last + 0.5) - 0.5;
    (half + 8_388_608.0).to_bits() & 0x007f_ffff
}

/// Evenly spread draws: choices in strict turn, directions by the R₂ sequence (Roberts 2018), both from
/// a random start. What neighbours have in common then varies less from pass to pass.
struct Turns {
    count: f32,
    start: f32,
    u: f32,
    v: f32,
}

impl Turns {
    fn new(count: u32, rng: &mut Rng) -> Self {
        Self {
            count: count as f32,
            start: rng.uniform(),
            u: rng.uniform(),
            v: rng.uniform(),
        }
    }

    /// Which of `among` draw `j` is for.
    fn choice(&self, j: u32, among: usize) -> usize {
        let at = j as f32 / self.count + self.start;
        (((at - at.floor()) * among as f32) as usize).min(among - 1)
    }

    /// The direction of draw `j`, as [`Surface::sample`] gives it.
    fn direction(
        &self,
        j: u32,
        surface: &Surface,
        n: Vec3,
        wo: Vec3,
        rng: &mut Rng,
    ) -> Option<(Vec3, f32, f32)> {
        if !surface.diffuse() {
            return surface.sample(n, wo, rng);
        }
        let turn = |start: f32, step: f64| {
            let at = f64::from(start) + f64::from(j) * step;
            (at - at.floor()) as f32
        };
        let (u, v) = (
            turn(self.u, 0.754_877_666_246_69),
            turn(self.v, 0.569_840_290_998_05),
        );
        // Cosine-distributed: uniform on the disc beneath (Malley's method).
        let angle = std::f32::consts::TAU * v;
        let (r, z) = (u.sqrt(), (1.0 - u).max(0.0).sqrt());
        let (t, b) = frame(n);
        let w = t * (r * libm::cosf(angle)) + b * (r * libm::sinf(angle)) + n * z;
        let w = w.normalized();
        let c = n.dot(w);
        (c > 0.0).then_some((w, surface.strength * PI, c / PI))
    }
}

/// Follows a camera ray through near-mirrors to the first other surface. What the spots send to vertices
/// past the first goes to `sink`.
fn gather_point(
    walk: &Walk,
    rng: &mut Rng,
    (x, y): (f32, f32),
    scratch: &mut Scratch,
    sink: &mut PixelSink,
) -> Option<Vertex> {
    let world = walk.world;
    let hit = world.closest(&mut scratch.stack, Vec3::ZERO, world.camera.ray(x, y))?;
    let range = hit.p.length();
    let mut vertex = Vertex {
        hit,
        wo: -hit.p / range,
        beta: 1.0,
        length_m: world.metres(range),
        bounce: 1,
        after_mirror: false,
        open_before: false,
    };
    loop {
        walk.choose_lobe(rng, &mut vertex.hit);
        if vertex.bounce > 1 {
            walk.connect(rng, &vertex, None, ALL, scratch, sink);
        }
        if !walk.goes_on(&vertex) {
            return None;
        }
        if !vertex.hit.surface.specular {
            return Some(vertex);
        }
        let roulette = vertex.bounce > 1;
        (_, vertex) = walk.step(rng, &vertex, 0.0, roulette, &mut scratch.stack)?;
    }
}

#[cfg(test)]
mod tests {
    use super::floor;

    #[test]
    fn slots_are_whole_parts_within_their_range() {
        for k in 0..4000u32 {
            for part in [0.01, 0.3, 0.5, 0.7, 0.99] {
                assert_eq!(floor(k as f32 + part, 638.0), k.min(638));
            }
        }
        assert_eq!(floor(-7.5, 638.0), 0);
        assert_eq!(floor(f32::INFINITY, 638.0), 638);
        assert_eq!(floor(1_048_577.5, 1_048_577.0), 1_048_577);
    }
}
