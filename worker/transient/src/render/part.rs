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
        sources::Sources, splats::Splats, watch::Watch,
    },
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
        let at = |i: u32| tiles * i as usize / self.of as usize;
        at(self.index)..at(self.index + 1)
    }
}

/// A rendered part: the input of [`join_parts`] without the scene. It is only valid for the scene
/// and the settings that it was rendered with.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Part {
    which: PartOf,
    shape: Shape,
    found: Found,
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
struct Shape {
    width: u32,
    height: u32,
    bins: u32,
    channels: u32,
    split: bool,
    passes: u32,
    seed: u64,
}

impl Shape {
    fn of(ready: &Ready) -> Self {
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
enum Found {
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
/// Returns the errors of [`crate::render::driver`], and [`RenderError::Invalid`] if the budget is not a
/// number of samples or the part does not exist.
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
    prepare(scene, settings, Stop(progress), |ready| {
        let frame = &ready.frame;
        let shape = Shape::of(ready);
        let watch = Watch::new(progress, 0.0, 1.0);
        let (found, rays) = if index < of {
            let mut image = Image::new(frame)?;
            let range = which.range(image.tiles());
            let rays = image.round(frame, range.clone(), Round::only(shape.passes), &watch)?;
            (Found::Tiles(image.take(range)), rays)
        } else if let Some(sources) = Sources::of(frame) {
            let mut splats = Splats::new(frame);
            let passes = ready.splat_passes(shape.passes);
            let rays = splats.round((frame, &sources), passes, &watch)?;
            (Found::Paths(Some(splats)), rays)
        } else {
            (Found::Paths(None), 0)
        };
        Ok(Part {
            which,
            shape,
            found,
            rays,
        })
    })
}

/// Joins all parts of a scene, in any order, into the result of [`crate::render::driver`], bit for bit.
/// Runs on the caller's rayon pool.
///
/// # Errors
/// Returns the errors of [`crate::render::driver`], and [`RenderError::Invalid`] naming a part that is
/// missing, duplicated, or from another scene or other settings.
pub fn join_parts(
    scene: &Scene,
    settings: &Settings,
    parts: impl IntoIterator<Item = Part>,
    progress: &dyn Progress,
) -> Result<Rendered, RenderError> {
    divisible(settings)?;
    prepare(scene, settings, Stop(progress), |ready| {
        let (frame, stop) = (&ready.frame, Stop(progress));
        let mut image = Image::new(frame)?;
        let seen = ready.seen(stop)?;
        let shape = Shape::of(ready);
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
                Found::Tiles(slice) if index < of => {
                    image.put(part.which.range(image.tiles()), &slice)
                }
                Found::Paths(None) if index == of => Sources::of(frame).is_none(),
                Found::Paths(Some(found)) if index == of => {
                    let fits = Sources::of(frame).is_some() && found.fits(frame);
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
    })
}
