//! The method from end to end: depth, shadows, and depth again without the spots that are in
//! shadow.

use picofarm_scene::Vec3;
use picofarm_settings::Gate;

use crate::{
    Capture, DemultiplexError, Ground, Place, Settings, Shading,
    evidence::Evidence,
    fill::fill,
    geometry::{Rays, Source, normals, places},
    learned::{Scene, forests},
    light::Light,
    matching,
    mirrors::Mirrors,
    planes::{Judge, Slants},
    pulse::Pulse,
    scale::{self, Scaled},
    shadows::shadows,
    sweep::{Known, Volume, quiet, sweep},
    unmix::Unmix,
};

/// Half width of the neighbourhood that a normal follows from, steps ([`Rays::step`]).
pub const NEAR: usize = 2;
/// Share of depth beyond which a neighbour is another surface.
pub const LEAP: f32 = 0.04;

/// The same around spots, at least.
const SPOT: usize = 3;
/// Share of a spot's range within which a visible point belongs to the spot's surface.
const FLAT: f32 = 0.004;

/// What one flash holds. Images are row-major `[row][column]`; those over spots are
/// `[spot][row][column]`.
#[derive(Debug, Clone, PartialEq)]
pub struct Demultiplexed {
    /// Places of the spots, world axes; `None` where a beam has no return. Such a spot lights
    /// nothing.
    pub places: Vec<Option<Place>>,
    /// z-depth, metres.
    pub depth_m: Vec<f32>,
    /// How well the histogram speaks for the depth, 0 to 1.
    pub confidence: Vec<f32>,
    /// Unit normals, world axes; zero where unknown.
    pub normals: Vec<Vec3>,
    /// Probability that a spot lights what a pixel sees.
    pub lit: Vec<f32>,
    /// What that rests on.
    pub ground: Vec<Ground>,
    /// Albedo relative to the median pixel's.
    pub albedo: Vec<f32>,
    /// 1 where a mirror is seen: probabilities of a half and more.
    pub mirror: Option<Vec<u8>>,
    /// Probability that a mirror is seen.
    pub mirror_probability: Vec<f32>,
}

impl Demultiplexed {
    /// 1 = lit: probabilities of a half and more.
    pub fn mask(&self) -> Vec<u8> {
        self.lit.iter().map(|p| u8::from(*p >= 0.5)).collect()
    }
}

/// Takes one flash apart. The same bytes on any number of threads.
///
/// # Errors
/// [`DemultiplexError`] names the argument that cannot be used.
pub fn demultiplex(
    capture: &Capture,
    settings: &Settings,
) -> Result<Demultiplexed, DemultiplexError> {
    take_apart(capture, settings, None, None, &mut |_| {})
}

/// Takes one flash apart like [`demultiplex`], or like [`shadows_at`] with `depth_m`, and also
/// returns the evidence.
///
/// # Errors
/// [`DemultiplexError`] names the argument that cannot be used.
pub fn with_evidence(
    capture: &Capture,
    depth_m: Option<&[f32]>,
    settings: &Settings,
) -> Result<(Demultiplexed, Evidence), DemultiplexError> {
    if let Some(depth_m) = depth_m {
        check_depth(capture, depth_m)?;
    }
    if settings.shadows != Shading::Learned {
        let what = "the evidence is what the learned shadows are judged by";
        return Err(DemultiplexError::invalid("settings.shadows", what));
    }
    let mut evidence = Evidence::new(capture.spots.len(), capture.pixels());
    let found = take_apart(capture, settings, depth_m, Some(&mut evidence), &mut |_| {})?;
    Ok((found, evidence))
}

/// The same where z-depths are known already, metres, `[row][column]`: only shadows and albedo are
/// found.
///
/// # Errors
/// [`DemultiplexError`] names the argument that cannot be used.
pub fn shadows_at(
    capture: &Capture,
    depth_m: &[f32],
    settings: &Settings,
) -> Result<Demultiplexed, DemultiplexError> {
    check_depth(capture, depth_m)?;
    take_apart(capture, settings, Some(depth_m), None, &mut |_| {})
}

fn check_depth(capture: &Capture, depth_m: &[f32]) -> Result<(), DemultiplexError> {
    let pixels = capture.pixels();
    if depth_m.len() != pixels || depth_m.iter().any(|z| !z.is_finite()) {
        let what = format!("expected {pixels} finite values, one for each pixel");
        return Err(DemultiplexError::invalid("depth_m", what));
    }
    Ok(())
}

/// What the forests say of all pairs, and what the last of them sees ([`Scene::judged`]).
pub struct Judgement {
    pub odds: Vec<Vec<f32>>,
    pub seen: Vec<Vec<Vec<u8>>>,
}

