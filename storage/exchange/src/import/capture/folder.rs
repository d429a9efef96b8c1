//! Captures in folders: data sets of one scene, in the form of a single render.

use std::path::Path;

use picofarm_dataset::{
    Dataset, DatasetSpec, ENCODER_VERSION, Profile, Provenance, Quantity, SceneRecord,
    SingleRender, SingleRenderParts, Spot, SubsetRecord, Subsets, Wavelength, photon_scale,
    write_single_render,
};
use picofarm_store::StorageError;
use rayon::prelude::*;
use serde_json::{Map, Value, json};
use sha2::{Digest, Sha256};

use super::super::IMPORT_VERSION;
use super::super::scene::direction;
use super::super::vector::norm;
use super::{Beam, Capture, Origin};

/// Attribute that captures have and renders lack.
const CAPTURE: &str = "capture";
/// Attribute with the directions of beams whose spots are not known.
const DIRECTIONS: &str = "directions";
/// Camera-to-world matrix: the world has x to the right, y upwards and z against the view, as glTF
/// has it, so that meshes stand upright in viewers.
const POSE: [[f32; 4]; 4] = [
    [1.0, 0.0, 0.0, 0.0],
    [0.0, -1.0, 0.0, 0.0],
    [0.0, 0.0, -1.0, 0.0],
    [0.0, 0.0, 0.0, 1.0],
];
/// Photons in the median pixel's brightest bin, if the values are no counts.
const PEAK_PHOTONS: f32 = 400.0;

/// Most counts in a bin that 16 bits hold.
const MOST_COUNTS: f32 = 65_534.0;

/// From the camera's axes to the world's, and back.
fn turned([x, y, z]: [f32; 3]) -> [f32; 3] {
    // Adding 0 turns -0 into 0.
    [x, 0.0 - y, 0.0 - z]
}

/// Returns whether a folder of a single render has these attributes because it is a capture.
pub fn is_capture(attributes: &Map<String, Value>) -> bool {
    attributes.contains_key(CAPTURE)
}

impl Capture {
    /// Writes the capture to the new folder `dir`, with this picture as PNG, completely or not at
    /// all.
    ///
    /// # Errors
    /// [`StorageError::Invalid`] for values that no data set can store, and if `dir` exists and is
    /// not empty; [`StorageError::Io`]; [`StorageError::Store`].
    pub async fn write(&self, dir: &Path, picture: &[u8]) -> Result<(), StorageError> {
        let spec = DatasetSpec {
            scenes: 1,
            height: self.height,
            width: self.width,
            spots: self.beams.len() as u32,
            subsets: Subsets::NONE,
            per_spot: self.per_spot.is_some(),
            wavelengths_nm: Wavelength::NONE,
            two_bounce: false,
            gate: self.gate,
            profile: self.profile(),
        };
        spec.check()?;
        let attributes = self.attributes();
        let parts = SingleRenderParts {
            arrays: &[],
            attributes: &attributes,
            picture,
        };
        write_single_render(dir, &spec, |dataset| self.encode(dataset), &parts).await
    }

    /// Whether all values are whole numbers: counts of photons.
    fn counted(&self) -> bool {
        let whole = |all: &[f32]| all.par_iter().all(|x| x.fract() == 0.0);
        whole(&self.sum) && self.per_spot.as_deref().is_none_or(whole)
    }

    /// Counts are stored as such, which names their unit; light in other units bit for bit, and so
    /// are counts beyond 16 bits.
    fn profile(&self) -> Profile {
        // The sum has the greatest counts.
        match self.counted() && self.sum.par_iter().all(|x| *x <= MOST_COUNTS) {
            true => Profile::CountsU16,
            false => Profile::LOSSLESS,
        }
    }

