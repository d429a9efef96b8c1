//! Small Zarr v3 groups of plain f32 arrays in a local folder, for single renders and comparisons.

use std::fs;
use std::path::{Path, PathBuf};

use rayon::prelude::*;
use serde_json::{Map, Value, json};

use crate::codec::ChunkCodec;
use crate::dataset::{METADATA, pretty};
use crate::error::DatasetError;

/// Values of the largest chunk.
const CHUNK_VALUES: u64 = 1 << 20;

/// An array of a render group.
#[derive(Debug, Clone, Copy)]
pub struct RenderArray<'a> {
    /// Name: letters, digits, `_` and `-`.
    pub name: &'a str,
    /// Shape.
    pub shape: &'a [u64],
    /// A name for each dimension; dimensions of equal name must have equal length, as xarray demands.
    pub dimension_names: &'a [&'a str],
    /// Values in row-major order; any bits are kept.
    pub data: &'a [f32],
}

/// Writes a Zarr v3 group of plain f32 arrays with `attributes` to the new folder `dir`. All or nothing: the group is
/// written beside `dir` and renamed into place.
///
/// # Errors
/// [`DatasetError::Invalid`] for unfit arrays and where `dir` exists and is not empty (nothing is overwritten);
/// [`DatasetError::Io`].
pub fn write_render_group(
    dir: &Path,
    arrays: &[RenderArray<'_>],
    attributes: &Map<String, Value>,
) -> Result<(), DatasetError> {
    check(arrays)?;
    let dir = std::path::absolute(dir).map_err(|e| DatasetError::io("resolve", dir, e))?;
    refuse_occupied(&dir)?;
    let (Some(parent), Some(name)) = (dir.parent(), dir.file_name()) else {
        return Err(DatasetError::invalid(
            "dir",
            format!("expected a new folder, found {}", dir.display()),
        ));
    };
    fs::create_dir_all(parent).map_err(|e| DatasetError::io("create", parent, e))?;
    let partial = parent.join(format!(
        ".{}.partial-{}",
        name.display(),
        uuid::Uuid::new_v4()
    ));
    let written = write_into(&partial, arrays, attributes).and_then(|()| {
        // Replaces an empty folder; fails on one that was filled meanwhile.
        fs::rename(&partial, &dir).map_err(|e| DatasetError::io("create", &dir, e))
    });
    if written.is_err() {
        // The first error is the one to tell; what cannot be removed shows in the folder.
        let _ = fs::remove_dir_all(&partial);
    }
    written
}

fn check(arrays: &[RenderArray<'_>]) -> Result<(), DatasetError> {
    for (i, array) in arrays.iter().enumerate() {
        let invalid = |what: String| {
            Err(DatasetError::invalid(
                format!("arrays[{i}] ({})", array.name),
                what,
            ))
        };
        let plain = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '-';
        if array.name.is_empty() || !array.name.chars().all(plain) {
            return invalid("expected a name of letters, digits, _ and -".into());
        }
        if arrays[..i].iter().any(|other| other.name == array.name) {
            return invalid("expected a name of its own, found it twice".into());
        }
        if array.dimension_names.len() != array.shape.len() {
            return invalid(format!(
                "expected {} dimension names, found {}",
                array.shape.len(),
                array.dimension_names.len()
            ));
        }
        let values: u64 = array.shape.iter().product();
        if values == 0 || values != array.data.len() as u64 {
            return invalid(format!(
                "expected {values} values (and at least one) for the shape {:?}, found {}",
                array.shape,
                array.data.len()
            ));
        }
    }
    Ok(())
}

fn refuse_occupied(dir: &Path) -> Result<(), DatasetError> {
    let occupied = |what: &str| {
        let hint = "choose another folder or remove it first";
        Err(DatasetError::invalid(
            "dir",
            format!(
                "{} {what}, and nothing is overwritten: {hint}",
                dir.display()
            ),
        ))
    };
    match fs::read_dir(dir) {
        Ok(mut entries) => match entries.next() {
            Some(_) => occupied("is not empty"),
            None => Ok(()),
        },
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => Ok(()),
        Err(e) if e.kind() == std::io::ErrorKind::NotADirectory => occupied("is a file"),
        Err(e) => Err(DatasetError::io("list", dir, e)),
    }
}

fn write_into(
    dir: &Path,
    arrays: &[RenderArray<'_>],
    attributes: &Map<String, Value>,
) -> Result<(), DatasetError> {
    let mut consolidated = Map::new();
    for array in arrays {
        let chunk = chunk_shape(array.shape);
        let codecs = json!([
            {"name": "bytes", "configuration": {"endian": "little"}},
            {"name": "blosc", "configuration": {
                "cname": "zstd", "clevel": 3, "shuffle": "shuffle", "typesize": 4, "blocksize": 0,
            }},
            {"name": "crc32c"},
        ]);
        let metadata = json!({
            "zarr_format": 3,
            "node_type": "array",
            "shape": array.shape,
            "data_type": "float32",
            "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": chunk}},
            "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
            "fill_value": 0.0,
            "codecs": codecs,
            "attributes": {},
            "dimension_names": array.dimension_names,
        });
        let folder = dir.join(array.name);
        write(&folder.join(METADATA), &pretty(&metadata))?;
        let codec = ChunkCodec::plain_f32(&codecs, &chunk);
        let grid: Vec<u64> = array
            .shape
            .iter()
            .zip(&chunk)
            .map(|(s, c)| s.div_ceil(*c))
            .collect();
        (0..grid.iter().product::<u64>())
            .into_par_iter()
            .try_for_each(|at| {
                let at = unravel(at, &grid);
                let values = gather(array, &chunk, &at);
                let bytes = codec.encode(bytemuck::cast_slice(&values))?;
                let mut path = folder.join("c");
                path.extend(at.iter().map(u64::to_string));
                write(&path, &bytes)
            })?;
        consolidated.insert(array.name.to_string(), metadata);
    }
    let root = json!({
        "zarr_format": 3,
        "node_type": "group",
        "attributes": attributes,
        "consolidated_metadata": {"kind": "inline", "must_understand": false, "metadata": consolidated},
    });
    write(&dir.join(METADATA), &pretty(&root))
}

fn write(path: &PathBuf, bytes: &[u8]) -> Result<(), DatasetError> {
    if let Some(parent) = path.parent() {
        fs::create_dir_all(parent).map_err(|e| DatasetError::io("create", parent, e))?;
    }
    fs::write(path, bytes).map_err(|e| DatasetError::io("write", path, e))
}

/// The whole shape, its longest dimension but the last halved until a chunk is small enough.
fn chunk_shape(shape: &[u64]) -> Vec<u64> {
    let mut chunk = shape.to_vec();
    while chunk.iter().product::<u64>() > CHUNK_VALUES {
        let splittable = chunk.len().saturating_sub(1).max(1);
        let Some(longest) = chunk[..splittable].iter_mut().max_by_key(|c| **c) else {
            break;
        };
        if *longest == 1 {
            break;
        }
        *longest = longest.div_ceil(2);
    }
    chunk
}

fn unravel(mut index: u64, shape: &[u64]) -> Vec<u64> {
    let mut at = vec![0; shape.len()];
    for (at, n) in at.iter_mut().zip(shape).rev() {
        *at = index % n;
        index /= n;
    }
    at
}

/// The values of a chunk, 0 outside the array.
fn gather(array: &RenderArray<'_>, chunk: &[u64], at: &[u64]) -> Vec<f32> {
    let mut values = vec![0f32; chunk.iter().product::<u64>() as usize];
    let last = chunk.last().copied().unwrap_or(1);
    let length = array.shape.last().copied().unwrap_or(1);
    let start = at.last().copied().unwrap_or(0) * last;
    let len = last.min(length - start) as usize;
    let outer = &chunk[..chunk.len().saturating_sub(1)];
    for (row, target) in values.chunks_exact_mut(last as usize).enumerate() {
        let within = unravel(row as u64, outer);
        let mut source = 0;
        let mut inside = true;
        for (d, within) in within.iter().enumerate() {
            let index = at[d] * chunk[d] + within;
            inside &= index < array.shape[d];
            source = source * array.shape[d] + index;
        }
        if inside {
            let source = (source * length + start) as usize;
            target[..len].copy_from_slice(&array.data[source..source + len]);
        }
    }
    values
}
