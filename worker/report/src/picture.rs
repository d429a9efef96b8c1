//! Example pictures: the measurement, the truth, and a network's prediction.

use base64::{Engine, engine::general_purpose::STANDARD};
use serde::{Deserialize, Deserializer, Serialize, Serializer, de::Error};

use picofarm_model::{
    Model, ModelError, answers,
    input::{Target, intensity},
    metric::{Metrics, Tally},
    scene::Scenes,
};

/// The values of an image, row by row from the top left.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "Written")]
pub struct Plane {
    width: usize,
    height: usize,
    #[serde(serialize_with = "write")]
    values: Vec<f32>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Written {
    width: usize,
    height: usize,
    #[serde(deserialize_with = "read")]
    values: Vec<f32>,
}

/// An example.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Picture {
    /// The scene, and the spot if the network is queried spot by spot.
    pub label: String,
    /// The visible scene: the histogram's sum over time, 0..1.
    pub intensity: Plane,
    /// The truth: z-depth in metres, or a mask of 0 and 1.
    pub truth: Plane,
    /// The prediction: z-depth in metres, or the probability of 1.
    pub said: Plane,
    /// The metrics of this example.
    pub metrics: Metrics,
}

impl Plane {
    /// Creates an image of a given size.
    ///
    /// # Errors
    /// [`ModelError::Invalid`] if the number of values is not width · height, or is 0.
    pub fn new(width: usize, height: usize, values: Vec<f32>) -> Result<Self, ModelError> {
        if values.is_empty() || width.checked_mul(height) != Some(values.len()) {
            let what = format!(
                "{} values, {width}×{height} expected, at least one",
                values.len()
            );
            return Err(ModelError::invalid("report.plane", what));
        }
        Ok(Self {
            width,
            height,
            values,
        })
    }

    /// Returns the number of columns.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Returns the number of rows.
    pub fn height(&self) -> usize {
        self.height
    }

    /// Returns the values.
    pub fn values(&self) -> &[f32] {
        &self.values
    }
}

impl TryFrom<Written> for Plane {
    type Error = ModelError;

    fn try_from(w: Written) -> Result<Self, ModelError> {
        Self::new(w.width, w.height, w.values)
    }
}

/// Writes the values as base64 of little-endian bytes: short, exact, and able to represent NaN.
fn write<S: Serializer>(values: &[f32], to: S) -> Result<S::Ok, S::Error> {
    let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
    to.serialize_str(&STANDARD.encode(bytes))
}

fn read<'de, D: Deserializer<'de>>(from: D) -> Result<Vec<f32>, D::Error> {
    let text = String::deserialize(from)?;
    let bytes = STANDARD.decode(text).map_err(D::Error::custom)?;
    let (values, rest) = bytes.as_chunks::<4>();
    if !rest.is_empty() {
        return Err(D::Error::custom("a plane's bytes are no multiple of 4"));
    }
    Ok(values.iter().map(|b| f32::from_le_bytes(*b)).collect())
}

/// Returns example pictures of a model for the scenes with these indices. For a shadow network,
/// there is one for each of the first `spots` spots.
///
/// # Errors
/// [`ModelError::Scene`], [`ModelError::Invalid`] for scenes that do not exist or do not fit the
/// model.
pub fn pictures(
    model: &Model,
    scenes: &dyn Scenes,
    indices: &[usize],
    spots: usize,
) -> Result<Vec<Picture>, ModelError> {
    let question = model.question();
    let (target, scale) = (question.target, question.depth_scale_m);
    let mut out = Vec::new();
    for index in indices.iter().copied() {
        if index >= scenes.len() {
            let what = format!("there is no scene {index}, only {}", scenes.len());
            return Err(ModelError::invalid("report.scenes", what));
        }
        let scene = scenes.load(index).map_err(|source| ModelError::Scene {
            scene: index,
            source,
        })?;
        let (pixels, mut seen) = (scene.pixels(), vec![0.0; scene.pixels()]);
        intensity(&scene, &mut seen);
        let plane = |values: Vec<f32>| Plane::new(scene.width, scene.height, values);
        let mut planes = Vec::new();
        answers(model, &scene, &mut |said, batch| {
            let both = said
                .chunks_exact(pixels)
                .zip(batch.target.chunks_exact(pixels));
            let wanted = if target == Target::Shadow { spots } else { 1 };
            planes.extend(
                both.take(wanted - planes.len().min(wanted))
                    .map(|(s, t)| (s.to_vec(), t.to_vec())),
            );
        })?;
        for (spot, (said, truth)) in planes.into_iter().enumerate() {
            let mut tally = Tally::default();
            tally.add(question, &said, &truth, [scene.height, scene.width]);
            let label = match target {
                Target::Shadow => format!("scene {index}, spot {spot}"),
                Target::Tof | Target::Specular => format!("scene {index}"),
            };
            let (said, truth) = match target {
                Target::Tof => (metres(&said, scale), metres(&truth, scale)),
                Target::Shadow | Target::Specular => {
                    (said.iter().map(probability).collect(), truth)
                }
            };
            out.push(Picture {
                label,
                intensity: plane(seen.clone())?,
                truth: plane(truth)?,
                said: plane(said)?,
                metrics: tally.metrics(target),
            });
        }
    }
    Ok(out)
}

fn metres(scaled: &[f32], scale_m: f32) -> Vec<f32> {
    scaled.iter().map(|z| z * scale_m).collect()
}

fn probability(logit: &f32) -> f32 {
    1.0 / (1.0 + libm::expf(-logit))
}
