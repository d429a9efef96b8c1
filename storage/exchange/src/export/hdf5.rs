//! Encodes a scene as an HDF5 file: one dataset per array, with shuffle and gzip, readable by h5py,
//! MATLAB and Julia.

use hdf5_pure::{AttrValue, DatasetBuilder, FileBuilder};

use super::plain::{Plain, PlainScene, Values};
use picofarm_dataset::DatasetSpec;
use picofarm_store::StorageError;

/// gzip level. Higher levels shrink files by a few per cent and take twice the time.
const LEVEL: u32 = 4;
/// Side of a chunk in pixels.
const SIDE: usize = 32;

/// Returns the file's bytes, which are a pure function of the scene.
pub(super) fn file(scene: &PlainScene, spec: &DatasetSpec) -> Result<Vec<u8>, StorageError> {
    let mut file = FileBuilder::new();
    for array in &scene.arrays {
        let dataset = file.create_dataset(array.name);
        let shape: Vec<u64> = array.shape.iter().map(|&n| n as u64).collect();
        fill(dataset, &array.values);
        dataset.with_shape(&shape);
        if let Some(chunks) = chunks(array) {
            dataset
                .with_chunks(&chunks)
                .with_shuffle()
                .with_deflate(LEVEL);
        }
        dataset.set_attr("long_name", AttrValue::String(array.about.into()));
    }
    let manifest = serde_json::to_string(&scene.manifest).expect("a manifest is plain data");
    // If many bins are saturated, the manifest is too long for an attribute.
    file.create_dataset("manifest")
        .with_vlen_strings(&[&manifest]);
    let gate = &spec.gate;
    for (name, value) in [
        ("scene", AttrValue::U64(scene.manifest.scene)),
        ("gate_start_m", AttrValue::F64(gate.start_m)),
        ("bin_width_m", AttrValue::F64(gate.bin_width_m)),
        ("bins", AttrValue::U64(gate.bins.into())),
    ] {
        file.set_attr(name, value);
    }
    file.finish()
        .map_err(|e| StorageError::codec("cannot encode an HDF5 file", e))
}

fn fill(dataset: &mut DatasetBuilder, values: &Values) {
    match values {
        Values::F32(v) => dataset.with_f32_data(v),
        Values::U32(v) => dataset.with_u32_data(v),
        Values::U16(v) => dataset.with_u16_data(v),
        Values::U8(v) => dataset.with_u8_data(v),
    };
}

/// Returns the chunk shape: images and larger arrays are chunked by pixels.
fn chunks(array: &Plain) -> Option<Vec<u64>> {
    let pixels = match (array.name, &array.shape[..]) {
        ("visibility", &[_, h, w]) => (h, w, 1),
        (_, &[h, w] | &[h, w, _]) if h * w > 64 => (h, w, 0),
        _ => return None,
    };
    let (h, w, first) = pixels;
    let mut chunk: Vec<u64> = array.shape.iter().map(|&n| n as u64).collect();
    chunk[first] = h.min(SIDE) as u64;
    chunk[first + 1] = w.min(SIDE) as u64;
    Some(chunk)
}
