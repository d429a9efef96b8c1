//! The arrays of a data set: names, shapes, types, codecs and Zarr v3 metadata.

use serde_json::{Value, json};

use crate::coding::profile::Coding;
use crate::layout::quantity::{Element, Quantity};
use crate::layout::spec::DatasetSpec;

/// Side of the transient's inner chunks in pixels (smaller if the image is smaller).
pub const INNER_SIDE: u64 = 32;

/// The layout of one array.
#[derive(Debug, Clone)]
pub struct Layout {
    /// The quantity.
    pub quantity: Quantity,
    /// The type of the stored values.
    pub element: Element,
    /// Shape of one scene, without the scene axis.
    pub shape: Vec<u64>,
    /// Shape of one object, without the scene axis: `shape`, rounded up to whole inner chunks.
    pub object_shape: Vec<u64>,
    /// Shape of the shard's inner chunks, without the scene axis.
    pub inner: Option<Vec<u64>>,
    dimensions: &'static [&'static str],
    /// The shuffle filter of blosc.
    shuffle: &'static str,
    fill_nan: bool,
    attributes: Value,
}

impl Quantity {
    /// Returns the layout of this quantity's array.
    pub(crate) fn layout(self, spec: &DatasetSpec) -> Layout {
        use Element::{F32, I16, U8, U16, U32};
        let (h, w) = (u64::from(spec.height), u64::from(spec.width));
        let (n, b) = (u64::from(spec.spots), u64::from(spec.gate.bins));
        let coding = self.is_transient().then(|| Coding::new(self, spec));
        let coded = || {
            let coding = coding.as_ref().expect("made for every transient");
            (coding.element, coding.attributes.clone())
        };
        const IMAGE: &[&str] = &["scene", "row", "column"];
        let (element, shape, dimensions, attributes): (_, _, &'static [&'static str], _) =
            match self {
                Self::Transient | Self::Transient4 | Self::Transient25 => {
                    let dims = &["scene", "bin", "row", "column"];
                    let (element, attributes) = coded();
                    (element, vec![b, h, w], dims, attributes)
                }
                Self::TransientSpots => {
                    let dims = &["scene", "spot", "bin", "row", "column"];
                    let (element, attributes) = coded();
                    (element, vec![n, b, h, w], dims, attributes)
                }
                Self::Intensity => {
                    let a = json!({"long_name": "sum of the transient over all bins, before coding", "units": "1/(m2 sr)"});
                    (F32, vec![h, w], IMAGE, a)
                }
                Self::Depth => {
                    let a = json!({"long_name": "z-depth; 0 where the ray leaves the scene", "units": "m"});
                    (F32, vec![h, w], IMAGE, a)
                }
                Self::Range => {
                    let a = json!({"long_name": "distance along the ray; 0 where it leaves the scene", "units": "m"});
                    (F32, vec![h, w], IMAGE, a)
                }
                Self::Normal => {
                    // CF's scale_factor, which xarray decodes by itself.
                    let a = json!({"long_name": "unit normal, camera frame (x right, y down, z forward)", "scale_factor": 1.0 / 32767.0});
                    (I16, vec![h, w, 3], &["scene", "row", "column", "axis"], a)
                }
                Self::Instance => {
                    let a = json!({"long_name": "object index + 1; 0 = nothing"});
                    (U32, vec![h, w], IMAGE, a)
                }
                Self::Label => {
                    let a = json!({
                        "long_name": "semantic label index + 1; 0 = nothing",
                        "names": "manifests/<scene>.json, provenance.plan.labels",
                    });
                    (U16, vec![h, w], IMAGE, a)
                }
                Self::Specular => {
                    let a = json!({"long_name": "1 = the first surface is a mirror"});
                    (U8, vec![h, w], IMAGE, a)
                }
                Self::Visibility => {
                    let a = json!({"long_name": "visibility of each spot, eight spots a byte", "polarity": "1 = lit", "bit_order": "little", "spots": n});
                    let dims = &["scene", "spot_byte", "row", "column"];
                    (U8, vec![n.div_ceil(8), h, w], dims, a)
                }
                Self::TwoBouncePath => {
                    let a = json!({"long_name": "measured optical path of each spot's two-bounce light; 0 = not measured", "units": "m"});
                    let dims = &["scene", "spot", "row", "column"];
                    (F32, vec![n, h, w], dims, a)
                }
                Self::Rgb => {
                    let a = json!({"long_name": "colour image, red green blue, sRGB-encoded"});
                    (U8, vec![h, w, 3], &["scene", "row", "column", "channel"], a)
                }
                Self::Spots => {
                    let a = json!({
                        "long_name": "illumination spots in the camera frame; NaN = the beam meets nothing",
                        "components": ["x", "y", "z", "nx", "ny", "nz", "path_from_laser"],
                        "units": "m",
                    });
                    (F32, vec![n, 7], &["scene", "spot", "spot_component"], a)
                }
                Self::Intrinsics => {
                    let a = json!({"long_name": "pinhole intrinsics", "components": ["fx", "fy", "cx", "cy"], "units": "pixels", "pixel_centre": "(u + 0.5, v + 0.5)"});
                    (F32, vec![4], &["scene", "intrinsic"], a)
                }
                Self::Camera => {
                    let a = json!({"long_name": "camera-to-world matrix, x_world = M x_camera", "units": "m"});
                    (F32, vec![4, 4], &["scene", "pose_row", "pose_column"], a)
                }
                Self::Laser => {
                    let a = json!({"long_name": "laser origin, camera frame", "units": "m"});
                    (F32, vec![3], &["scene", "axis"], a)
                }
                Self::Scale => {
                    let a = json!({"long_name": "photons per unit of h; NaN = no such scene yet"});
                    (F32, vec![], &["scene"], a)
                }
            };
        let inner = coding.as_ref().map(|coding| {
            let side = |n: u64| n.min(INNER_SIDE);
            let inner = [1, coding.inner_bins, side(h), side(w)];
            inner[4 - shape.len()..].to_vec()
        });
        let object_shape = match &inner {
            Some(inner) => shape
                .iter()
                .zip(inner)
                .map(|(s, i)| s.div_ceil(*i) * i)
                .collect(),
            None => shape.clone(),
        };
        let fill_nan = matches!(
            self,
            Self::Spots | Self::Intrinsics | Self::Camera | Self::Laser | Self::Scale
        );
        Layout {
            quantity: self,
            element,
            shape,
            object_shape,
            inner,
            shuffle: match &coding {
                Some(coding) => coding.shuffle(),
                None if element.size() == 1 => "noshuffle",
                None => "shuffle",
            },
            dimensions,
            fill_nan,
            attributes,
        }
    }
}

