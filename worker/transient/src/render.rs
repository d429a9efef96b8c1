//! The driver: a whole render with its stopping rule, and the forecast of one.

mod dark;
mod draws;
mod error;
mod forecast;
mod image;
mod layer;
mod part;
mod ready;
mod region;
mod splat;
mod tile;
mod variance;
mod warn;

use picofarm_scene::Scene;

use self::{
    error::{Errors, passes_for},
    image::{Image, Round, Watch},
    ready::{Ready, prepare},
    splat::{Sources, Splats},
};
pub use self::{
    forecast::Forecast,
    part::{Part, PartOf, join_parts, render_part},
    variance::{ClassVariance, variance},
};
use crate::{
    api::{Budget, Progress, RenderError, Rendered, Settings, Stop, Unstopped},
    two_bounce::Sampling,
};

/// Most passes that [`Budget::Error`] spends.
const MAX_PASSES: u32 = 1 << 16;
/// Passes of its first round, the fewest that tell how far they scatter: with 4 large images of many spots
/// came to 6.8 to 8.6 % where 10 % were asked for.
const FIRST_PASSES: u32 = 2;
/// Share of the progress that the first round counts for.
const FIRST_SHARE: f32 = 0.3;
/// How much longer than all before it a round of a render that is bound in time may be: each tells how long the next will take.
const GROWTH: u32 = 3;
/// Share of the time left that a round is made for.
const TIMED: f64 = 0.85;

/// Renders a scene. Runs on the caller's rayon pool; the result is bit-identical for any number of
/// threads, and on any machine.
///
/// # Errors
/// [`RenderError::Scene`] or [`RenderError::Invalid`] name what is unusable; [`RenderError::Stopped`]
/// where `progress` asked to stop.
pub fn render(
    scene: &Scene,
    settings: &Settings,
    progress: &dyn Progress,
) -> Result<Rendered, RenderError> {
    prepare(scene, settings, Stop(progress), |ready| {
        whole(ready, None, progress)
    })
}

/// Renders as many passes as time allows: `left` says how many seconds are left, and is asked between rounds. The budget of
/// `settings` bounds it as well: it ends where the error is reached, or after so many samples. It makes 2 passes even
/// where time is too short for them. How many passes there are depends on the machine and its load, so the same call gives
/// other bytes each time; [`render`] with the samples that [`crate::ErrorEstimate::samples`] states comes near to it.
///
/// # Errors
/// Those of [`render`].
pub fn render_within(
    scene: &Scene,
    settings: &Settings,
    left: &dyn Fn() -> f64,
    progress: &dyn Progress,
) -> Result<Rendered, RenderError> {
    prepare(scene, settings, Stop(progress), |ready| {
        whole(ready, Some(left), progress)
    })
}

/// What [`render`] would do, from a few small tiles of the image instead of all of it. Runs on the
/// caller's rayon pool.
///
/// # Errors
/// Those of [`render`].
pub fn plan(scene: &Scene, settings: &Settings) -> Result<Forecast, RenderError> {
    prepare(scene, settings, Stop(&Unstopped), |ready| {
        let plan = ready.plan(ready.first_passes());
        let rays = ready.seen_rays();
        let forecast = forecast::forecast(&ready.frame, &settings.budget, plan, rays)?;
        Ok(Forecast {
            warnings: ready.foreseen(),
            ..forecast
        })
    })
}

fn whole(
    ready: &Ready,
    left: Option<&dyn Fn() -> f64>,
    progress: &dyn Progress,
) -> Result<Rendered, RenderError> {
    let (frame, stop) = (&ready.frame, Stop(progress));
    // Before anything that takes long: where there is no room, it is known at once.
    let mut image = Image::new(frame)?;
    let mut splats = Sources::of(frame).map(|sources| (sources, Splats::new(frame)));
    let seen = ready.seen(stop)?;
    let walks = ready.walks();
    let passes = match left {
        Some(_) => ready.first_passes().min(FIRST_PASSES),
        None => ready.first_passes(),
    };
    let budget = ready.settings.budget;
    let mut wave = Round {
        more: matches!(budget, Budget::Error(_)) || left.is_some(),
        ..Round::only(passes)
    };
    let (mut rays, mut done) = (0, 0.0);
    let error = loop {
        let began = left.map(|left| left());
        let until = match budget {
            _ if left.is_some() && walks && done == 0.0 => FIRST_SHARE,
            Budget::Error(_) if walks && done == 0.0 => FIRST_SHARE,
            _ => 1.0,
        };
        let watch = Watch::new(progress, done, until);
        rays += image.round(frame, 0..image.tiles(), wave, &watch)?;
        done = until;
        let errors = match &mut splats {
            None => image.errors(),
            Some((sources, splats)) => {
                let wave = match walks {
                    true => wave.passes,
                    false => ready.splat_passes(0),
                };
                rays += splats.round((frame, sources), wave, &watch)?;
                splats.errors(frame, &image, stop)?
            }
        };
        let error = errors.estimate();
        let spent = error.samples;
        let enough = match budget {
            Budget::Error(e) => error.median_relative <= e as f32 || spent >= MAX_PASSES,
            Budget::Samples(n) => spent >= n,
        };
        if !walks || enough {
            break error;
        }
        if let (Some(left), Some(began)) = (left, began) {
            let most = match budget {
                Budget::Error(_) => MAX_PASSES - spent,
                Budget::Samples(n) => n - spent,
            };
            let next = in_time((began, left()), wave.passes);
            let next = next.min(GROWTH * spent).min(most);
            if next == 0 {
                break error;
            }
            wave = Round {
                passes: next,
                two: next >= spent,
                more: true,
            };
            continue;
        }
        let Budget::Error(target) = budget else {
            break error;
        };
        let target = target as f32;
        let strata_cost = |n| image.strata_cost(frame.sampling, n);
        wave = further(&errors, (frame.sampling, &strata_cost), target, stop)?;
    };
    let plan = ready.plan(passes);
    let splats = splats.map(|(_, splats)| splats);
    ready.finish((image, splats), seen, (error, rays), (plan, stop))
}

/// Passes that fit into the time left, where `round` of them took it from `began` to `left`.
fn in_time((began, left): (f64, f64), round: u32) -> u32 {
    let each = (began - left).max(1e-6) / f64::from(round.max(1));
    // Casting saturates.
    (TIMED * left / each) as u32
}

/// What more the median error of the image needs to reach `target`: passes, and two bounces sampled again where
/// that takes fewer rays. All tiles get as many passes: to give those with larger errors more, up to twice as
/// many, took up to a half more time to the same median, and as long to the same 95th percentile.
fn further(
    errors: &Errors,
    (sampling, strata_cost): (&Sampling, &dyn Fn(u32) -> u32),
    target: f32,
    stop: Stop,
) -> Result<Round, RenderError> {
    let spent = errors.samples;
    let target = target / errors.likely(0.5) as f32;
    let passes = |two: bool| {
        let unit = |n: u32| match stop.asked() {
            // Whatever comes out of it is not used.
            true => 0.0,
            false if n == spent || !two => errors.two_unit,
            false => sampling.joined(errors.two_unit, n - spent),
        };
        let range = ((spent + 1).min(MAX_PASSES), MAX_PASSES);
        passes_for(&errors.stats, spent, target, range, unit) - spent
    };
    let (alone, again) = (passes(false), passes(true));
    stop.check()?;
    let two = again.saturating_add(strata_cost(again)) < alone;
    Ok(Round {
        passes: if two { again } else { alone },
        two,
        more: true,
    })
}