    /// Names of the quantities that the capture does not have.
    fn missing(&self) -> Vec<&'static str> {
        let mut missing = vec![
            "specular",
            "normal",
            "instance",
            "label",
            "rgb",
            "camera",
            "visibility",
            "spots.normal",
        ];
        if self.depth.is_none() {
            missing.extend(["depth", "range"]);
        }
        if self.beams.iter().any(|b| matches!(b, Beam::Direction(_))) {
            missing.extend(["spots", "spots.path"]);
        }
        missing
    }

    fn attributes(&self) -> Map<String, Value> {
        let i = self.intrinsics;
        let spot = |beam: &Beam| match beam {
            Beam::Spot { position, path_m } => {
                let way: [f32; 3] = std::array::from_fn(|k| position[k] - self.laser[k]);
                let length = norm(way.map(f64::from)).max(f64::MIN_POSITIVE) as f32;
                json!({
                    "point": turned(*position), "normal": [0.0, 0.0, 0.0], "arriving": turned(way.map(|x| x / length)),
                    "path_m": path_m, "object": 0, "material": 0,
                })
            }
            Beam::Direction(_) | Beam::Nothing => Value::Null,
        };
        let towards = |beam: &Beam| match beam {
            Beam::Direction(way) => json!(turned(*way)),
            Beam::Spot { .. } | Beam::Nothing => Value::Null,
        };
        let attributes = json!({
            "scene": self.name,
            "value": match self.counted() {
                true => "photons: counted in each bin, as in the files",
                false => "as in the files: photons or energy in each bin",
            },
            "gate": self.gate,
            "camera": {
                "intrinsics": {
                    "fx": i.fx, "fy": i.fy, "cx": i.cx, "cy": i.cy, "width": self.width, "height": self.height,
                },
                "origin": [0, 0, 0], "right": [1, 0, 0], "down": [0, -1, 0], "forward": [0, 0, -1],
            },
            "laser_origin": turned(self.laser),
            "spots": self.beams.iter().map(spot).collect::<Vec<_>>(),
            DIRECTIONS: self.beams.iter().map(towards).collect::<Vec<_>>(),
            CAPTURE: {
                "format": self.origin.format,
                "files": self.origin.files,
                "conversions": self.origin.conversions,
                "outside": self.origin.outside,
                "cropped": self.origin.cropped,
                "missing": self.missing(),
            },
        });
        match attributes {
            Value::Object(attributes) => attributes,
            _ => unreachable!("written as an object"),
        }
    }

    fn encode(&self, dataset: &Dataset) -> Result<picofarm_dataset::EncodedScene, StorageError> {
        let (pixels, spots) = (self.pixels(), self.beams.len());
        let none = vec![0.0; pixels];
        let depth = self.depth.as_ref().unwrap_or(&none);
        let width = self.width as usize;
        let range: Vec<f32> = depth
            .iter()
            .enumerate()
            .map(|(p, z)| z * norm(direction(self.intrinsics, p / width, p % width)) as f32)
            .collect();
        let placed = |beam: &Beam| match beam {
            Beam::Spot { position, path_m } => Some(Spot {
                position: *position,
                normal: [0.0; 3],
                path_m: *path_m,
            }),
            Beam::Direction(_) | Beam::Nothing => None,
        };
        let placed: Vec<Option<Spot>> = self.beams.iter().map(placed).collect();
        let len = pixels * self.gate.bins as usize;
        let subsets: Vec<SubsetRecord<'_>> = self
            .per_spot
            .iter()
            .map(|all| SubsetRecord {
                quantity: Quantity::TransientSpots,
                planes: all.chunks_exact(len).collect(),
            })
            .collect();
        let scale = match self.counted() {
            true => 1.0,
            false => photon_scale(&self.sum, self.gate.bins as usize, PEAK_PHOTONS),
        };
        let record = SceneRecord {
            transient: &self.sum,
            subsets: &subsets,
            depth,
            range: &range,
            normal: &vec![0.0; pixels * 3],
            instance: &vec![0; pixels],
            label: &vec![0; pixels],
            specular: &vec![0; pixels],
            visibility: &vec![0; pixels * spots],
            two_bounce: &[],
            rgb: &vec![0.0; pixels * 3],
            spots: &placed,
            intrinsics: self.intrinsics,
            camera: POSE,
            laser: self.laser,
            scale,
        };
        let plan = json!({
            "kind": "import", "format": self.origin.format, "scene": self.name,
            "files": self.origin.files, "conversions": self.origin.conversions,
            "missing": self.missing(), "check": Value::Null,
        });
        let made_from = json!([IMPORT_VERSION, ENCODER_VERSION, plan, self.attributes()]);
        let provenance = Provenance {
            task_key: hex::encode(Sha256::digest(made_from.to_string())),
            renderer: format!("{IMPORT_VERSION}/{ENCODER_VERSION}"),
            seed: 0,
            plan,
        };
        dataset.encode(0, &record, &provenance)
    }

    /// Reads the capture in a folder that [`Self::write`], `picofarm capture import` or
    /// `picofarm scene render` wrote. Blocks its thread while decoding on rayon's threads.
    ///
    /// # Errors
    /// [`StorageError::Io`] without such a folder, [`StorageError::Invalid`] for metadata that
    /// cannot be read, [`StorageError::Damaged`].
    pub async fn read(dir: &Path) -> Result<Self, StorageError> {
        let single = SingleRender::open(dir).await?;
        let (dataset, attributes) = (&single.dataset, single.group.attributes());
        let spec = *dataset.spec();
        let manifest = dataset.manifest(0).await?;
        let missing = manifest.missing();
        let has = |name: &str| !missing.iter().any(|m| m == name);
        let spots = dataset.read_spots(0).await?;
        let directions: Vec<Option<[f32; 3]>> = match attributes.get(DIRECTIONS) {
            None => vec![None; spots.len()],
            Some(value) => serde_json::from_value(value.clone()).map_err(|e| {
                let file = dir.join("render/zarr.json");
                StorageError::invalid(
                    format!("{}: attributes.{DIRECTIONS}", file.display()),
                    format!("expected null or three numbers for each beam: {e}"),
                )
            })?,
        };
        let beams = spots.iter().enumerate().map(|(k, spot)| match spot {
            Some(s) => Beam::Spot {
                position: s.position,
                path_m: s.path_m,
            },
            None => match directions.get(k).copied().flatten() {
                Some(way) => Beam::Direction(turned(way)),
                None => Beam::Nothing,
            },
        });
        let laser = dataset.read::<f32>(0, Quantity::Laser).await?;
        let depth = match has("depth") {
            true => Some(dataset.read::<f32>(0, Quantity::Depth).await?),
            false => None,
        };
        let per_spot = match spec.per_spot {
            true => Some(dataset.read_histogram(0, Quantity::TransientSpots).await?),
            false => None,
        };
        let about = &attributes.get(CAPTURE).cloned().unwrap_or(Value::Null);
        let text = |name: &str| about[name].as_str().map(str::to_owned);
        let list = about["conversions"].as_array().into_iter().flatten();
        let name = attributes.get("scene").and_then(Value::as_str);
        Ok(Self {
            name: name.unwrap_or_default().to_owned(),
            height: spec.height,
            width: spec.width,
            gate: spec.gate,
            sum: dataset.read_transient(0).await?,
            per_spot,
            intrinsics: dataset.read_intrinsics(0).await?,
            laser: [laser[0], laser[1], laser[2]],
            beams: beams.collect(),
            depth,
            origin: Origin {
                format: text("format").unwrap_or_else(|| "picofarm".into()),
                files: serde_json::from_value(about["files"].clone()).unwrap_or_default(),
                conversions: list.filter_map(Value::as_str).map(str::to_owned).collect(),
                outside: about["outside"].as_f64().unwrap_or(0.0),
                cropped: about["cropped"].as_f64().unwrap_or(0.0),
            },
        })
    }
}
