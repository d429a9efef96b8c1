//! Checks a scene and its settings, and prepares the scene for tracing.

use picofarm_scene::Scene;

use crate::{
    api::{RenderError, Settings, Stop},
    film::slots::Film,
    light::{
        beam::Beams,
        caustics::Caustics,
        contacts::{self, Contacts},
        emitters::Emitters,
        mirror_images::Mirrors,
        reflectors::Reflectors,
        splat_source::SplatSource,
    },
    paths::{
        ellipsoid::{
            patches::Patches,
            window::{self, Window},
        },
        glass::technique::GlassTechnique,
        path_reuse::effort::Effort,
        tracer::Tracer,
        two_bounce::Sampling,
    },
    render::{dark::is_dark, frame::Frame, ready::Ready, settings::check},
    scene::{centres, world::World},
    tuning::Tuning,
};

/// The maximum number of point sources, because arrivals store the source in 16 bits.
const MOST_SPOTS: usize = 1 << 16;

/// Checks a scene and its settings, prepares the scene and passes it to `then`.
pub(crate) fn prepare<R>(
    scene: &Scene,
    settings: &Settings,
    tuning: &Tuning,
    stop: Stop,
    then: impl FnOnce(&Ready) -> Result<R, RenderError>,
) -> Result<R, RenderError> {
    check(settings)?;
    scene.validate()?;
    let wavelength = settings.optics.wavelengths_nm.nm();
    let mut world = World::load(scene, wavelength, settings.gate.end_m(), stop)?;
    world.sensitive = settings.optics.fill_factor.sqrt() as f32;
    let beams = Beams {
        world: &world,
        tuning: tuning.beams,
    };
    let spots = beams.spots(&scene.laser.beams);
    let middles = Emitters::new(scene, beams, &spots)?;
    let wide = settings.optics.beam.as_ref();
    let wide = wide
        .map(|width| Emitters::widened(scene, beams, width))
        .transpose()?;
    let sources = wide.as_ref().unwrap_or(&middles);
    if sources.list.len() > MOST_SPOTS {
        return Err(RenderError::Invalid {
            field: "laser.beams".into(),
            what: format!(
                "make {} point sources, expected at most {MOST_SPOTS}; use fewer beams, or beam.points",
                sources.list.len()
            ),
        });
    }
    let max_bounces = settings.max_bounces.unwrap_or(u32::MAX);
    let is_dark = is_dark(&world, sources, &settings.gate, max_bounces);
    let none = Emitters::none();
    let emitters = if is_dark { &none } else { sources };
    let mirrors = if settings.strategy.mirror_images.unwrap_or(true) {
        Mirrors::find(&world, emitters, tuning.mirrors, stop)
    } else {
        Mirrors::default()
    };
    let centres = centres::centres(&world, stop)?;
    let sampling = Sampling::plan(&world, emitters, &centres, tuning.two_bounce, stop);
    stop.check()?;
    let of_spot = groups_of(settings, sources, spots.len())?;
    let film = Film::new(&settings.gate, settings.groups.len(), of_spot);
    // Sums over light paths count a pixel's slots in 32 bits.
    if u32::try_from(film.pixel()).is_err() {
        return Err(RenderError::Invalid {
            field: "groups".into(),
            what: format!(
                "make {} histograms of {} bins for each pixel, expected at most {} values; use fewer groups or bins",
                film.channels,
                settings.gate.bins,
                u32::MAX
            ),
        });
    }
    let strategy = &settings.strategy;
    let narrow = strategy
        .ellipsoidal
        .unwrap_or_else(|| window::pays(&settings.gate, &world, &tuning.ellipsoid));
    let patches = narrow.then(|| Patches::new(&world, emitters, tuning.ellipsoid));
    stop.check()?;
    let mut tracer = Tracer {
        world: &world,
        emitters,
        mirrors: &mirrors,
        gate: &settings.gate,
        max_bounces,
        tuning,
        lights: strategy.light_vertices.unwrap_or(true),
        caustics: None,
        reflectors: None,
        contacts: None,
        window: narrow.then(|| Window::new(&settings.gate)),
        patches: patches.as_ref(),
        shortest_m: emitters
            .list
            .iter()
            .fold(f64::INFINITY, |a, e| a.min(e.path_m)),
    };
    let caustics = match strategy.caustics {
        Some(false) => None,
        wanted => Caustics::find(&world, emitters, tuning.caustics, stop).filter(|c| {
            tracer.max_bounces >= 3
                && (wanted.is_some() || c.pay(&tracer.surroundings(), settings.seed))
        }),
    };
    stop.check()?;
    tracer.caustics = caustics.as_ref();
    // Few spots light few bins, so the error of the light that pixels share is as large there as
    // that of the light each finds alone. A narrow gate is similar.
    let many = contacts::many(emitters, &tuning.contacts) && !narrow;
    let reflectors = many
        .then(|| Reflectors::find(&world, tuning.reflectors))
        .flatten();
    tracer.reflectors = reflectors.as_ref();
    let contacts = match tracer.max_bounces {
        0 | 1 => None,
        _ => Contacts::find(&world, emitters, tuning.contacts),
    };
    tracer.contacts = contacts.as_ref();
    let glass = GlassTechnique::find((&tracer, &film), &centres, stop)?;
    let mut splat_sources: Vec<&dyn SplatSource> = vec![];
    splat_sources.extend(caustics.iter().map(|c| c as &dyn SplatSource));
    splat_sources.extend(contacts.iter().map(|c| c as &dyn SplatSource));
    splat_sources.extend(glass.iter().map(|g| g as &dyn SplatSource));
    let frame = Frame {
        tracer,
        sources: &splat_sources,
        film: &film,
        sampling: &sampling,
        effort: Effort::new(
            tuning,
            strategy.path_reuse.unwrap_or(match narrow {
                true => tuning.path_reuse.narrow_tile,
                false => tuning.path_reuse.wide_tile,
            }),
            narrow,
            world.has_narrow_lobes(),
            tracer.reflectors.is_some(),
        ),
        seed: settings.seed,
        width: scene.camera.intrinsics.width,
        height: scene.camera.intrinsics.height,
        split: settings.split,
    };
    then(&Ready {
        scene,
        settings,
        frame,
        centres: &centres,
        spots: &spots,
        sources,
        is_dark,
        middles: &middles,
    })
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
