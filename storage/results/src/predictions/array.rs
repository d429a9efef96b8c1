//! The arrays of predictions: names, shapes, types and codecs.

use serde_json::{Value, json};

use super::{PredictionManifest, PredictionSpec};
use picofarm_dataset::ChunkCodec;
use picofarm_dataset::Element;
use picofarm_dataset::image_codecs;
use picofarm_store::sealed::ObjectEntry;

/// Name of the array of evidence.
pub(super) const EVIDENCE: &str = "evidence";

/// An array with one object per scene.
#[derive(Debug)]
pub(super) struct PredictedArray {
    pub name: &'static str,
    element: Element,
    /// Shape of one scene, without the scene axis.
    shape: Vec<u64>,
    dimensions: &'static [&'static str],
    fill: Value,
    attributes: Value,
    pub codec: ChunkCodec,
}

/// Returns the arrays of such predictions, in the order of their objects in a manifest.
pub(super) fn arrays(spec: &PredictionSpec) -> Vec<PredictedArray> {
    let (h, w, n) = (
        u64::from(spec.height),
        u64::from(spec.width),
        spec.spots.len() as u64,
    );
    const IMAGE: &[&str] = &["scene", "row", "column"];
    let mut arrays = Vec::new();
    if spec.depth {
        let a = json!({"long_name": "z-depth; NaN where nothing is predicted", "units": "m"});
        arrays.push(PredictedArray::new(
            "depth",
            Element::F32,
            vec![h, w],
            IMAGE,
            a,
        ));
    }
    if n > 0 {
        let a = json!({
            "long_name": "probability that a spot lights what is seen, times 255",
            "polarity": "255 = lit",
            "spots": spec.spots,
            "scale_factor": 1.0 / 255.0,
        });
        let dimensions = &["scene", "spot", "row", "column"];
        arrays.push(PredictedArray::new(
            "lit",
            Element::U8,
            vec![n, h, w],
            dimensions,
            a,
        ));
    }
    if spec.specular {
        let a = json!({
            "long_name": "probability that the first surface is a mirror, times 255",
            "scale_factor": 1.0 / 255.0,
        });
        arrays.push(PredictedArray::new(
            "specular",
            Element::U8,
            vec![h, w],
            IMAGE,
            a,
        ));
    }
    if spec.confidence {
        let a = json!({
            "long_name": "how surely the depth is that of the surface, times 255",
            "scale_factor": 1.0 / 255.0,
        });
        arrays.push(PredictedArray::new(
            "confidence",
            Element::U8,
            vec![h, w],
            IMAGE,
            a,
        ));
    }
    if let Some(form) = &spec.evidence {
        let a = json!({
            "long_name": "what is known of each pair of pixel and spot: ranks times 255, and log odds in sixteenths above 128",
            "planes": form.planes,
            "version": form.version,
            "spots": spec.spots,
        });
        arrays.push(PredictedArray::new(
            EVIDENCE,
            Element::U8,
            vec![n, form.planes.len() as u64, h, w],
            &["scene", "spot", "plane", "row", "column"],
            a,
        ));
    }
    arrays
}

impl PredictedArray {
    fn new(
        name: &'static str,
        element: Element,
        shape: Vec<u64>,
        dimensions: &'static [&'static str],
        attributes: Value,
    ) -> Self {
        let chunk: Vec<u64> = std::iter::once(1).chain(shape.iter().copied()).collect();
        Self {
            name,
            element,
            codec: ChunkCodec::plain(&codecs(element), &chunk, element),
            shape,
            dimensions,
            fill: match element {
                Element::F32 => json!("NaN"),
                _ => json!(0),
            },
            attributes,
        }
    }

    /// Returns the key of a scene's object, relative to the group.
    pub fn key(&self, scene: u64) -> String {
        format!("{}/c/{scene}{}", self.name, "/0".repeat(self.shape.len()))
    }

    /// Returns the entry of a scene's object in a manifest.
    pub fn entry<'a>(&self, manifest: &'a PredictionManifest) -> Option<&'a ObjectEntry> {
        let key = self.key(manifest.scene);
        manifest.objects.iter().find(|object| object.key == key)
    }

    /// Returns the size of a scene's values in bytes.
    pub fn bytes(&self) -> usize {
        (self.shape.iter().product::<u64>() * self.element.size()) as usize
    }

    /// Returns the array's `zarr.json`.
    pub fn metadata(&self, scenes: u64) -> Value {
        let with_scene = |first: u64| -> Vec<u64> {
            let rest = self.shape.iter().copied();
            std::iter::once(first).chain(rest).collect()
        };
        json!({
            "zarr_format": 3,
            "node_type": "array",
            "shape": with_scene(scenes),
            "data_type": self.element.name(),
            "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": with_scene(1)}},
            "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
            "fill_value": self.fill,
            "codecs": codecs(self.element),
            "attributes": self.attributes,
            "dimension_names": self.dimensions,
        })
    }
}

fn codecs(element: Element) -> Value {
    let shuffle = match element.size() {
        1 => "noshuffle",
        _ => "shuffle",
    };
    image_codecs(element, shuffle)
}
