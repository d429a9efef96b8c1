//! Scenes as WebDataset samples in a tar file: `000017.npz` with the arrays, for numpy, and
//! `000017.json` with the scene's manifest and the data set's gate.

use std::io::{Cursor, Write};

use serde_json::json;

use super::plain::{Plain, PlainScene, Values};
use crate::import::npy;
use picofarm_dataset::DatasetSpec;
use picofarm_store::StorageError;

/// Deflate level. A sample is read as a whole, and written once.
const LEVEL: i64 = 4;

/// A tar file under construction. The same samples give the same bytes.
pub(super) struct Tar(tar::Builder<Vec<u8>>);

fn failed(e: impl ToString) -> StorageError {
    StorageError::codec("cannot encode a tar file", e)
}

impl Tar {
    pub(super) fn new() -> Self {
        Self(tar::Builder::new(Vec::new()))
    }

    /// Adds a scene.
    pub(super) fn add(
        &mut self,
        scene: &PlainScene,
        spec: &DatasetSpec,
    ) -> Result<(), StorageError> {
        let key = format!("{:06}", scene.manifest.scene);
        self.file(&format!("{key}.npz"), &npz(&scene.arrays)?)?;
        let aside =
            json!({"scene": scene.manifest.scene, "gate": spec.gate, "manifest": scene.manifest});
        let text = serde_json::to_vec(&aside).expect("plain data");
        self.file(&format!("{key}.json"), &text)
    }

    fn file(&mut self, name: &str, bytes: &[u8]) -> Result<(), StorageError> {
        let mut header = tar::Header::new_ustar();
        header.set_size(bytes.len() as u64);
        header.set_mode(0o644);
        header.set_mtime(0);
        self.0.append_data(&mut header, name, bytes).map_err(failed)
    }

    pub(super) fn finish(self) -> Result<Vec<u8>, StorageError> {
        self.0.into_inner().map_err(failed)
    }
}

/// Encodes the arrays for `numpy.load`.
fn npz(arrays: &[Plain]) -> Result<Vec<u8>, StorageError> {
    let failed = |e: String| StorageError::codec("cannot encode a .npz file", e);
    let mut zip = zip::ZipWriter::new(Cursor::new(Vec::new()));
    let options = zip::write::SimpleFileOptions::default()
        .compression_method(zip::CompressionMethod::Deflated)
        .compression_level(Some(LEVEL))
        .last_modified_time(zip::DateTime::default());
    for array in arrays {
        let bytes = match &array.values {
            Values::F32(v) => npy::write("<f4", &array.shape, v),
            Values::U32(v) => npy::write("<u4", &array.shape, v),
            Values::U16(v) => npy::write("<u2", &array.shape, v),
            Values::U8(v) => npy::write("|u1", &array.shape, v),
        };
        let name = format!("{}.npy", array.name);
        zip.start_file(name, options)
            .map_err(|e| failed(e.to_string()))?;
        zip.write_all(&bytes).map_err(|e| failed(e.to_string()))?;
    }
    let done = zip.finish().map_err(|e| failed(e.to_string()))?;
    Ok(done.into_inner())
}
