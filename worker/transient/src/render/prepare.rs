//! Checks a scene and its settings, and prepares the scene for tracing.

use picofarm_scene::Scene;

use crate::{
    api::{RenderError, Settings, Stop},
    film::slots::Film,
    light::{
        beam::find_spots,
        caustics::Caustics,
        contacts::{self, Contacts},
        emitters::Emitters,
        mirror_images::Mirrors,
        reflectors::Reflectors,
    },
    paths::{
        ellipsoid::{
            patches::Patches,
            window::{self, Window},
        },
        glass::technique::ByGlass,
        path_reuse::effort::{Effort, NARROW_TILE, WIDE_TILE},
        tracer::Walk,
        two_bounce::Sampling,
    },
    render::{dark::is_dark, frame::Frame, ready::Ready, settings::check},
    scene::{centres, world::World},
};

/// The maximum number of point sources, because arrivals store the source in 16 bits.
const MOST_SPOTS: usize = 1 << 16;

/// Checks a scene and its settings, prepares the scene and passes it to `then`.
pub(crate) fn prepare<R>(
    scene: &Scene,
    settings: &Settings,
    stop: Stop,
    then: impl FnOnce(&Ready) -> Result<R, RenderError>,
) -> Result<R, RenderError> {
    check(settings)?;
    scene.validate()?;
    let wavelength = settings.wavelengths_nm.nm();
    let mut world = World::at(scene, wavelength, settings.gate.end_m(), stop)?;
    world.sensitive = settings.fill_factor.sqrt() as f32;
    let spots = find_spots(&world, &scene.laser.beams);
    let middles = Emitters::new(scene, &world, &spots)?;
    let wide = settings.beam.as_ref();
    let wide = wide
        .map(|width| Emitters::widened(scene, &world, width))
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
        Mirrors::find(&world, emitters, stop)
    } else {
        Mirrors::default()
    };
    let centres = centres::centres(&world, stop)?;
    let sampling = Sampling::plan(&world, emitters, &centres, stop);
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
        .unwrap_or_else(|| window::pays(&settings.gate, &world));
    let patches = narrow.then(|| Patches::new(&world, emitters));
    stop.check()?;
    let mut walk = Walk {
        world: &world,
        emitters,
        mirrors: &mirrors,
        gate: &settings.gate,
        max_bounces,
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
        wanted => Caustics::find(&world, emitters, stop).filter(|c| {
            walk.max_bounces >= 3
                && (wanted.is_some() || c.pay(&walk.surroundings(), settings.seed))
        }),
    };
    stop.check()?;
    walk.caustics = caustics.as_ref();
    // Few spots light few bins, so the error of the light that pixels share is as large there as
    // that of the light each finds alone. A narrow gate is similar.
    let many = contacts::many(emitters) && !narrow;
    let reflectors = many.then(|| Reflectors::find(&world)).flatten();
    walk.reflectors = reflectors.as_ref();
    let contacts = match walk.max_bounces {
        0 | 1 => None,
        _ => Contacts::find(&world, emitters),
    };
    walk.contacts = contacts.as_ref();
    let glass = ByGlass::find((&walk, &film), &centres, stop)?;
    let frame = Frame {
        walk,
        glass: glass.as_ref(),
        film: &film,
        sampling: &sampling,
        effort: Effort::new(
            strategy
                .path_reuse
                .unwrap_or(if narrow { NARROW_TILE } else { WIDE_TILE }),
            narrow,
            world.has_narrow_lobes(),
            walk.reflectors.is_some(),
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
