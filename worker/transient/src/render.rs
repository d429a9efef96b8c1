//! The driver: checks, preparation, tiles over the image, and the stopping rule.

mod error;
mod forecast;
mod image;
mod splat;
mod tile;

use picofarm_scene::Scene;

pub use self::forecast::Forecast;
use self::{
    error::{Stat, estimate, passes_for},
    forecast::{Ended, Unwatched},
    image::{Image, Watch},
    splat::Splats,
    tile::Frame,
};
use crate::{
    api::{Budget, Overflow, Progress, RenderError, Rendered, Settings, Split},
    caustic::Caustics,
    ellipsoid::{self, Patches, Window},
    emitter::{Emitters, find_spots},
    film::Film,
    lobe::Mirrors,
    one, photo,
    plan::plan as decide,
    share::Effort,
    truth,
    two::Sampling,
    walk::Walk,
    world::World,
};

/// Most passes that [`Budget::Error`] spends.
const MAX_PASSES: u32 = 1 << 16;
/// Passes of its first round, enough for an error estimate that means something.
const FIRST_PASSES: u32 = 8;
/// Share of the progress that the first round counts for.
const FIRST_SHARE: f32 = 0.3;
/// Aimed at, as a share of the error asked for, since the estimate is itself an estimate.
const GOAL: f32 = 0.98;

/// Side in pixels of the tiles that share vertices.
const SHARE: u32 = 8;

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
    run(scene, settings, progress, false).map_err(|ended| match ended {
        Ended::Failed(error) => error,
        Ended::Planned(_) => unreachable!("only a plan ends with one"),
    })
}

/// What [`render`] would do, from a few small tiles of the image instead of all of it. Runs on the
/// caller's rayon pool.
///
/// # Errors
/// Those of [`render`].
pub fn plan(scene: &Scene, settings: &Settings) -> Result<Forecast, RenderError> {
    match run(scene, settings, &Unwatched, true) {
        Err(Ended::Planned(forecast)) => Ok(forecast),
        Err(Ended::Failed(error)) => Err(error),
        Ok(_) => unreachable!("a plan ends before the render"),
    }
}

/// Everything up to the first pass, and the render where it is not only to be planned.
fn run(
    scene: &Scene,
    settings: &Settings,
    progress: &dyn Progress,
    only_plan: bool,
) -> Result<Rendered, Ended> {
    check(settings)?;
    scene.validate()?;
    let world = World::new(scene)?;
    let spots = find_spots(&world, &scene.laser.beams);
    let emitters = Emitters::new(scene, &world, &spots)?;
    let mirrors = if settings.strategy.image_lobes.unwrap_or(true) {
        Mirrors::find(&world, &emitters)
    } else {
        Mirrors::default()
    };
    let mut centres = truth::centres(&world);
    let mut truth = truth::ground_truth(scene, &world, &emitters, &mut centres, spots.len());
    let (rgb, photo_rays) = photo::photo(&world, settings.seed);
    truth.rgb = rgb;
    let sampling = Sampling::plan(&world, &emitters, &centres);

    let intrinsics = scene.camera.intrinsics;
    let (width, height) = (intrinsics.width, intrinsics.height);
    let of_spot = groups_of(settings, &emitters, spots.len())?;
    let film = Film::new(&settings.gate, settings.groups.len(), of_spot);
    let strategy = &settings.strategy;
    let narrow = strategy
        .ellipsoidal
        .unwrap_or_else(|| ellipsoid::pays(&settings.gate, &world));
    let patches = narrow.then(|| Patches::new(&world, &emitters));
    let mut walk = Walk {
        world: &world,
        emitters: &emitters,
        mirrors: &mirrors,
        gate: &settings.gate,
        max_bounces: settings.max_bounces.unwrap_or(u32::MAX),
        lights: strategy.light_vertices.unwrap_or(true),
        caustics: None,
        window: narrow.then(|| Window::new(&settings.gate)),
        patches: patches.as_ref(),
        shortest_m: emitters
            .list
            .iter()
            .fold(f64::INFINITY, |a, e| a.min(e.path_m)),
    };
    let caustics = match strategy.caustics {
        Some(false) => None,
        wanted => Caustics::find(&world, &emitters)
            .filter(|c| walk.max_bounces >= 3 && (wanted.is_some() || c.pay(&walk, settings.seed))),
    };
    walk.caustics = caustics.as_ref();
    let frame = Frame {
        walk,
        film: &film,
        sampling: &sampling,
        effort: Effort::new(strategy.share.unwrap_or(SHARE), narrow),
        seed: settings.seed,
        width,
        height,
        split: settings.split,
    };
    let mut image = Image::new(&frame);
    let mut splats = walk.caustics.map(|c| (c, Splats::new(&frame)));
    let walks = frame.walk.max_bounces >= 3 && !emitters.list.is_empty();
    let mut rays = 0;
    let passes = match settings.budget {
        _ if !walks => 0,
        Budget::Samples(n) => n,
        Budget::Error(_) => FIRST_PASSES,
    };
    let plan = decide(settings, &walk, &sampling, passes);
    let mut waves = vec![passes; image.tiles()];
    let mut done = 0.0;
    if only_plan {
        let rays = centres.rays + photo_rays;
        let forecast = forecast::forecast(&frame, &settings.budget, plan, rays);
        return Err(Ended::Planned(forecast));
    }
    let error = loop {
        let until = match settings.budget {
            Budget::Error(_) if walks && done == 0.0 => FIRST_SHARE,
            _ => 1.0,
        };
        let watch = Watch::new(progress, done, until);
        let before = image.mean_passes();
        rays += image.round(&frame, &waves, &watch)?;
        done = until;
        let error = match &mut splats {
            None => estimate(&image.stats, image.total_variance, image.mean_passes()),
            Some((caustics, splats)) => {
                let wave = image.mean_passes() - before;
                rays += splats.round((&frame, caustics), wave, &watch)?;
                splats.estimate(&frame, &image)
            }
        };
        let Budget::Error(target) = settings.budget else {
            break error;
        };
        if !walks || error.median_relative <= target || error.samples >= MAX_PASSES {
            break error;
        }
        waves = further(&image, &sampling, target, error.samples);
    };
    if let Some((_, splats)) = &splats {
        splats.join(&frame, &mut image);
    }

    let mut overflow = Overflow {
        energy: image.overflow,
        share: 0.0,
    };
    if settings.one_bounce && frame.walk.max_bounces >= 1 {
        let mut stack = world.bvh.stack();
        let peaks = one::peaks(&world, &mut stack, &emitters);
        for peak in &peaks {
            if !one::add(peak, &settings.gate, &mut image.transient) {
                overflow.energy += f64::from(peak.value);
            }
            for &channel in &film.of_spot[peak.spot] {
                let group = &mut image.groups[usize::from(channel) - 1];
                one::add(peak, &settings.gate, group);
            }
        }
        rays += stack.rays;
    }
    let inside: f64 = image.transient.iter().map(|&v| f64::from(v)).sum();
    overflow.share = if overflow.energy > 0.0 {
        overflow.energy / (overflow.energy + inside)
    } else {
        0.0
    };
    Ok(Rendered {
        width,
        height,
        gate: settings.gate,
        transient: image.transient,
        split: image.split.map(|s| Split {
            two: s.two,
            two_se: s.two_se,
            multi: s.multi,
            multi_se: s.multi_se,
            multi_noise: s.multi_noise,
        }),
        groups: image.groups,
        truth,
        spots,
        overflow,
        error,
        plan,
        rays: rays + centres.rays + photo_rays,
    })
}

