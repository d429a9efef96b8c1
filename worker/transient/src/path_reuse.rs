//! Path reuse: three bounces and more for a tile of neighbouring pixels at once.
//!
//! Every pixel of a tile has one *gather point*: the first surface point along a camera path that
//! is not a near-mirror. *Shared vertices* are drawn from the scattering of the gather points and
//! of the spots, and every gather point is connected to every shared vertex (Bekaert, Sbert and
//! Halton, EGWR 2002; vertices from the light side as in Segovia et al., EGSR 2006). They are
//! chosen among several times as many candidates, by the direct light that each is likely to bring.
//! A shared vertex sends out its direct light from all spots, computed exactly, and the light that
//! random walks bring. It starts more walks if the gather points receive more of its light. One
//! shadow ray carries a whole list of arrivals to a pixel. All techniques that draw a shared vertex
//! are combined by the balance heuristic with visibility in the densities, so both 1/d²
//! singularities, at the gather point and at the spot, stay bounded.
//!
//! Light that only one pixel can see, namely via a near-mirror or a glossy surface, is walked for
//! that pixel alone.

mod arrivals;
mod candidates;
mod draw;
mod effort;
mod gloss;
mod spread;
mod weigh;

use self::{
    candidates::Candidates,
    draw::{Share, gather_point, only_mirrors},
    gloss::Gloss,
    weigh::Lengths,
};

pub(crate) use self::effort::{Effort, NARROW_TILE, WIDE_TILE};

use std::f32::consts::PI;

use picofarm_scene::Vec3;

use crate::{
    bsdf::Surface,
    ellipsoid::Shells,
    emitter::Columns,
    film::Film,
    lanes::SIDE,
    lobes::{Lobes, Seen},
    reflectors::Aiming,
    rng::{Rng, Stream},
    segments::Segments,
    sink::{PixelSink, Place, Sink, Way},
    turns::place,
    vertex::Vertex,
    walk::{Scratch, Walk},
    world::Hit,
};

/// Camera paths per pass through near-mirrors alone, for pixels that see one. Few of them hit a
/// narrow lobe that a spot lights, and with a single path per pass that light was a rare event of
/// many times the image's error.
const MIRROR_PATHS: u32 = 16;
/// The maximum number of light vertices beyond near-mirrors that a gather point is connected to.
const BEYOND: u32 = 2;
/// Like `BEYOND`, for a near-mirror that the camera sees. One in `SHOWING` of a pixel's camera
/// paths is connected.
const SHOWN: u32 = 2;
const SHOWING: u32 = 4;
/// Light paths per pass in all zones near spots, and the minimum and maximum in one zone.
const ALL_ZONES: u32 = 64;
const ZONE_PATHS: (u32, u32) = (4, 16);
/// The maximum number of light vertices in zones that a near-mirror is connected to.
const BESIDE: u32 = 2;
/// The maximum number of light vertices on unshared conductors that a gather point is connected to.
const GLOSSY: u32 = 2;
/// The maximum number of spots for which the light at a rough vertex is carried to the pixels. They
/// are drawn by contribution.
const ROUGH_SPOTS: usize = 32;

/// A vertex that all gather points of a tile share.
#[derive(Debug, Clone, Copy)]
struct Shared {
    hit: Hit,
    /// The number of candidates that it represents.
    counts: f32,
    /// The expected number of such candidates per area, from the spots' side and in a narrow gate's
    /// shells.
    light: f32,
    /// The range of its arrivals.
    first: usize,
    end: usize,
    /// The scattering of a surface other than Lambertian. Its arrivals are those of a white
    /// Lambertian surface at the same place.
    rough: Option<Surface>,
}

/// Guides the drawing of light at a rough vertex: by its scattering towards one of the gather
/// points, at least half of it as a Lambertian surface scatters, so that no direction is rare. The
/// contributions are carried as for a white Lambertian surface.
#[derive(Debug, Clone, Copy)]
struct Guide {
    surface: Surface,
    n: Vec3,
    /// Unit direction to the gather point.
    to: Vec3,
}

impl Guide {
    /// Returns the ratio of a white Lambertian surface's light to the guide's, from direction `w`.
    #[inline]
    fn share(&self, w: Vec3) -> f32 {
        let guided = self.surface.scatter(self.n, self.to, w);
        if guided > 0.0 {
            self.n.dot(w) / (PI * guided)
        } else {
            0.0
        }
    }
}

