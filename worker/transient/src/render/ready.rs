//! The first and last steps of every render: preparing the scene for tracing, and converting the
//! image into a result.

use picofarm_scene::{Scene, Spot};

use super::{
    FIRST_PASSES, MAX_PASSES, dark::is_dark, image::Image, splat::Splats, tile::Frame, warn,
};
use crate::{
    api::{
        Budget, ErrorEstimate, GroundTruth, Overflow, Plan, RenderError, Rendered, Settings, Split,
        Stop,
    },
    beam::find_spots,
    by_glass::ByGlass,
    caustic::Caustics,
    contact::{self, Contacts},
    ellipsoid::{self, Patches, Window},
    emitter::Emitters,
    film::Film,
    mirror_images::Mirrors,
    one_bounce,
    path_reuse::{Effort, NARROW_TILE, WIDE_TILE},
    photo,
    plan::plan as decide,
    reflectors::Reflectors,
    truth::{self, Centres},
    two_bounce::Sampling,
    walk::Walk,
    world::World,
};

/// Passes of light paths if no other passes are made.
pub(super) const TWO_PASSES: u32 = 64;
/// The maximum number of point sources, because arrivals store the source in 16 bits.
const MOST_SPOTS: usize = 1 << 16;
/// The number of rows from which the rays of the ground truth are forecast.
const ROWS: usize = 128;

/// A scene prepared for tracing.
pub(super) struct Ready<'a> {
    pub scene: &'a Scene,
    pub settings: &'a Settings,
    pub frame: Frame<'a>,
    centres: &'a Centres,
    spots: &'a [Option<Spot>],
    /// All sources, including those that `frame` omits because none of their light reaches the
    /// gate.
    sources: &'a Emitters,
    is_dark: bool,
    /// The spots as sources. They light the image unless the beams have a width.
    middles: &'a Emitters,
}

