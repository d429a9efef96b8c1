//! Sources of light that is drawn into the image outside the tiles. Light paths cross tiles, so they
//! are an estimate separate from the tiles', with as many passes as the image.

use rayon::prelude::*;

use crate::{
    film::{splat::Splat, technique::Technique},
    light::{
        caustics::Caustics,
        contacts::{Contacts, End},
        light_vertices::LightVertex,
        splat::splat,
    },
    numeric::{
        low_discrepancy::place,
        rng::{Rng, Stream},
    },
    paths::glass::{buffers::Buffers, photons::Photons, technique::ByGlass},
    render::{frame::Frame, thin::Thin, watch::Watch},
    scene::{bvh::tree::Stack, stratified::Turns},
};

/// Light paths via near-mirrors, per pass and pixel.
const PATHS: f64 = 4.0;

/// Light paths via glass, per pass and pixel, and the number of them that the camera paths of a
/// stream are connected to.
const GLASS_PATHS: f64 = 1.0;
const LAID: u32 = 128;

/// Light paths per random stream.
const CHUNK: u32 = 1024;

/// Divisor of the pixels that gives the light paths of a pass in all zones, and the minimum and
/// maximum in one zone.
const ZONE_SHARE: u32 = 4;
const ZONE_PATHS: (u32, u32) = (256, 1024);

/// A pass: its number, its stop watch, and the fraction of it to make.
#[derive(Clone, Copy)]
struct At<'a> {
    pub pass: u32,
    pub watch: &'a Watch<'a>,
    pub thin: Thin<'a>,
}

/// The sources of light paths.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Sources<'a> {
    caustics: Option<&'a Caustics>,
    contacts: Option<&'a Contacts>,
    glass: Option<&'a ByGlass>,
}

impl<'a> Sources<'a> {
    /// Returns the sources of a scene, or `None` if it needs none.
    pub fn of(frame: &Frame<'a>) -> Option<Self> {
        let (caustics, contacts) = (frame.walk.caustics, frame.walk.contacts);
        let glass = frame.glass;
        let any = caustics.is_some() || contacts.is_some() || glass.is_some();
        any.then_some(Self {
            caustics,
            contacts,
            glass,
        })
    }

    /// Returns the contributions of a pass and the number of rays traced for it.
    pub fn pass(
        &self,
        frame: &Frame,
        (pass, watch): (u32, &Watch),
        thin: Thin,
    ) -> (Vec<Splat>, u64) {
        let (mut all, mut rays, at) = (vec![], 0, At { pass, watch, thin });
        if let Some(caustics) = self.caustics {
            rays += Self::by_mirrors((frame, caustics), at, &mut all);
        }
        if let Some(contacts) = self.contacts {
            rays += Self::in_zones((frame, contacts), at, &mut all);
        }
        if let Some(glass) = self.glass {
            let (photons, traced) = Self::paths_by_glass((frame, glass), at, &mut all);
            rays += traced + Self::look_by_glass((frame, glass, &photons), at, &mut all);
        }
        (all, rays)
    }

    /// Makes a pass of light paths via near-mirrors.
    fn by_mirrors((frame, caustics): (&Frame, &Caustics), at: At, all: &mut Vec<Splat>) -> u64 {
        let within = frame.walk.surroundings();
        let of = (within.world, frame.film);
        let pixels = f64::from(frame.width) * f64::from(frame.height);
        let count =
            (at.thin.share() * pixels * PATHS).clamp(f64::from(CHUNK), f64::from(1 << 22)) as u32;
        let chunk = |stack: &mut Stack, chunk: u32, ends: &mut Vec<Splat>| {
            let pass = u64::from(at.pass);
            let mut rng = Rng::new(frame.seed, Stream::Caustic, u64::from(chunk), pass);
            let mut seen = vec![];
            for l in chunk * CHUNK..count.min((chunk + 1) * CHUNK) {
                caustics.trace(&within, (l, count), &mut rng, stack, |z| seen.push(z));
                let found = seen.drain(..);
                ends.extend(found.flat_map(|z| splat(of, (&z, Technique::Mirrors), stack)));
            }
        };
        side_by_side(frame, count.div_ceil(CHUNK), at.watch, all, chunk)
    }

    /// Makes a pass of light paths in the zones of spots close to other surfaces.
    fn in_zones((frame, contacts): (&Frame, &Contacts), at: At, all: &mut Vec<Splat>) -> u64 {
        let within = frame.walk.surroundings();
        let of = (within.world, frame.film);
        let (least, most) = ZONE_PATHS;
        let share = frame.width * frame.height / ZONE_SHARE / contacts.count();
        let count = (share.clamp(least, most) / at.thin.of).max(1);
        let zone = |stack: &mut Stack, zone: u32, ends: &mut Vec<Splat>| {
            let pass = u64::from(at.pass);
            let mut rng = Rng::new(frame.seed, Stream::Contact, u64::from(zone), pass);
            let turns = Turns::new(count, &mut rng);
            let mut seen = vec![];
            for l in 0..count {
                let at = (zone as usize, l, &turns);
                contacts.trace(&within, at, &mut rng, stack, |end, z| {
                    if end == End::Beyond || contacts.draws(&z) {
                        seen.push(z);
                    }
                });
                let found = seen.drain(..);
                ends.extend(found.flat_map(|z| splat(of, (&z, Technique::Zone), stack)));
            }
        };
        side_by_side(frame, contacts.count(), at.watch, all, zone)
    }