impl Shared {
    /// Returns a shared vertex, or `None` if the hit cannot be shared.
    fn new(mut hit: Hit) -> Option<Self> {
        if !hit.surface.is_shared() || hit.surface.is_black() {
            return None;
        }
        let rough = (!hit.surface.diffuse()).then_some(hit.surface);
        if rough.is_some() {
            hit.surface = hit.surface.white();
        }
        Some(Self {
            hit,
            counts: 1.0,
            light: 0.0,
            first: 0,
            end: 0,
            rough,
        })
    }
}

/// The light that arrives at shared vertices and is scattered on, per unit solid angle, to every
/// side.
///
/// The arrivals of a vertex begin at a group of [`SIDE`], and its last group is padded with zeros.
#[derive(Debug, Default)]
struct Arrivals {
    /// Optical path length from the laser, in bins.
    bins: Vec<f32>,
    value: Vec<f32>,
    spot: Vec<u16>,
    /// Bounces of the whole path if the gather point is the first.
    bounces: Vec<u8>,
    /// Unit direction of arrival at a rough vertex; unspecified at other vertices.
    from: Vec<Vec3>,
}

impl Arrivals {
    fn clear(&mut self) {
        self.bins.clear();
        self.value.clear();
        self.spot.clear();
        self.bounces.clear();
        self.from.clear();
    }

    /// Pads the last group and returns the number of arrivals.
    fn fill_up(&mut self) -> usize {
        let whole = self.bins.len().next_multiple_of(SIDE);
        self.bins.resize(whole, 0.0);
        self.value.resize(whole, 0.0);
        self.spot.resize(whole, 0);
        self.bounces.resize(whole, 0);
        self.from.resize(whole, Vec3::ZERO);
        whole
    }
}

/// Adds arrivals, with path lengths relative to `base_m`.
struct ArrivalSink<'a> {
    list: &'a mut Arrivals,
    base_m: f64,
    per_metre: f64,
    factor: f32,
    film: &'a Film,
    place: Place,
    /// The guide by which it was drawn at a rough vertex.
    guide: Option<Guide>,
    /// The factor from the value as drawn to the value for the vertex.
    share: f32,
    from: Vec3,
    /// True if `from` is the direction of a walk's first step and no longer changes.
    left: bool,
}

impl Sink for ArrivalSink<'_> {
    #[inline]
    fn add(&mut self, path_m: f64, value: f32, spot: usize, bounces: u32, way: Way) {
        let spot = self.film.tag(spot, self.place, way);
        let list = &mut *self.list;
        list.bins
            .push(((path_m - self.base_m) * self.per_metre) as f32);
        list.value.push(self.factor * self.share * value);
        list.spot.push(spot as u16);
        list.bounces.push(bounces.min(255) as u8);
        list.from.push(self.from);
    }

    #[inline]
    fn toward(&mut self, w: Vec3) {
        if !self.left {
            self.from = w;
            self.share = self.guide.as_ref().map_or(1.0, |g| g.share(w));
        }
    }

    #[inline]
    fn leave(&mut self, w: Vec3) {
        self.toward(w);
        self.left = true;
    }

    #[inline]
    fn at(&mut self, place: Place) {
        self.place = place;
    }
}

/// The position of a pass: the tile's first pixel and its columns, the image's width, and the pass
/// number.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Tile<'a> {
    pub row: u32,
    pub col: u32,
    pub cols: u32,
    pub width: u32,
    pub seed: u64,
    pub pass: u64,
    /// Pixels that may see a near-mirror, row-major, of the whole image. They are chosen without
    /// any sample.
    pub mirrors: &'a [bool],
}

/// Buffers of one thread's passes.
#[derive(Debug, Default)]
pub(crate) struct Sharing {
    gathers: Vec<(Vertex, usize)>,
    columns: Columns,
    /// Optical path length to the nearest gather point, metres. Arrivals' lengths are relative to
    /// it.
    nearest_m: f64,
    /// The fewest bounces up to a gather point.
    lowest: u32,
    /// Indices of gather points that are not Lambertian.
    glossy: Vec<usize>,
    shared: Vec<Shared>,
    candidates: Candidates,
    aiming: Aiming,
    arrivals: Arrivals,
    gloss: Gloss,
    /// Segments of one shared vertex.
    segments: Segments,
    lengths: Lengths,
    /// How the gather points of `glossy` scatter to the camera, and how much they scatter from one
    /// shared vertex.
    lobes: Lobes,
    scattered: Vec<f32>,
    drawn: Vec<f32>,
    /// Gather points that are not Lambertian, and their values.
    apart: Vec<(usize, f32)>,
    /// `[shared][gather]`: value of an arrival at the pixel, and path in bins to add.
    weight: Vec<f32>,
    offset: Vec<f32>,
    shells: Shells,
}

