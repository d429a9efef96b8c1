//! A render group as a capture, with its truth where the group holds it.

use std::path::Path;

use picofarm_dataset::RenderGroup;
use picofarm_demultiplex::{Capture, Place, Spot, Truth};
use picofarm_scene::{self as scene, Camera, Vec3};
use picofarm_store::StorageError;
use picofarm_transient::Gate;
use serde::de::DeserializeOwned;
use serde_json::{Map, Value};

use crate::{
    args::PlacesArg,
    error::{CliError, Code, Result},
};

/// One flash with its calibration and, if the render has it, its ground truth.
pub struct Flash {
    pub attributes: Map<String, Value>,
    pub histogram: Vec<f32>,
    pub gate: Gate,
    pub camera: Camera,
    pub laser: Vec3,
    pub spots: Vec<Spot>,
    /// Index of each spot's beam: beams that meet nothing have none.
    pub beams: Vec<usize>,
    depth: Option<Vec<f32>>,
    specular: Vec<u8>,
    visibility: Vec<u8>,
}

impl Flash {
    /// Reads a group.
    ///
    /// # Errors
    /// No such group, one without histogram or calibration, or damage.
    pub fn read(folder: &Path, places: PlacesArg) -> Result<Self> {
        let group = RenderGroup::open(folder).map_err(|e| unreadable(folder, e))?;
        let attributes = group.attributes().clone();
        let gate: Gate = attribute(folder, &attributes, "gate")?;
        let camera: Camera = attribute(folder, &attributes, "camera")?;
        let laser: Vec3 = attribute(folder, &attributes, "laser_origin")?;
        let all: Vec<Option<scene::Spot>> = attribute(folder, &attributes, "spots")?;
        let i = &camera.intrinsics;
        let image = [u64::from(i.height), u64::from(i.width)];
        let cube = [image[0], image[1], u64::from(gate.bins)];
        let histogram = histogram(folder, &group, &cube)?;
        let floats = |name: &str, shape: &[u64]| -> Result<Option<Vec<f32>>> {
            match group.has(name) {
                true => Ok(Some(array::<f32>(folder, &group, name, shape)?)),
                false => Ok(None),
            }
        };
        let depth = floats("depth", &image)?;
        let bits = |all: Option<Vec<f32>>| -> Vec<u8> {
            let all = all.unwrap_or_default();
            all.into_iter().map(|x| u8::from(x != 0.0)).collect()
        };
        let specular = bits(floats("specular", &image)?);
        let by_beam = [all.len() as u64, image[0], image[1]];
        let visibility = bits(floats("visibility", &by_beam)?);
        let pixels = (image[0] * image[1]) as usize;
        let beams: Vec<usize> = (0..all.len()).filter(|k| all[*k].is_some()).collect();
        let visibility = match visibility.is_empty() {
            true => visibility,
            false => beams
                .iter()
                .flat_map(|k| visibility[k * pixels..][..pixels].iter().copied())
                .collect(),
        };
        let spots = all
            .iter()
            .flatten()
            .map(|s| {
                let way = s.point - laser;
                // A mirror folds the beam: where it left the laser is not in the group, so its
                // place stays as given.
                let folded = s.path_m - way.length() > 1e-3 * s.path_m;
                let known = places == PlacesArg::Given || folded;
                Spot {
                    direction: way,
                    place: known.then_some(Place {
                        point: s.point,
                        path_m: s.path_m,
                    }),
                }
            })
            .collect();
        Ok(Self {
            attributes,
            histogram,
            gate,
            camera,
            laser,
            spots,
            beams,
            depth,
            specular,
            visibility,
        })
    }

    /// The histogram and its calibration.
    pub fn capture(&self) -> Capture<'_> {
        Capture {
            histogram: &self.histogram,
            gate: self.gate,
            camera: &self.camera,
            laser: self.laser,
            spots: &self.spots,
        }
    }

    /// What it is compared with, where the group holds it.
    pub fn truth(&self) -> Option<Truth<'_>> {
        Some(Truth {
            depth_m: self.depth.as_deref()?,
            specular: &self.specular,
            visibility: &self.visibility,
        })
    }
}

/// The histogram of all spots: of a render, or of a sensor.
fn histogram(folder: &Path, group: &RenderGroup, shape: &[u64]) -> Result<Vec<f32>> {
    if let Some(name) = ["transient", "rate"].into_iter().find(|n| group.has(n)) {
        return array::<f32>(folder, group, name, shape);
    }
    if !group.has("counts") {
        let what = format!(
            "{}: has no array transient, rate or counts",
            folder.display()
        );
        return Err(CliError::input(what).hint(HINT));
    }
    // Counts are stored in the narrowest type that holds them.
    if let Ok(counts) = array::<u16>(folder, group, "counts", shape) {
        return Ok(counts.into_iter().map(f32::from).collect());
    }
    let counts = array::<u32>(folder, group, "counts", shape)?;
    Ok(counts.into_iter().map(|c| c as f32).collect())
}

const HINT: &str = "expected a folder that `picofarm scene render FILE --out FOLDER` or `picofarm scene sense` wrote";

fn array<T: picofarm_dataset::Stored + Send + Sync>(
    folder: &Path,
    group: &RenderGroup,
    name: &str,
    expected: &[u64],
) -> Result<Vec<T>> {
    let (shape, values) = group.read(name).map_err(|e| unreadable(folder, e))?;
    if shape != expected {
        let what = format!(
            "{}/{name}: has the shape {shape:?}, but camera, gate and spots say {expected:?}",
            folder.display()
        );
        return Err(CliError::input(what).hint("render the scene again"));
    }
    Ok(values)
}

fn unreadable(folder: &Path, error: StorageError) -> CliError {
    let code = match &error {
        StorageError::Codec { .. } => Code::Damaged,
        _ => Code::Input,
    };
    CliError::new(code, format!("{}: {error}", folder.display())).hint(HINT)
}

fn attribute<T: DeserializeOwned>(
    folder: &Path,
    attributes: &Map<String, Value>,
    name: &str,
) -> Result<T> {
    let value = attributes.get(name).cloned().unwrap_or(Value::Null);
    serde_json::from_value(value).map_err(|e| {
        let what = format!("{}/zarr.json: attributes.{name}: {e}", folder.display());
        CliError::input(what).hint(HINT)
    })
}