impl Layout {
    /// Returns the number of images in an object; see [`DatasetSpec::planes`].
    pub fn planes(&self) -> usize {
        match self.quantity {
            Quantity::TransientSpots => self.shape[0] as usize,
            _ => 1,
        }
    }

    /// Returns the key of the scene's object, relative to the data set.
    pub fn key(&self, scene: u64) -> String {
        format!(
            "{}/c/{scene}{}",
            self.quantity.name(),
            "/0".repeat(self.shape.len())
        )
    }

    /// Returns the codecs of an object, or of an inner chunk if there is a shard.
    pub fn chunk_codecs(&self) -> Value {
        let mut codecs = image_codecs(self.element, self.shuffle);
        let few = matches!(
            self.quantity,
            Quantity::Spots
                | Quantity::Intrinsics
                | Quantity::Camera
                | Quantity::Laser
                | Quantity::Scale
        );
        if few {
            let codecs = codecs.as_array_mut().expect("a list of codecs");
            codecs.remove(1);
        }
        codecs
    }

    /// Returns the fill value in its metadata.
    pub fn fill_value(&self) -> Value {
        match self.element {
            Element::F32 if self.fill_nan => json!("NaN"),
            Element::F32 => json!(0.0),
            _ => json!(0),
        }
    }

    /// Returns the array's `zarr.json`.
    pub fn metadata(&self, scenes: u64) -> Value {
        let with_scene = |first: u64, rest: &[u64]| -> Vec<u64> {
            std::iter::once(first).chain(rest.iter().copied()).collect()
        };
        let codecs = match &self.inner {
            None => self.chunk_codecs(),
            Some(inner) => json!([{"name": "sharding_indexed", "configuration": {
                "chunk_shape": with_scene(1, inner),
                "codecs": self.chunk_codecs(),
                "index_codecs": index_codecs(),
                "index_location": "end",
            }}]),
        };
        json!({
            "zarr_format": 3,
            "node_type": "array",
            "shape": with_scene(scenes, &self.shape),
            "data_type": self.element.name(),
            "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": with_scene(1, &self.object_shape)}},
            "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
            "fill_value": self.fill_value(),
            "codecs": codecs,
            "attributes": self.attributes,
            "dimension_names": self.dimensions,
        })
    }
}

/// Returns the codecs of images: values as bytes, compressed, with a checksum.
pub fn image_codecs(element: Element, shuffle: &str) -> Value {
    let typesize = element.size();
    let bytes = match typesize {
        1 => json!({"name": "bytes"}),
        _ => json!({"name": "bytes", "configuration": {"endian": "little"}}),
    };
    let blosc = json!({"name": "blosc", "configuration": {
        "cname": "zstd", "clevel": 3, "shuffle": shuffle, "typesize": typesize, "blocksize": 0,
    }});
    json!([bytes, blosc, {"name": "crc32c"}])
}

/// Returns the codecs of a shard's index.
pub fn index_codecs() -> Value {
    json!([{"name": "bytes", "configuration": {"endian": "little"}}, {"name": "crc32c"}])
}