/// Checks a scene and its settings, prepares the scene and passes it to `then`.
pub(super) fn prepare<R>(
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
    let centres = truth::centres(&world, stop)?;
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
        .unwrap_or_else(|| ellipsoid::pays(&settings.gate, &world));
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
        glass: None,
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
    let many = contact::many(emitters) && !narrow;
    let reflectors = many.then(|| Reflectors::find(&world)).flatten();
    walk.reflectors = reflectors.as_ref();
    let contacts = match walk.max_bounces {
        0 | 1 => None,
        _ => Contacts::find(&world, emitters),
    };
    walk.contacts = contacts.as_ref();
    let glass = ByGlass::find((&walk, &film), &centres, stop)?;
    walk.glass = glass.as_ref();
    let frame = Frame {
        walk,
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

impl Ready<'_> {
    /// Returns whether light of three bounces and more must be sampled.
    pub fn walks(&self) -> bool {
        let walk = &self.frame.walk;
        walk.max_bounces >= 3 && !walk.emitters.list.is_empty()
    }

    /// Returns the passes of the first round, which is the only one unless an error target is set.
    pub fn first_passes(&self) -> u32 {
        match self.settings.budget {
            _ if !self.walks() => 0,
            Budget::Samples(n) => n,
            Budget::Error(_) => FIRST_PASSES,
        }
    }

    /// Returns the passes of light paths for `passes` passes of the image. Two bounces alone need
    /// some as well.
    pub fn splat_passes(&self, passes: u32) -> u32 {
        if self.walks() { passes } else { TWO_PASSES }
    }

    /// Returns the renderer's decisions for a first round of `passes`.
    pub fn plan(&self, passes: u32) -> Plan {
        let sampling = (self.frame.sampling, passes);
        let mut plan = decide(self.scene, self.settings, &self.frame.walk, sampling);
        if self.is_dark {
            plan.approximations.push(
                "no light of two bounces and more reaches the gate: none is looked for, and the overflow has one bounce alone"
                    .into(),
            );
        }
        plan
    }

    /// Returns the ground truth and the number of rays it took.
    ///
    /// # Errors
    /// Returns [`RenderError::Stopped`] if the render is stopped.
    pub fn seen(&self, stop: Stop) -> Result<(GroundTruth, u64), RenderError> {
        let walk = &self.frame.walk;
        let (beams, of) = (self.spots.len(), (walk.world, self.middles));
        let (mut truth, rays) = truth::ground_truth(self.scene, of, self.centres, beams, stop)?;
        let (rgb, photo_rays) = photo::photo(walk.world, self.settings.seed, stop)?;
        truth.rgb = rgb;
        Ok((truth, self.centres.rays + rays + photo_rays))
    }

    /// Returns the approximate number of rays of the ground truth, from some rows of a large image.
    pub fn seen_rays(&self) -> u64 {
        let walk = &self.frame.walk;
        let step = (self.frame.height as usize / ROWS).max(1);
        let truth = truth::rays(walk.world, self.middles, self.centres, step);
        self.centres.rays + truth + photo::rays(walk.world, self.settings.seed, step)
    }

    /// Returns warnings about the scene or gate that are certain before rendering.
    pub fn foreseen(&self) -> Vec<String> {
        let walk = &self.frame.walk;
        let mut warnings = warn::beams(self.spots);
        let any = warn::arrivals(walk.world, self.middles, self.centres, |_, _| true);
        if any.is_none() && !self.middles.list.is_empty() {
            warnings.push("the camera sees no surface".into());
        }
        warnings.extend(warn::before_light(&self.settings.gate, any));
        warnings
    }

    /// Returns the reason if a finished image has no light. `inside` is its energy, and `outside`
    /// is whether light arrives outside the gate.
    fn dark(&self, truth: &GroundTruth, inside: f64, outside: bool) -> Option<String> {
        if inside > 0.0 {
            return None;
        }
        let walk = &self.frame.walk;
        let pixels = self.centres.hits.len();
        let seen = |beam: usize, pixel: usize| truth.visibility[beam * pixels + pixel] != 0;
        let lit = warn::arrivals(walk.world, self.middles, self.centres, seen);
        let any = warn::arrivals(walk.world, self.middles, self.centres, |_, _| true);
        let gate = &self.settings.gate;
        Some(warn::empty(gate, self.spots, (lit, any), outside))
    }

    /// Returns the result: the image with the light paths' contributions and with the one-bounce
    /// peaks.
    ///
    /// # Errors
    /// Returns [`RenderError::Stopped`] if the render is stopped.
    pub fn finish(
        &self,
        (mut image, splats): (Image, Option<Splats>),
        (truth, seen): (GroundTruth, u64),
        (error, mut rays): (ErrorEstimate, u64),
        (plan, stop): (Plan, Stop),
    ) -> Result<Rendered, RenderError> {
        let (frame, settings) = (&self.frame, self.settings);
        let (walk, film) = (&frame.walk, frame.film);
        if let Some(splats) = &splats {
            splats.join(frame, &mut image, stop)?;
        }
        let mut overflow = Overflow {
            energy: image.overflow,
            share: 0.0,
        };
        if settings.one_bounce && walk.max_bounces >= 1 {
            let mut stack = walk.world.bvh.stack();
            let peaks = one_bounce::peaks(walk.world, &mut stack, self.sources);
            for peak in &peaks {
                let gate = &settings.gate;
                if !one_bounce::add(peak, gate, &mut image.transient) {
                    overflow.energy += f64::from(peak.value);
                }
                for &channel in &film.of_spot[peak.spot] {
                    one_bounce::add(peak, gate, &mut image.groups[usize::from(channel) - 1]);
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
        let outside = self.is_dark || overflow.energy > 0.0;
        let dark = self.dark(&truth, inside, outside);
        let mut warnings = warn::beams(self.spots);
        warnings.extend(dark.clone());
        warnings.extend(warn::tails(&error));
        Ok(Rendered {
            dark,
            warnings,
            width: frame.width,
            height: frame.height,
            gate: settings.gate,
            transient: image.transient,
            split: image.split.map(|s| Split {
                two: s.two,
                two_se: s.two_se,
                two_noise: s.two_noise,
                multi: s.multi,
                multi_se: s.multi_se,
                multi_noise: s.multi_noise,
            }),
            groups: image.groups,
            truth,
            spots: self.spots.to_vec(),
            overflow,
            error,
            plan,
            rays: rays + seen,
        })
    }
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
    if !(1e-6..=1.0).contains(&settings.fill_factor) {
        return bad(
            "fill_factor",
            format!(
                "is {}, expected a share of a pixel's area, 0.000001 to 1",
                settings.fill_factor
            ),
        );
    }
    if g.bins == 0 || g.bins > 1 << 20 {
        return bad("gate.bins", format!("is {}, expected 1 to 1048576", g.bins));
    }
    if settings
        .strategy
        .path_reuse
        .is_some_and(|s| !(1..=32).contains(&s))
    {
        return bad(
            "strategy.path_reuse",
            "expected a tile of 1 to 32 pixels a side".into(),
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
