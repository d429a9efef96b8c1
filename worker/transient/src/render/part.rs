//! A render in parts, so that several machines can share one heavy scene.
//!
//! The image's tiles are divided into ranges, which are independent of each other. Light paths that
//! are drawn into the image cross tiles and are a separate part. The joined parts give the same
//! bits as one machine: every sum over tiles is computed in their order, whichever machine rendered
//! them.
//!
//! Only [`Budget::Samples`] is supported, because the passes for an error target are decided over
//! the whole image after each round.

use std::ops::Range;

use picofarm_scene::Scene;
use serde::{Deserialize, Serialize};

use crate::{
    api::{Budget, Progress, RenderError, Rendered, Settings, Stop},
    render::{
        image::Image, prepare::prepare, ready::Ready, rounds::Round, slice::Slice,
        sources::Sources, splats::Splats, watch::RoundProgress,
    },
    tuning::Tuning,
};

/// The maximum number of tile ranges.
const MAX_RANGES: u32 = 4096;

/// A part of a render: one of `of` ranges of tiles, or the light paths, which come after them at
/// index `of`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct PartOf {
    /// Index, 0 to `of`.
    pub index: u32,
    /// The number of tile ranges, 1 to 4096. If there are more ranges than tiles, some are empty.
    pub of: u32,
}

impl PartOf {
    /// Returns all parts of a render with tiles divided into `of` ranges: one more than `of`.
    pub fn all(of: u32) -> impl Iterator<Item = Self> {
        (0..=of).map(move |index| Self { index, of })
    }

    fn range(self, tiles: usize) -> Range<usize> {
        let first_tile = |i: u32| tiles * i as usize / self.of as usize;
        first_tile(self.index)..first_tile(self.index + 1)
    }
}

/// A rendered part: the input of [`join_parts`] without the scene. It is only valid for the scene
/// and the settings that it was rendered with.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Part {
    which: PartOf,
    shape: PartShape,
    found: PartContent,
    rays: u64,
}

impl Part {
    /// Returns which part this is.
    pub fn which(&self) -> PartOf {
        self.which
    }

    /// Returns the rays traced for the part, excluding those that prepare the scene.
    pub fn rays(&self) -> u64 {
        self.rays
    }
}

/// Values that must be equal in all parts of a render.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
struct PartShape {
    width: u32,
    height: u32,
    bins: u32,
    channels: u32,
    split: bool,
    passes: u32,
    seed: u64,
}

