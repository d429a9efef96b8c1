//! The driver: checks, preparation, rounds over the image, and the stopping rule.

mod error;
mod round;

use picofarm_scene::Scene;

use self::{
    error::{estimate, paths_for},
    round::{Buffers, Frame, Watch, pilot},
};
use crate::{
    api::{Budget, Overflow, Progress, RenderError, Rendered, Settings, Split},
    emitter::{Emitters, find_spots},
    lobe::Mirrors,
    multi::Walk,
    one, photo,
    plan::plan,
    truth,
    two::Sampling,
    world::World,
};

/// Most paths per pixel that [`Budget::Error`] spends.
const MAX_PATHS: u32 = 1 << 16;

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
    check(settings)?;
    scene.validate()?;
    let world = World::new(scene);
    let spots = find_spots(&world, &scene.laser.beams);
    let emitters = Emitters::new(scene, &world, &spots)?;
    let mirrors = Mirrors::find(&world, &emitters);
    let mut centres = truth::centres(&world);
    let mut truth = truth::ground_truth(scene, &world, &emitters, &mut centres, spots.len());
    let (rgb, photo_rays) = photo::photo(&world, settings.seed);
    truth.rgb = rgb;
    let sampling = Sampling::plan(&world, &emitters, &centres);

    let intrinsics = scene.camera.intrinsics;
    let (width, height) = (intrinsics.width, intrinsics.height);
    let frame = Frame {
        walk: Walk {
            world: &world,
            emitters: &emitters,
            mirrors: &mirrors,
            gate: &settings.gate,
            max_bounces: settings.max_bounces.unwrap_or(u32::MAX),
            shortest_m: emitters
                .list
                .iter()
                .fold(f64::INFINITY, |a, e| a.min(e.path_m)),
        },
        sampling: &sampling,
        seed: settings.seed,
        width,
        height,
    };
    let mut buffers = Buffers::new(
        width as usize * height as usize,
        settings.gate.bins as usize,
        settings.split,
    );
    let walks = frame.walk.max_bounces >= 3 && !emitters.list.is_empty();
    let (paths, target) = match settings.budget {
        _ if !walks => (0, None),
        Budget::Samples(n) => (n, None),
        Budget::Error(target) => {
            let pilot = pilot(&frame);
            (paths_for(&pilot, target, MAX_PATHS), Some(target))
        }
    };
    let plan = plan(settings, &mirrors, &sampling, paths);
    let mut overflow = Overflow::default();
    let mut rays = 0;
    let mut spent = 0;
    let mut wave = paths;
    let error = loop {
        let watch = Watch::new(progress, spent, spent + wave);
        let found = round::round(&frame, &mut buffers, (spent, wave), &watch)?;
        overflow = found.blend(&overflow, spent, wave);
        rays += found.rays;
        spent += wave;
        let error = estimate(&buffers.stats, spent);
        let done = target.is_none_or(|t| error.median_relative <= t) || spent >= MAX_PATHS;
        if done {
            break error;
        }
        wave = (spent / 2).clamp(4, MAX_PATHS - spent.min(MAX_PATHS - 4));
    };

    if settings.one_bounce && frame.walk.max_bounces >= 1 {
        let mut stack = world.bvh.stack();
        let peaks = one::peaks(&world, &mut stack, &emitters);
        one::add(
            &peaks,
            &settings.gate,
            &mut buffers.transient,
            &mut overflow,
        );
        rays += stack.rays;
    }
    let inside: f64 = buffers.transient.iter().map(|&v| f64::from(v)).sum();
    overflow.share = if overflow.energy > 0.0 {
        overflow.energy / (overflow.energy + inside)
    } else {
        0.0
    };
    Ok(Rendered {
        width,
        height,
        gate: settings.gate,
        transient: buffers.transient,
        split: buffers.split.map(|s| Split {
            two: s.two,
            two_se: s.two_se,
            multi: s.multi,
            multi_se: s.multi_se,
        }),
        truth,
        spots,
        overflow,
        error,
        plan,
        rays: rays + centres.rays + photo_rays,
    })
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
    match settings.budget {
        Budget::Samples(n) if n > MAX_PATHS * 16 => bad(
            "budget.samples",
            format!(
                "is {n}, expected at most {} paths per pixel",
                MAX_PATHS * 16
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