    /// Makes a pass of light paths via glass. Returns the photons that they leave and the number of
    /// rays traced.
    fn paths_by_glass(
        (frame, glass): (&Frame, &ByGlass),
        at: At,
        all: &mut Vec<Splat>,
    ) -> (Photons, u64) {
        let walk = &frame.walk;
        let of = (walk.world, frame.film);
        let pixels = f64::from(frame.width) * f64::from(frame.height);
        let count = (at.thin.share() * pixels * GLASS_PATHS)
            .clamp(f64::from(CHUNK), f64::from(1 << 22)) as u32;
        let chunk = |buffers: &mut Buffers, chunk: u32, (ends, photons): &mut Ends| {
            let pass = u64::from(at.pass);
            let mut rng = Rng::new(frame.seed, Stream::Glass, u64::from(chunk), pass);
            let mut seen = vec![];
            for l in chunk * CHUNK..count.min((chunk + 1) * CHUNK) {
                let each = |z, turned| seen.push((z, turned));
                glass.trace(walk, (l, count), &mut rng, buffers, each);
                for (z, turned) in seen.drain(..) {
                    ends.extend(splat(of, (&z, Technique::Glass), buffers.stack()));
                    photons.extend(turned.then_some(z));
                }
            }
        };
        let (mut photons, mut rays) = (vec![], 0);
        let chunks = with_buffers(frame, count.div_ceil(CHUNK), at.watch, chunk);
        for ((ends, of_chunk), traced) in chunks {
            all.extend(ends);
            photons.extend(of_chunk);
            rays += traced;
        }
        (Photons::new(walk.world, walk.emitters, photons), rays)
    }

    /// Makes a pass of camera paths via glass.
    fn look_by_glass(
        (frame, glass, photons): (&Frame, &ByGlass, &Photons),
        at: At,
        all: &mut Vec<Splat>,
    ) -> u64 {
        let (walk, width) = (&frame.walk, frame.width);
        all.extend_from_slice(glass.seen());
        let pixels = width * frame.height;
        let chunk = |buffers: &mut Buffers, chunk: u32, found: &mut Vec<Splat>| {
            let pass = u64::from(at.pass);
            let mut rng = Rng::new(frame.seed, Stream::ByGlass, u64::from(chunk), pass);
            let own = chunk * CHUNK..pixels.min((chunk + 1) * CHUNK);
            let mut own = own.filter(|p| at.thin.holds((p / width, p % width)));
            let Some(first) = own.next() else { return };
            glass.lay(walk, LAID, &mut rng, buffers);
            for pixel in std::iter::once(first).chain(own) {
                let place = place(frame.seed, Stream::GlassPlace, u64::from(pixel), pass);
                let ray = walk.world.camera_ray((pixel / width, pixel % width), place);
                let within = (walk, frame.film, photons);
                glass.look(within, (pixel, ray), &mut rng, buffers, found);
            }
        };
        joined(
            with_buffers(frame, pixels.div_ceil(CHUNK), at.watch, chunk),
            all,
        )
    }
}

/// Runs `count` pieces of a pass on all threads and joins the results in order. Returns the number
/// of rays traced.
fn side_by_side(
    frame: &Frame,
    count: u32,
    watch: &Watch,
    all: &mut Vec<Splat>,
    piece: impl Fn(&mut Stack, u32, &mut Vec<Splat>) + Sync,
) -> u64 {
    let stack = || frame.walk.world.bvh.stack();
    let piece = |stack: &mut Stack, k, splats: &mut Vec<Splat>| {
        let before = stack.rays;
        piece(stack, k, splats);
        stack.rays - before
    };
    joined(pieces(count, watch, stack, piece), all)
}

/// Runs `count` pieces of a pass via glass. Returns the results in order, each with the number of
/// rays traced.
fn with_buffers<T: Default + Send>(
    frame: &Frame,
    count: u32,
    watch: &Watch,
    piece: impl Fn(&mut Buffers, u32, &mut T) + Sync,
) -> Vec<(T, u64)> {
    let piece = |buffers: &mut Buffers, k, found: &mut T| {
        let before = buffers.stack().rays;
        piece(buffers, k, found);
        buffers.stack().rays - before
    };
    pieces(count, watch, || Buffers::new(&frame.walk), piece)
}

/// Runs `count` pieces of a pass on all threads. Returns the results in order, each with the number
/// of rays traced.
fn pieces<B, T: Default + Send>(
    count: u32,
    watch: &Watch,
    buffers: impl Fn() -> B + Sync + Send,
    piece: impl Fn(&mut B, u32, &mut T) -> u64 + Sync,
) -> Vec<(T, u64)> {
    let each = (0..count).into_par_iter();
    each.map_init(buffers, |buffers, k| {
        let mut found = T::default();
        let rays = match watch.go_on() {
            true => piece(buffers, k, &mut found),
            false => 0,
        };
        (found, rays)
    })
    .collect()
}

/// The contributions of light paths to the image, and the photons that the paths leave.
type Ends = (Vec<Splat>, Vec<LightVertex>);

/// Joins the results and returns the number of rays traced.
fn joined(found: Vec<(Vec<Splat>, u64)>, all: &mut Vec<Splat>) -> u64 {
    let rays = found.iter().map(|f| f.1).sum();
    all.extend(found.into_iter().flat_map(|f| f.0));
    rays
}