/// The method at the scene's own size or that of a room; `watch` sees what shadows are judged by,
/// and `evidence` receives it.
pub fn take_apart(
    capture: &Capture,
    settings: &Settings,
    known_depth: Option<&[f32]>,
    evidence: Option<&mut Evidence>,
    watch: &mut dyn FnMut(&Scene),
) -> Result<Demultiplexed, DemultiplexError> {
    capture.check()?;
    let factor = scale::factor(capture);
    if factor == 1.0 {
        return in_room(capture, settings, known_depth, evidence, watch);
    }
    let scaled = Scaled::new(capture, factor);
    let known = known_depth.map(|depth_m| scaled.depth(depth_m));
    let capture = scaled.capture(capture);
    let found = in_room(&capture, settings, known.as_deref(), evidence, watch)?;
    Ok(scaled.back(found))
}

fn in_room(
    capture: &Capture,
    settings: &Settings,
    known_depth: Option<&[f32]>,
    mut evidence: Option<&mut Evidence>,
    watch: &mut dyn FnMut(&Scene),
) -> Result<Demultiplexed, DemultiplexError> {
    let camera = capture.camera;
    let rays = Rays::new(camera.intrinsics);
    let places = places(capture);
    let mut sources: Vec<Source> = places
        .iter()
        .enumerate()
        .filter_map(|(beam, place)| {
            let place = (*place)?;
            Some(Source::new(
                beam,
                camera.to_camera(place.point),
                place.path_m,
            ))
        })
        .collect();
    if sources.is_empty() {
        return Err(DemultiplexError::NoReturn {
            count: capture.spots.len(),
        });
    }
    let bins = capture.gate.bins as usize;
    // In units of the brightest bin, so that no unit overflows; negative values are no light.
    let brightest = capture.histogram.iter().copied().fold(0.0f32, f32::max);
    let share = |x: &f32| match brightest > 0.0 {
        true => (x / brightest).max(0.0),
        false => 0.0,
    };
    let merged = merged(&capture.gate, settings);
    let per = (merged.bin_width_m / capture.gate.bin_width_m).round() as usize;
    // Whole at once, because a vector that grows needs twice the memory.
    let mut histogram = Vec::with_capacity(rays.len() * merged.bins as usize);
    for h in capture.histogram.chunks(bins) {
        let wide = h.chunks_exact(per);
        histogram.extend(wide.map(|part| part.iter().map(share).sum::<f32>()));
    }
    let (gate, bins) = (&merged, merged.bins as usize);
    let pulse = Pulse::of_returns(capture, &rays, &sources).map(|p| p.summed(per));
    if let Some(pulse) = pulse.filter(|p| settings.remove_pulse && !p.is_narrow()) {
        pulse.remove(&mut histogram, gate, quiet(gate, &sources));
    }
    let sum = |h: &[f32]| h.iter().sum::<f32>();
    let intensity: Vec<f32> = histogram.chunks(bins).map(sum).collect();
    let log: Vec<f32> = intensity.iter().map(|x| libm::logf(x.max(1e-30))).collect();
    let edges = matching::edges(&rays, &intensity);
    let (mut depth, mut confidence, mut near) = (Vec::new(), Vec::new(), Vec::new());
    let mut lit: Vec<f32> = Vec::new();
    let mut mirror = vec![0.0; rays.len()];
    let pixels = rays.len();
    let mut all = vec![0.0; capture.spots.len() * pixels];
    let mut ground = vec![Ground::Geometry; capture.spots.len() * pixels];
    let mut found_albedo = Vec::new();
    for round in 0..settings.rounds.max(1) {
        let known = Known {
            normals: &near,
            lit: &lit,
        };
        (depth, confidence) = match known_depth {
            Some(known) => (known.to_vec(), vec![1.0; rays.len()]),
            None => {
                let volume = sweep(&histogram, gate, &rays, &sources, known, settings);
                let judge = Judge {
                    rays: &rays,
                    volume: &volume,
                    log: &log,
                    settings,
                };
                let first = first_depth(&rays, &volume, &edges, settings);
                let mut slants = judge.planes(&first);
                fill(&rays, &log, &sources, &volume.bound, settings, &mut slants);
                let unmix = Unmix {
                    rays: &rays,
                    histogram: &histogram,
                    bins,
                };
                unmix.apply(&mut slants);
                let mirrors = Mirrors {
                    rays: &rays,
                    histogram: &histogram,
                    gate,
                    sources: &sources,
                    bound: &volume.bound,
                    settings,
                };
                mirror = mirrors.find(&judge.room(&slants), &mut slants);
                finish(&rays, &slants, settings)
            }
        };
        near = normals(&rays, &depth, NEAR * rays.step(), LEAP);
        for s in &mut sources {
            s.normal = spot_normal(&rays, &depth, &near, s);
        }
        let light = Light {
            histogram: &histogram,
            gate,
            rays: &rays,
            sources: &sources,
            settings,
        };
        let range: Vec<f32> = (0..rays.len()).map(|p| depth[p] * rays.slant[p]).collect();
        let (shares, albedo) = light.shares(&range, &near);
        let judged = shadows(&rays, &depth, &sources, &shares);
        let scene = Scene {
            rays: &rays,
            depth: &depth,
            confidence: &confidence,
            mirror: &mirror,
            albedo: &albedo,
            log: &log,
            bin_m: gate.bin_width_m as f32,
            sources: &sources,
            normals: &near,
            shares: &shares,
            judged: &judged,
        };
        let judgement = match settings.shadows {
            Shading::Physics => None,
            Shading::Learned => {
                let (odds, seen) = scene.judged(forests(), evidence.is_some());
                Some(Judgement { odds, seen })
            }
        };
        let chance = |i: usize, p: usize| {
            let learned = judgement.as_ref().map(|j| &j.odds[i]);
            let odds = learned.unwrap_or(&judged[i].smooth);
            1.0 / (1.0 + libm::expf(-odds[p]))
        };
        let n = sources.len();
        if round + 1 < settings.rounds {
            lit = (0..rays.len() * n)
                .map(|q| chance(q % n, q / n).max(0.1))
                .collect();
            continue;
        }
        watch(&scene);
        if let (Some(evidence), Some(judgement)) = (evidence.as_deref_mut(), &judgement) {
            evidence.fill(&sources, judgement);
        }
        for (i, (s, judged)) in sources.iter().zip(&judged).enumerate() {
            let part = s.beam * pixels..(s.beam + 1) * pixels;
            for (p, out) in all[part.clone()].iter_mut().enumerate() {
                *out = chance(i, p);
            }
            ground[part].copy_from_slice(&judged.ground);
        }
        found_albedo = albedo;
    }
    let world = |n: &Vec3| camera.right * n.x + camera.down * n.y + camera.forward * n.z;
    Ok(Demultiplexed {
        places,
        depth_m: depth,
        confidence,
        normals: near.iter().map(world).collect(),
        lit: all,
        ground,
        albedo: relative(found_albedo),
        mirror: Some(mirror.iter().map(|m| u8::from(*m >= 0.5)).collect()),
        mirror_probability: mirror,
    })
}

