//! Reads render groups. Only groups written by `write_render_group` are supported; every chunk must
//! exist and be intact.

use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use rayon::prelude::*;
use serde_json::{Map, Value};

use crate::coding::codec::ChunkCodec;
use crate::layout::group::METADATA;
use crate::render_group::write::{chunk_key, codecs, grid, key_encoding, runs, unravel};
use crate::scenes::read::Stored;
use picofarm_store::StorageError;

/// Number of chunks decoded concurrently. It bounds the memory in addition to the array's own.
const BATCH: u64 = 16;
/// Maximum number of values of a chunk; more indicate damaged metadata.
const MAX_CHUNK: u64 = 1 << 28;
/// Most bytes of a metadata file: attributes say how the render was made, which takes some
/// kilobytes.
const MAX_METADATA: u64 = 64 << 20;
/// Most bytes of a coded chunk beyond those of its values: what does not compress grows by far
/// less.
const MAX_OVERHEAD: u64 = 1 << 20;

/// A render group in a local folder.
#[derive(Debug, Clone)]
pub struct RenderGroup {
    dir: PathBuf,
    attributes: Map<String, Value>,
}

impl RenderGroup {
    /// Opens the group in `dir` without changing it.
    ///
    /// # Errors
    /// [`StorageError::Io`] if there is none, [`StorageError::Invalid`] if its metadata cannot be
    /// read.
    pub fn open(dir: &Path) -> Result<Self, StorageError> {
        let path = dir.join(METADATA);
        let mut root = metadata(&path)?;
        let attributes = match root.get_mut("attributes").map(Value::take) {
            Some(Value::Object(attributes)) if root["node_type"] == "group" => attributes,
            _ => {
                return Err(foreign(
                    &path,
                    "a group with attributes",
                    &root["node_type"],
                ));
            }
        };
        Ok(Self {
            dir: dir.to_path_buf(),
            attributes,
        })
    }

    /// Returns the group's attributes.
    pub fn attributes(&self) -> &Map<String, Value> {
        &self.attributes
    }

    /// Returns whether it has an array of this name.
    pub fn has(&self, name: &str) -> bool {
        self.dir.join(name).join(METADATA).is_file()
    }

    /// Returns the shape and the values (row-major) of an array.
    ///
    /// # Errors
    /// [`StorageError::Io`] if it or one of its chunks is missing, [`StorageError::Invalid`] if it
    /// has another type or was not written by `write_render_group`, [`StorageError::Codec`] if a
    /// chunk is damaged.
    pub fn read<T: Stored + Send + Sync>(
        &self,
        name: &str,
    ) -> Result<(Vec<u64>, Vec<T>), StorageError> {
        let folder = self.dir.join(name);
        let path = folder.join(METADATA);
        let metadata = metadata(&path)?;
        for (field, expected) in [
            ("data_type", T::ELEMENT.name().into()),
            ("codecs", codecs(T::ELEMENT)),
            ("chunk_key_encoding", key_encoding()),
        ] {
            if metadata[field] != expected {
                return Err(foreign(
                    &path,
                    &format!("{field} = {expected}"),
                    &metadata[field],
                ));
            }
        }
        let shape = sizes(&path, &metadata["shape"])?;
        let chunk = sizes(
            &path,
            &metadata["chunk_grid"]["configuration"]["chunk_shape"],
        )?;
        if chunk.len() != shape.len()
            || chunk.iter().zip(&shape).any(|(c, s)| c > s)
            || chunk.iter().product::<u64>() > MAX_CHUNK
        {
            return Err(foreign(
                &path,
                &format!("chunks within the shape {shape:?}"),
                &metadata["chunk_grid"],
            ));
        }
        let grid = grid(&shape, &chunk);
        let chunks: u64 = grid.iter().product();
        // All chunks must exist before memory for the announced shape is allocated.
        for at in (0..chunks).map(|at| unravel(at, &grid)) {
            let path = folder.join(chunk_key(&at));
            fs::metadata(&path).map_err(|e| StorageError::io("read", &path, e))?;
        }
        let most = chunk.iter().product::<u64>() * size_of::<T>() as u64 + MAX_OVERHEAD;
        let codec = ChunkCodec::plain(&codecs(T::ELEMENT), &chunk, T::ELEMENT);
        let mut values = vec![T::zeroed(); shape.iter().product::<u64>() as usize];
        for first in (0..chunks).step_by(BATCH as usize) {
            let batch = (first..chunks.min(first + BATCH))
                .into_par_iter()
                .map(|at| {
                    let path = folder.join(chunk_key(&unravel(at, &grid)));
                    let bytes = bounded(&path, most)?;
                    codec
                        .decode(&bytes)
                        .map_err(|e| StorageError::codec(path.display().to_string(), e))
                })
                .collect::<Result<Vec<_>, _>>()?;
            for (at, bytes) in (first..).zip(batch) {
                let size = size_of::<T>();
                for run in runs(&shape, &chunk, &unravel(at, &grid)) {
                    let target = &mut values[run.array..][..run.len];
                    let source = &bytes[run.chunk * size..][..run.len * size];
                    bytemuck::cast_slice_mut(target).copy_from_slice(source);
                }
            }
        }
        Ok((shape, values))
    }
}

/// Reads a file of at most `most` bytes.
fn bounded(path: &Path, most: u64) -> Result<Vec<u8>, StorageError> {
    let read = fs::File::open(path).and_then(|file| picofarm_files::read_bounded(file, most));
    read.map_err(|e| match e.kind() {
        ErrorKind::InvalidData => StorageError::invalid(path.display().to_string(), e.to_string()),
        _ => StorageError::io("read", path, e),
    })
}

fn metadata(path: &Path) -> Result<Value, StorageError> {
    let bytes = bounded(path, MAX_METADATA)?;
    serde_json::from_slice(&bytes).map_err(|e| {
        StorageError::invalid(
            path.display().to_string(),
            format!("expected the JSON of a Zarr v3 node: {e}"),
        )
    })
}

/// Parses positive sizes with a product that fits into the address space.
fn sizes(path: &Path, value: &Value) -> Result<Vec<u64>, StorageError> {
    let sizes: Option<Vec<u64>> = value
        .as_array()
        .map(|sizes| sizes.iter().filter_map(Value::as_u64).collect());
    sizes
        .filter(|s| s.len() == value.as_array().map_or(0, Vec::len) && !s.contains(&0))
        .filter(|s| {
            let product = s.iter().try_fold(1u64, |n, s| n.checked_mul(*s));
            product.is_some_and(|n| n <= 1 << 40)
        })
        .ok_or_else(|| foreign(path, "positive sizes", value))
}

fn foreign(path: &Path, expected: &str, found: &Value) -> StorageError {
    StorageError::invalid(
        path.display().to_string(),
        format!("expected {expected} as `picofarm scene render` writes it, found {found}"),
    )
}
