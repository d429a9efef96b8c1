//! Visits to scenes, and batches of examples.

use burn::tensor::{Device, Int, Tensor, TensorData};

use super::{EvidenceForm, Question, ShadowVariant, Target, intensity, merged, planes, planes_of};
use crate::{ModelError, net::Input, scene::Scene};

/// The parameters of one visit to a scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Visit {
    /// The spot in question, if a network is queried spot by spot.
    pub spot: usize,
    /// Whether left and right are exchanged.
    pub flip_columns: bool,
    /// Whether top and bottom are exchanged.
    pub flip_rows: bool,
}

/// Inputs and true outputs of a network: (N, channels, H, W) each.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Batch {
    /// The number of scenes.
    pub images: usize,
    /// The number of rows.
    pub height: usize,
    /// The number of columns.
    pub width: usize,
    /// The dense channels.
    pub dense: Vec<f32>,
    /// The bins of the one-hot channels, -1 = none; empty if the network has no such channels.
    pub one_hot: Vec<i32>,
    /// The true outputs of the network.
    pub target: Vec<f32>,
}

/// Adds a visit to a batch. Leftover contents of an empty batch are overwritten.
///
/// # Errors
/// [`ModelError::Invalid`] if the scene's size differs from the batch's, or the scene lacks data
/// that the question requires.
pub fn example(
    batch: &mut Batch,
    question: &Question,
    scene: &Scene,
    visit: Visit,
) -> Result<(), ModelError> {
    check(batch, question, scene)?;
    add(batch, question, scene, visit, false);
    Ok(())
}

/// Like [`example`], but consumes the scene, so that its histogram can be reused as the batch's
/// buffer and the batch's buffer as the scene's.
///
/// # Errors
/// Those of [`example`].
pub(crate) fn example_of(
    batch: &mut Batch,
    question: &Question,
    scene: &mut Scene,
    visit: Visit,
) -> Result<(), ModelError> {
    check(batch, question, scene)?;
    let nothing_else = question.channels().0 == question.bins
        && !question.intensity_only
        && !question.sees_evidence();
    let ready = batch.images == 0 && nothing_else;
    if ready {
        planes_of(scene, question.bins, question.normalise, &mut batch.dense);
    }
    add(batch, question, scene, visit, ready);
    Ok(())
}

/// Adds a visit that was already checked. If `ready` is set, the histogram's planes are already in
/// the batch.
fn add(batch: &mut Batch, question: &Question, scene: &Scene, visit: Visit, ready: bool) {
    (batch.height, batch.width) = (scene.height, scene.width);
    if batch.images == 0 {
        batch.one_hot.clear();
        batch.target.clear();
    }
    let pixels = scene.pixels();
    let (channels, _, _) = question.channels();
    let at = batch.images * channels * pixels;
    batch.images += 1;
    batch.dense.resize(at + channels * pixels, 0.0);
    let dense = &mut batch.dense[at..];
    let seen = if question.sees_evidence() {
        evidence(
            &scene.evidence[visit.spot * dense.len()..][..dense.len()],
            dense,
            pixels,
        );
        channels
    } else if question.intensity_only {
        intensity(scene, &mut dense[..pixels]);
        1
    } else {
        if !ready {
            let room = &mut dense[..question.bins * pixels];
            planes(scene, question.bins, question.normalise, room);
        }
        question.bins
    };
    if question.by_spot() {
        match question.variant {
            ShadowVariant::Concat | ShadowVariant::Difference => {
                let tof = scene.tof(visit.spot);
                let bins = tof.iter().map(|t| bin(scene, question.bins, *t));
                if question.variant == ShadowVariant::Concat {
                    let from = batch.one_hot.len();
                    batch.one_hot.extend(bins);
                    flip(&mut batch.one_hot[from..], scene.width, visit);
                } else {
                    for (p, bin) in bins.enumerate() {
                        if let Ok(b) = usize::try_from(bin) {
                            let m = &mut dense[b * pixels + p];
                            *m = (1.0 - *m).abs();
                        }
                    }
                }
            }
            ShadowVariant::Index => {
                dense[seen * pixels..].fill(0.0);
                let from = (seen + visit.spot) * pixels;
                dense[from..from + pixels].fill(1.0);
            }
            ShadowVariant::All | ShadowVariant::Evidence => {}
        }
    }
    for plane in dense.chunks_exact_mut(pixels) {
        flip(plane, scene.width, visit);
    }
    let at = batch.target.len();
    match question.target {
        Target::Tof => {
            let scaled = |z: &f32| depth_target(*z, question.depth_scale_m);
            batch.target.extend(scene.depth_m.iter().map(scaled));
        }
        Target::Specular => {
            let mirrors = scene.specular.iter().map(|s| f32::from(*s));
            batch.target.extend(mirrors);
        }
        Target::Shadow => {
            let spots = match question.by_spot() {
                true => visit.spot..visit.spot + 1,
                false => 0..question.spots,
            };
            let lit = &scene.lit[spots.start * pixels..spots.end * pixels];
            batch.target.extend(lit.iter().map(|lit| f32::from(*lit)));
        }
    }
    for plane in batch.target[at..].chunks_exact_mut(pixels) {
        flip(plane, scene.width, visit);
    }
}

/// Decodes the planes of a spot: ranks to −1..1, and the log odds of the last plane.
fn evidence(codes: &[u8], planes: &mut [f32], pixels: usize) {
    let (ranks, odds) = planes.split_at_mut(codes.len() - pixels);
    for (rank, code) in ranks.iter_mut().zip(codes) {
        *rank = f32::from(*code) / 127.5 - 1.0;
    }
    let codes = &codes[ranks.len()..];
    for (odds, code) in odds.iter_mut().zip(codes) {
        *odds = EvidenceForm::log_odds(*code);
    }
}

