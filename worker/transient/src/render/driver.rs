//! The driver: a whole render with its stopping rule, and the forecast of a render.

use picofarm_scene::Scene;

use crate::{
    api::{Budget, Progress, RenderError, Rendered, Settings, Stop, Unstopped},
    paths::two_bounce::Sampling,
    render::{
        error::{Errors, passes_for},
        forecast::{self, Forecast},
        image::Image,
        prepare::prepare,
        ready::Ready,
        rounds::{FIRST_PASSES, MAX_PASSES, Round},
        sources::Sources,
        splats::Splats,
        watch::Watch,
    },
};

/// Fraction of the progress that the first round counts for.
const FIRST_SHARE: f32 = 0.3;

/// The maximum length of a round of a time-bound render, in multiples of all rounds before it,
/// because each round predicts the time of the next.
const GROWTH: u32 = 3;

/// Fraction of the remaining time that a round is planned for.
const TIMED: f64 = 0.85;

/// Renders a scene. Runs on the caller's rayon pool. The result is bit-identical for any number of
/// threads, and on any machine.
///
/// # Errors
/// Returns [`RenderError::Scene`] or [`RenderError::Invalid`] naming the invalid input, and
/// [`RenderError::Stopped`] if `progress` requests a stop.
pub fn render(
    scene: &Scene,
    settings: &Settings,
    progress: &dyn Progress,
) -> Result<Rendered, RenderError> {
    prepare(scene, settings, Stop(progress), |ready| {
        whole(ready, None, progress)
    })
}

/// Renders as many passes as time allows.
///
/// `left` returns the remaining seconds and is called between rounds. The budget of `settings`
/// applies as well: the render ends once the error is reached, or after the given number of
/// samples. It makes 2 passes even if there is not enough time for them. The number of passes
/// depends on the machine and its load, so the same call returns different bytes each time.
/// [`render`] with the number of samples in [`crate::api::ErrorEstimate::samples`] gives a similar
/// result.
///
/// # Errors
/// Returns the errors of [`render`].
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

/// Forecasts a [`render`] from a few small tiles of the image instead of all of it. Runs on the
/// caller's rayon pool.
///
/// # Errors
/// Returns the errors of [`render`].
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
    // Allocated before anything that takes long, so that a lack of memory is reported at once.
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

/// Returns the passes that fit into the remaining time, if `round` passes took it from `began` to
/// `left`.
fn in_time((began, left): (f64, f64), round: u32) -> u32 {
    let each = (began - left).max(1e-6) / f64::from(round.max(1));
    // The cast saturates.
    (TIMED * left / each) as u32
}

/// Returns the round that the median error of the image needs to reach `target`: passes, and a new
/// sampling of two bounces if that takes fewer rays.
///
/// All tiles get the same number of passes. With up to twice as many passes for tiles with larger
/// errors, the same median took up to a half more time, and the same 95th percentile took as long.
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
            // The value is not used.
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