/// How many more passes each tile needs for the median error of the image to reach `target`. What the
/// image needs on average is shared out by what the tiles need themselves, within a factor of two: tiles
/// that are easy stop early, and no tile holds up all others.
fn further(image: &Image, sampling: &Sampling, target: f32, spent: u32) -> Vec<u32> {
    let two = |n| sampling.variance(n);
    let target = GOAL * target;
    let all = passes_for(&image.stats, spent, target, (spent + 1, MAX_PASSES), two);
    let own = |(spent, stats): (u32, Vec<Stat>)| {
        let range = (all / 2, (2 * all).min(MAX_PASSES));
        let need = passes_for(&stats, spent, target, range, two);
        need.saturating_sub(spent)
    };
    let waves: Vec<u32> = image.by_tile().map(own).collect();
    if waves.iter().all(|&n| n == 0) {
        return vec![(spent / 8).max(1); waves.len()];
    }
    waves
}

/// The channels beyond 0 that each emitter's light goes to.
fn groups_of(
    settings: &Settings,
    emitters: &Emitters,
    beams: usize,
) -> Result<Vec<Vec<u16>>, RenderError> {
    for (g, group) in settings.groups.iter().enumerate() {
        if let Some(beam) = group.iter().find(|&&b| b as usize >= beams) {
            return Err(RenderError::Invalid {
                field: format!("groups[{g}]"),
                what: format!("names beam {beam}, but the laser has {beams}, counted from 0"),
            });
        }
    }
    let channels = |beam: usize| {
        let in_group = |g: &Vec<u32>| g.contains(&(beam as u32));
        (1u16..)
            .zip(&settings.groups)
            .filter(|(_, g)| in_group(g))
            .map(|(c, _)| c)
            .collect()
    };
    Ok(emitters.list.iter().map(|e| channels(e.beam)).collect())
}

fn check(settings: &Settings) -> Result<(), RenderError> {
    let bad = |field: &str, what: String| {
        Err(RenderError::Invalid {
            field: field.into(),
            what,
        })
    };
    let g = &settings.gate;
    if !(g.bin_width_m.is_finite() && g.bin_width_m > 0.0) {
        return bad(
            "gate.bin_width_m",
            format!("is {}, expected a positive length in metres", g.bin_width_m),
        );
    }
    if !(g.start_m.is_finite() && g.start_m >= 0.0) {
        return bad(
            "gate.start_m",
            format!("is {}, expected a path length of 0 m or more", g.start_m),
        );
    }
    if g.bins == 0 || g.bins > 1 << 20 {
        return bad("gate.bins", format!("is {}, expected 1 to 1048576", g.bins));
    }
    if settings
        .strategy
        .share
        .is_some_and(|s| !(1..=16).contains(&s))
    {
        return bad(
            "strategy.share",
            "expected a tile of 1 to 16 pixels a side".into(),
        );
    }
    if settings.groups.len() > 1024 {
        return bad(
            "groups",
            format!("has {}, expected at most 1024", settings.groups.len()),
        );
    }
    match settings.budget {
        Budget::Samples(n) if n > MAX_PASSES * 16 => bad(
            "budget.samples",
            format!(
                "is {n}, expected at most {} paths per pixel",
                MAX_PASSES * 16
            ),
        ),
        Budget::Error(e) if !(e > 0.0 && e.is_finite()) => bad(
            "budget.error",
            format!("is {e}, expected a positive share such as 0.1"),
        ),
        _ => match settings.max_bounces {
            Some(0) => bad("max_bounces", "is 0, expected 1 or more".into()),
            _ => Ok(()),
        },
    }
}