impl PartShape {
    fn new(ready: &Ready) -> Self {
        let frame = &ready.frame;
        Self {
            width: frame.width,
            height: frame.height,
            bins: frame.film.gate.bins,
            channels: frame.film.channels as u32,
            split: frame.split,
            passes: ready.first_passes(),
            seed: frame.seed,
        }
    }
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
enum PartContent {
    Tiles(Slice),
    /// `None` if the scene needs no light paths.
    Paths(Option<Splats>),
}

fn wrong(field: &str, what: String) -> RenderError {
    RenderError::Invalid {
        field: field.into(),
        what,
    }
}

fn divisible(settings: &Settings) -> Result<(), RenderError> {
    match settings.budget {
        Budget::Samples(_) => Ok(()),
        Budget::Error(_) => Err(wrong(
            "budget.error",
            "is decided over the whole image; a render in parts needs samples".into(),
        )),
    }
}

/// Renders one part of a scene. Runs on the caller's rayon pool.
///
/// # Errors
/// Returns the errors of [`render`](crate::render()), and [`RenderError::Invalid`] if the budget is
/// not a number of samples or the part does not exist.
pub fn render_part(
    scene: &Scene,
    settings: &Settings,
    which: PartOf,
    progress: &dyn Progress,
) -> Result<Part, RenderError> {
    divisible(settings)?;
    let PartOf { index, of } = which;
    if !(1..=MAX_RANGES).contains(&of) || index > of {
        let what = format!(
            "{index} of {of}: expected 1 to {MAX_RANGES} ranges, and a part up to that number"
        );
        return Err(wrong("part", what));
    }
    prepare(
        scene,
        settings,
        &Tuning::default(),
        Stop(progress),
        |ready| {
            let frame = &ready.frame;
            let shape = PartShape::new(ready);
            let watch = RoundProgress::new(progress, 0.0, 1.0);
            let (found, rays) = if index < of {
                let mut image = Image::new(frame)?;
                let range = which.range(image.tiles());
                let rays = image.round(frame, range.clone(), Round::only(shape.passes), &watch)?;
                (PartContent::Tiles(image.take(range)), rays)
            } else if let Some(sources) = Sources::new(frame) {
                let mut splats = Splats::new(frame);
                let passes = ready.splat_passes(shape.passes);
                let rays = splats.round((frame, &sources), passes, &watch)?;
                (PartContent::Paths(Some(splats)), rays)
            } else {
                (PartContent::Paths(None), 0)
            };
            Ok(Part {
                which,
                shape,
                found,
                rays,
            })
        },
    )
}

/// Joins all parts of a scene, in any order, into the result of [`render`](crate::render()), bit
/// for bit. Runs on the caller's rayon pool.
///
/// # Errors
/// Returns the errors of [`render`](crate::render()), and [`RenderError::Invalid`] naming a part
/// that is missing, duplicated, or from another scene or other settings.
///
/// # Examples
/// ```
/// # use picofarm_scene::primitive::{PrimitiveSettings, generate};
/// # use picofarm_transient::*;
/// # struct Quiet;
/// # impl Progress for Quiet {
/// #     fn at(&self, _: f32) -> bool {
/// #         true
/// #     }
/// # }
/// # let room = PrimitiveSettings { width: 8, height: 8, ..PrimitiveSettings::default() };
/// # let scene = generate(3, &room)?;
/// # let gate = Gate { start_m: 0.0, bin_width_m: 0.5, bins: 64 };
/// let settings = Settings::new(gate, Budget::Samples(2));
/// let parts: Result<Vec<Part>, RenderError> = PartOf::all(2)
///     .map(|which| render_part(&scene, &settings, which, &Quiet))
///     .collect();
/// let joined = join_parts(&scene, &settings, parts?, &Quiet)?;
/// assert_eq!(joined.transient, render(&scene, &settings, &Quiet)?.transient);
/// # Ok::<(), picofarm_transient::RenderError>(())
/// ```
pub fn join_parts(
    scene: &Scene,
    settings: &Settings,
    parts: impl IntoIterator<Item = Part>,
    progress: &dyn Progress,
) -> Result<Rendered, RenderError> {
    divisible(settings)?;
    prepare(
        scene,
        settings,
        &Tuning::default(),
        Stop(progress),
        |ready| {
            let (frame, stop) = (&ready.frame, Stop(progress));
            let mut image = Image::new(frame)?;
            let seen = ready.seen(stop)?;
            let shape = PartShape::new(ready);
            let (mut splats, mut rays) = (None, 0);
            let mut there: Vec<bool> = vec![];
            for part in parts {
                let PartOf { index, of } = part.which;
                let name = format!("parts[{index}]");
                if there.is_empty() && (1..=MAX_RANGES).contains(&of) {
                    there = vec![false; of as usize + 1];
                }
                if part.shape != shape || there.len() != of as usize + 1 || index > of {
                    let what =
                        "is of another scene, other settings or another division; render it again";
                    return Err(wrong(&name, what.into()));
                }
                if std::mem::replace(&mut there[index as usize], true) {
                    return Err(wrong(&name, "is there twice".into()));
                }
                let taken = match part.found {
                    PartContent::Tiles(slice) if index < of => {
                        image.put(part.which.range(image.tiles()), &slice)
                    }
                    PartContent::Paths(None) if index == of => Sources::new(frame).is_none(),
                    PartContent::Paths(Some(found)) if index == of => {
                        let fits = Sources::new(frame).is_some() && found.fits(frame);
                        splats = Some(found);
                        fits
                    }
                    _ => false,
                };
                if !taken {
                    let what = "does not hold what this part of the scene holds; render it again";
                    return Err(wrong(&name, what.into()));
                }
                rays += part.rays;
                if !progress.at(index as f32 / (of + 1) as f32) {
                    return Err(RenderError::Stopped);
                }
            }
            if let Some(missing) = there.iter().position(|&t| !t) {
                return Err(wrong(&format!("parts[{missing}]"), "is missing".into()));
            }
            if there.is_empty() {
                return Err(wrong("parts", "there are none; render them first".into()));
            }
            image.total();
            let errors = match &splats {
                None => image.errors(),
                Some(splats) => splats.errors(frame, &image, stop)?,
            };
            let error = errors.estimate();
            let plan = ready.plan(shape.passes);
            ready.finish((image, splats), seen, (error, rays), (plan, stop))
        },
    )
}