/// Returns the true output of a depth network: z over the question's scale, limited to 0..1; 1 if
/// no surface is visible.
fn depth_target(z: f32, scale_m: f32) -> f32 {
    let scaled = z / scale_m;
    if scaled.is_finite() {
        scaled.clamp(0.0, 1.0)
    } else {
        1.0
    }
}

/// Returns the bin of a path length, -1 outside the gate.
fn bin(scene: &Scene, bins: usize, path_m: f32) -> i32 {
    let stored = ((f64::from(path_m) - scene.first_m) / scene.bin_width_m).floor();
    if !(stored >= 0.0 && stored < scene.bins as f64) {
        return -1;
    }
    let bin = stored as usize / (scene.bins / bins);
    if bin < bins { bin as i32 } else { -1 }
}

fn flip<T>(plane: &mut [T], width: usize, visit: Visit) {
    if visit.flip_columns {
        plane.chunks_exact_mut(width).for_each(<[T]>::reverse);
    }
    if visit.flip_rows {
        plane.reverse();
        plane.chunks_exact_mut(width).for_each(<[T]>::reverse);
    }
}

fn check(batch: &Batch, question: &Question, scene: &Scene) -> Result<(), ModelError> {
    let pixels = scene.pixels();
    if batch.images > 0 {
        check_size((batch.height, batch.width), (scene.height, scene.width))?;
    }
    let (light, evidence) = match question.sees_evidence() {
        true => (
            scene.histogram.len(),
            question.planes() * question.spots * pixels,
        ),
        false => (pixels * scene.bins, scene.evidence.len()),
    };
    if let Err(what) = merged(scene.bins, question.bins) {
        return Err(ModelError::invalid("input.bins", what));
    }
    let wanted = [
        ("histogram", scene.histogram.len(), light),
        ("evidence", scene.evidence.len(), evidence),
        ("depth", scene.depth_m.len(), pixels),
        (
            "depth by a network",
            scene.seen_depth_m.as_ref().map_or(pixels, Vec::len),
            pixels,
        ),
        (
            "specular mask",
            scene.specular.len(),
            match question.target {
                Target::Specular => pixels,
                _ => scene.specular.len(),
            },
        ),
        (
            "visibility",
            scene.lit.len(),
            match question.target {
                Target::Shadow => pixels * question.spots,
                _ => scene.lit.len(),
            },
        ),
    ];
    let beams = match question.timed() {
        true => question.spots,
        false => scene.beams_m.len(),
    };
    let wanted = wanted
        .into_iter()
        .chain([("beams", scene.beams_m.len(), beams)]);
    for (name, there, needed) in wanted {
        if there != needed {
            let what = format!(
                "a scene's {name} has {there} values, not {needed}; scenes must have the same size and spots"
            );
            return Err(ModelError::invalid("source", what));
        }
    }
    Ok(())
}

impl Batch {
    /// Returns the approximate memory that the batch takes, bytes.
    pub fn bytes(&self) -> usize {
        4 * (self.dense.len() + self.one_hot.len() + self.target.len())
    }

    /// Appends another batch, of `of` images that will be joined in total. Returns the other's
    /// buffers, empty, for reuse.
    ///
    /// # Errors
    /// [`ModelError::Invalid`] if the sizes differ.
    pub(crate) fn join(&mut self, mut other: Self, of: usize) -> Result<Self, ModelError> {
        if self.images == 0 {
            if of == other.images {
                return Ok(std::mem::replace(self, other));
            }
            let room = |values: usize| values / other.images * of;
            self.dense.reserve_exact(room(other.dense.len()));
            self.one_hot.reserve_exact(room(other.one_hot.len()));
            self.target.reserve_exact(room(other.target.len()));
            (self.height, self.width) = (other.height, other.width);
        }
        check_size((self.height, self.width), (other.height, other.width))?;
        self.images += other.images;
        self.dense.extend_from_slice(&other.dense);
        self.one_hot.extend_from_slice(&other.one_hot);
        self.target.extend_from_slice(&other.target);
        other.images = 0;
        Ok(other)
    }

    /// Transfers the batch to a device. Returns the network's input and its true output.
    pub fn into_input(self, device: &Device) -> (Input, Vec<f32>) {
        let (n, h, w) = (self.images, self.height, self.width);
        let channels = self.dense.len() / (n * h * w);
        let dense = TensorData::new(self.dense, [n, channels, h, w]);
        let one_hot = (!self.one_hot.is_empty()).then(|| {
            let bins = TensorData::new(self.one_hot, [n, h, w]);
            Tensor::<3, Int>::from_data(bins, device)
        });
        let input = Input {
            dense: Tensor::from_data(dense, device),
            one_hot,
        };
        (input, self.target)
    }

    /// Like [`Self::into_input`], but leaves the batch in place.
    pub fn input(&self, device: &Device) -> Input {
        let seen = Self {
            target: Vec::new(),
            ..self.clone()
        };
        seen.into_input(device).0
    }
}

fn check_size(one: (usize, usize), other: (usize, usize)) -> Result<(), ModelError> {
    if one == other {
        return Ok(());
    }
    let what = format!(
        "one scene has {}×{} pixels, another {}×{}; a batch needs one size",
        one.0, one.1, other.0, other.1
    );
    Err(ModelError::invalid("source", what))
}
