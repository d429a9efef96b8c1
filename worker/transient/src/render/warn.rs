//! Warnings that a user should read before trusting a render: beams that hit nothing, and an image
//! without light. The image is correct all the same, so these are warnings and not errors.

use picofarm_scene::{Spot, Vec3};

use crate::{
    api::{ErrorEstimate, Gate},
    light::emitters::Emitters,
    scene::{centres::Centres, world::World},
};

/// The uncertainty of the variance from which an error deserves a warning: about that of four equal
/// bright paths.
const UNCERTAIN: f32 = 0.5;

/// The error of the whole image below which its uncertainty does not matter.
const NEGLIGIBLE: f32 = 1e-3;

/// Optical path lengths of two-bounce light, metres, over the spots and the points seen by the
/// pixels' centres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Arrivals {
    /// The shortest path.
    pub first: f64,
    /// The longest path.
    pub last: f64,
}

/// Returns the range of path lengths of two-bounce light, or `None` if no pixel sees a surface or
/// no beam hits one. `lit(beam, pixel)` returns whether a spot lights a pixel. No light of three
/// and more bounces arrives before the first of all pixels and spots, lit or not, because no path
/// is shorter than a straight one.
pub(crate) fn arrivals(
    world: &World,
    emitters: &Emitters,
    centres: &Centres,
    lit: impl Fn(usize, usize) -> bool,
) -> Option<Arrivals> {
    let mut found: Option<Arrivals> = None;
    for emitter in &emitters.list {
        for (pixel, hit) in centres.hits.iter().enumerate() {
            let Some(hit) = hit.as_ref().filter(|_| lit(emitter.beam, pixel)) else {
                continue;
            };
            let lengths = [emitter.p - hit.p, hit.p - Vec3::ZERO].map(|v| world.metres(v.length()));
            let path = emitter.path_m + lengths[0] + lengths[1];
            let all = found.get_or_insert(Arrivals {
                first: path,
                last: path,
            });
            all.first = all.first.min(path);
            all.last = all.last.max(path);
        }
    }
    found
}

/// Returns a warning about beams that hit nothing.
pub(crate) fn beams(spots: &[Option<Spot>]) -> Vec<String> {
    const SHOWN: usize = 8;
    let lost = spots.iter().enumerate().filter(|(_, spot)| spot.is_none());
    let lost: Vec<String> = lost.map(|(beam, _)| beam.to_string()).collect();
    match &lost[..] {
        [] if spots.is_empty() => vec!["the laser has no beam: there is no light".into()],
        [] => vec![],
        all if all.len() == spots.len() => {
            vec!["no beam of the laser meets a surface: there is no light".into()]
        }
        [one] => vec![format!("spot {one} hits nothing")],
        many => {
            let more = if many.len() > SHOWN { ", …" } else { "" };
            let shown = many[..many.len().min(SHOWN)].join(", ");
            vec![format!(
                "{} of {} spots hit nothing: {shown}{more}",
                many.len(),
                spots.len()
            )]
        }
    }
}

/// Returns the reason why a gate sees no light, if all light arrives after its end.
pub(crate) fn before_light(gate: &Gate, arrivals: Option<Arrivals>) -> Option<String> {
    let end = end(gate);
    let first = arrivals?.first;
    (first >= end).then(|| {
        format!(
            "no light arrives within the gate: first light at {first:.2} m, gate ends at {end:.2} m"
        )
    })
}

/// Returns the reason why there is no light in an image. `lit` are the arrivals of pixels that a
/// spot lights, `any` those of all pixels.
pub(crate) fn empty(
    gate: &Gate,
    spots: &[Option<Spot>],
    (lit, any): (Option<Arrivals>, Option<Arrivals>),
    outside: bool,
) -> String {
    const WORDS: &str = "the histogram is empty";
    if spots.iter().all(Option::is_none) {
        return format!("{WORDS}: no beam of the laser meets a surface");
    }
    if any.is_none() {
        return format!("{WORDS}: the camera sees no surface");
    }
    if let Some(Arrivals { first, last }) = lit {
        if first >= end(gate) {
            return format!(
                "{WORDS}: no light arrives within the gate: first light at {first:.2} m, gate ends at {:.2} m",
                end(gate)
            );
        }
        if last < gate.start_m {
            return format!(
                "{WORDS}: no light arrives within the gate: two-bounce light ends at {last:.2} m, gate starts at {:.2} m",
                gate.start_m
            );
        }
    }
    match outside {
        true => format!(
            "{WORDS}: what light there is arrives outside of the gate, {:.2} to {:.2} m",
            gate.start_m,
            end(gate)
        ),
        false => format!(
            "{WORDS}: no light finds a way from the spots to the camera; is the camera enclosed?"
        ),
    }
}

/// Returns a warning that few bright paths dominate the error of the whole image, with the
/// resulting uncertainty.
pub(crate) fn tails(error: &ErrorEstimate) -> Option<String> {
    let u = error.total_uncertainty;
    (u > UNCERTAIN && error.total_relative > NEGLIGIBLE).then(|| {
        format!(
            "few bright paths hold most of the whole image's error: its {:.2} % may as well be {:.2} %; more paths make it \
             surer",
            100.0 * error.total_relative,
            100.0 * error.total_relative * (1.0 + 2.0 * u).sqrt()
        )
    })
}

fn end(gate: &Gate) -> f64 {
    gate.start_m + f64::from(gate.bins) * gate.bin_width_m
}