/// The gate with bins summed that are narrower than they need be; those left over at its end are
/// dropped.
fn merged(gate: &Gate, settings: &Settings) -> Gate {
    // A width that divides it does so in spite of rounding.
    let per = (settings.finest_m / gate.bin_width_m + 1e-6).floor() as u32;
    let per = per.min(gate.bins / 3).max(1);
    Gate {
        start_m: gate.start_m,
        bin_width_m: gate.bin_width_m * f64::from(per),
        bins: gate.bins / per,
    }
}

/// z-depths by semi-global matching.
fn first_depth(rays: &Rays, volume: &Volume, edges: &[f32], settings: &Settings) -> Vec<f32> {
    let best = matching::best(rays, volume, edges, settings);
    let range = best.iter().map(|k| volume.ranges.at(*k));
    range.zip(&rays.slant).map(|(r, slant)| r / slant).collect()
}

/// z-depths of planes, and how well the histogram speaks for them. A plane that never meets its
/// pixel's ray is as far away as any that is tried, and nothing speaks for it.
fn finish(rays: &Rays, slants: &Slants, settings: &Settings) -> (Vec<f32>, Vec<f32>) {
    let of = |p: usize| {
        let z = slants.depth(rays, p);
        match z.is_finite() && z > 0.0 {
            true => (z, slants.score[p].clamp(0.0, 1.0)),
            false => (settings.farthest_m / rays.slant[p], 0.0),
        }
    };
    (0..rays.len()).map(of).unzip()
}

/// Normal of the surface that a spot is on: of the planes seen around it the one, moved to the
/// spot, to which most of the visible points around it belong.
pub fn spot_normal(rays: &Rays, depth: &[f32], normals: &[Vec3], source: &Source) -> Vec3 {
    let Some(p) = rays.pixel_of(source.point) else {
        return Vec3::ZERO;
    };
    let (column, row) = (p % rays.width, p / rays.width);
    let reach = SPOT.max(rays.width / 24);
    let near: Vec<usize> = (row.saturating_sub(reach)..(row + reach + 1).min(rays.height))
        .flat_map(|v| {
            let columns = column.saturating_sub(reach)..(column + reach + 1).min(rays.width);
            columns.map(move |u| v * rays.width + u)
        })
        .collect();
    let thick = FLAT * source.point.length();
    let support = |normal: Vec3| {
        let off = |q: &&usize| {
            let x = rays.unit[**q] * (depth[**q] * rays.slant[**q]);
            normal.dot(x - source.point).abs() < thick
        };
        near.iter().filter(off).count()
    };
    let mut best = (Vec3::ZERO, 0);
    for q in &near {
        let normal = normals[*q];
        let count = if normal == Vec3::ZERO {
            0
        } else {
            support(normal)
        };
        if count > best.1 {
            best = (normal, count);
        }
    }
    best.0
}

/// Over the median.
pub fn relative(albedo: Vec<f32>) -> Vec<f32> {
    let mut sorted = albedo.clone();
    sorted.sort_by(f32::total_cmp);
    let median = sorted[sorted.len() / 2].max(f32::MIN_POSITIVE);
    albedo.into_iter().map(|a| (a / median).min(1e6)).collect()
}