impl Sharing {
    /// Makes one pass over a tile. `pixels` contains the slots of its pixels row by row, each as
    /// [`Film::pixel`], and the pass adds to them.
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
        self.arrivals.clear();
        let size = film.pixel();
        let count = effort.beyond * (pixels.len() / size) as f32;
        Self::draw_lights(walk, count.max(8.0) as u32, &mut rng, scratch);
        for (k, pixel) in pixels.chunks_mut(size).enumerate() {
            let (row, col) = (
                tile.row + k as u32 / tile.cols,
                tile.col + k as u32 % tile.cols,
            );
            let mut sink = PixelSink {
                film,
                pixel,
                factor: 1.0,
                place: Place::Mirror,
            };
            let index = u64::from(row) * u64::from(tile.width) + u64::from(col);
            let paths = match tile.mirrors[index as usize] {
                true => MIRROR_PATHS,
                false => 1,
            };
            let begin = |j: u32| {
                // Each pass samples every part of the pixel, and its first path samples a different
                // part in each pass.
                let (j, paths) = (u64::from(j), u64::from(paths));
                let path = tile.pass * paths + (j + tile.pass) % paths;
                let place = place(tile.seed, Stream::Place, index, path);
                walk.world.camera_ray((row, col), place)
            };
            let share = |j: u32| Share {
                spots: 1.0 / paths as f32,
                beyond: match j % SHOWING {
                    0 => 1.0 / paths.div_ceil(SHOWING) as f32,
                    _ => 0.0,
                },
            };
            for j in 1..paths {
                only_mirrors(walk, &mut rng, begin(j), share(j), scratch, &mut sink);
            }
            if let Some(v) = gather_point(walk, &mut rng, begin(0), share(0), scratch, &mut sink) {
                self.gathers.push((v, k));
            }
        }
        if self.gathers.is_empty() {
            return;
        }
        self.index();
        let count = (pixels.len() / size) as f32;
        if walk.lights {
            let few = effort.light_vertices.min((count * 4.0) as u32);
            let Scratch {
                vertices, stack, ..
            } = scratch;
            let of = (walk.world, walk.emitters, walk.contacts);
            vertices.fill(of, few, &mut rng, stack);
        }
        self.connect_lights((walk, film), &mut rng, scratch, pixels);
        let times = effort.candidates;
        let drawn = |share: f32| (count * share).round().max(1.0) as u32;
        let (camera, light) = (drawn(effort.camera), drawn(effort.light));
        let extra = camera * effort.extra;
        let (camera, light) = (camera * times, light * times);
        let alone = camera / times + extra;
        let aims = self.aim((walk, effort), alone, count);
        let on = (walk, film, effort);
        self.draw_from_camera(on, (camera, times, extra), &mut rng, scratch, pixels);
        self.draw_from_mirrors(on, (aims, alone), &mut rng, scratch, pixels);
        self.draw_from_spots(walk, light, &mut rng, scratch);
        if let Some(patches) = walk.patches {
            self.draw_in_shells((walk, patches), drawn(effort.shell), &mut rng);
        }
        if times > 1 {
            let kept = (camera + light) / times;
            self.choose(walk, (kept, (camera, light)), &mut rng, scratch);
        }
        self.connect((walk, film, effort), (camera, light), &mut rng, scratch);
        self.gloss.lay(&self.shared, &self.arrivals);
        self.spread((walk, film), pixels);
    }

    /// Weighs the near-mirrors that this tile's `pixels` gather points aim at. Returns the number
    /// of aims, in addition to `alone` directions drawn by scattering.
    fn aim(&mut self, (walk, effort): (&Walk, &Effort), alone: u32, pixels: f32) -> u32 {
        self.aiming.clear();
        let Some(all) = walk.reflectors else { return 0 };
        let aims = (effort.aims * pixels).ceil();
        let points = self.gathers.iter().map(|(v, _)| (v.hit.p, v.hit.n));
        match self.aiming.weigh(all, aims / alone as f32, points) {
            true => aims as u32,
            false => 0,
        }
    }

    /// Arranges the gather points in columns.
    fn index(&mut self) {
        self.columns.clear();
        self.glossy.clear();
        self.lobes.clear();
        self.nearest_m = f64::INFINITY;
        self.lowest = u32::MAX;
        for (i, (v, _)) in self.gathers.iter().enumerate() {
            self.nearest_m = self.nearest_m.min(v.length_m);
            self.lowest = self.lowest.min(v.bounce);
            let diffuse = v.hit.surface.diffuse();
            if !diffuse {
                self.glossy.push(i);
                let place = Seen::of(&v.hit, v.wo);
                self.lobes.push(&place, &v.hit.surface);
            }
            self.columns
                .push(v.hit.p, v.hit.n, if diffuse { 1.0 } else { 0.0 });
        }
    }
}
