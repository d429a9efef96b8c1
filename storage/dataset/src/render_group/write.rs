//! Small Zarr v3 groups of plain arrays in a local folder, for single renders and comparisons; see
//! `read` for the reader.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Mutex;

use bytes::Bytes;
use rayon::prelude::*;
use serde_json::{Map, Value, json};

use crate::coding::codec::ChunkCodec;
use crate::layout::group::{METADATA, pretty};
use crate::layout::quantity::Element;
use crate::scenes::read::Stored;
use picofarm_store::StorageError;

/// Number of values of the largest chunk.
const CHUNK_VALUES: u64 = 1 << 20;

/// An array of a render group.
#[derive(Debug, Clone, Copy)]
pub struct RenderArray<'a, T = f32> {
    /// Name: letters, digits, `_` and `-`.
    pub name: &'a str,
    /// Shape.
    pub shape: &'a [u64],
    /// A name for each dimension; dimensions of equal name must have equal length, as xarray
    /// requires.
    pub dimension_names: &'a [&'a str],
    /// Values in row-major order; all bit patterns are preserved.
    pub data: &'a [T],
}

/// Writes a Zarr v3 group of plain arrays with `attributes` to the new folder `dir`. The write is
/// atomic: the group is written to a temporary folder next to `dir` and renamed.
///
/// # Errors
/// [`StorageError::Invalid`] for unsuitable arrays, and if `dir` exists and is not empty (nothing
/// is overwritten); [`StorageError::Io`].
pub fn write_render_group<T: Stored + Send + Sync>(
    dir: &Path,
    arrays: &[RenderArray<'_, T>],
    attributes: &Map<String, Value>,
) -> Result<(), StorageError> {
    check(arrays)?;
    let folder = NewFolder::begin(dir)?;
    write_into(folder.path(), arrays, attributes)?;
    folder.finish()
}

/// A folder that appears when it is complete: its files are written next to it, and it is renamed.
#[derive(Debug)]
pub(crate) struct NewFolder {
    dir: PathBuf,
    partial: PathBuf,
}

impl NewFolder {
    /// Starts the new folder `dir`.
    pub fn begin(dir: &Path) -> Result<Self, StorageError> {
        let dir = std::path::absolute(dir).map_err(|e| StorageError::io("resolve", dir, e))?;
        refuse_occupied(&dir)?;
        let (Some(parent), Some(name)) = (dir.parent(), dir.file_name()) else {
            return Err(StorageError::invalid(
                "dir",
                format!("expected a new folder, found {}", dir.display()),
            ));
        };
        let partial = parent.join(format!(
            ".{}.partial-{}",
            name.display(),
            uuid::Uuid::new_v4()
        ));
        fs::create_dir_all(&partial).map_err(|e| StorageError::io("create", &partial, e))?;
        Ok(Self { dir, partial })
    }

    /// Returns where its files are written.
    pub fn path(&self) -> &Path {
        &self.partial
    }

    /// Gives the folder its name.
    pub fn finish(self) -> Result<(), StorageError> {
        // The rename replaces an empty folder, and fails if it was filled in the meantime.
        fs::rename(&self.partial, &self.dir).map_err(|e| StorageError::io("create", &self.dir, e))
    }
}

impl Drop for NewFolder {
    fn drop(&mut self) {
        // Once renamed there is nothing to remove. Leftovers that cannot be removed remain visible.
        let _ = fs::remove_dir_all(&self.partial);
    }
}

/// Checks names, shapes and lengths.
pub(crate) fn check<T>(arrays: &[RenderArray<'_, T>]) -> Result<(), StorageError> {
    for (i, array) in arrays.iter().enumerate() {
        let invalid = |what: String| {
            Err(StorageError::invalid(
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

fn refuse_occupied(dir: &Path) -> Result<(), StorageError> {
    let occupied = |what: &str| {
        let hint = "choose another folder or remove it first";
        Err(StorageError::invalid(
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
        Err(e) => Err(StorageError::io("list", dir, e)),
    }
}

/// Writes a group into a folder.
pub(crate) fn write_into<T: Stored + Send + Sync>(
    dir: &Path,
    arrays: &[RenderArray<'_, T>],
    attributes: &Map<String, Value>,
) -> Result<(), StorageError> {
    encode(arrays, attributes, &|key, bytes| {
        write(&dir.join(key), &bytes)
    })
}

/// Returns the objects that [`write_render_group`] writes, with keys relative to its folder,
/// ascending.
///
/// # Errors
/// [`StorageError::Invalid`] for unsuitable arrays.
pub fn encode_render_group<T: Stored + Send + Sync>(
    arrays: &[RenderArray<'_, T>],
    attributes: &Map<String, Value>,
) -> Result<BTreeMap<String, Bytes>, StorageError> {
    check(arrays)?;
    let objects = Mutex::new(BTreeMap::new());
    encode(arrays, attributes, &|key, bytes| {
        let mut objects = objects.lock().expect("no panic while locked");
        objects.insert(key, bytes);
        Ok(())
    })?;
    Ok(objects.into_inner().expect("no panic while locked"))
}

/// Passes the objects of a group to `put` one by one, from any thread; the root's metadata comes
/// last.
fn encode<T: Stored + Send + Sync>(
    arrays: &[RenderArray<'_, T>],
    attributes: &Map<String, Value>,
    put: &(dyn Fn(String, Bytes) -> Result<(), StorageError> + Sync),
) -> Result<(), StorageError> {
    let mut consolidated = Map::new();
    for array in arrays {
        let chunk = chunk_shape(array.shape);
        let codecs = codecs(T::ELEMENT);
        let metadata = json!({
            "zarr_format": 3,
            "node_type": "array",
            "shape": array.shape,
            "data_type": T::ELEMENT.name(),
            "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": chunk}},
            "chunk_key_encoding": key_encoding(),
            "fill_value": if T::ELEMENT == Element::F32 { json!(0.0) } else { json!(0) },
            "codecs": codecs,
            "attributes": {},
            "dimension_names": array.dimension_names,
        });
        put(format!("{}/{METADATA}", array.name), pretty(&metadata))?;
        let codec = ChunkCodec::plain(&codecs, &chunk, T::ELEMENT);
        let grid = grid(array.shape, &chunk);
        (0..grid.iter().product::<u64>())
            .into_par_iter()
            .try_for_each(|at| {
                let at = unravel(at, &grid);
                let values = gather(array, &chunk, &at);
                let bytes = codec.encode(bytemuck::cast_slice(&values))?;
                put(format!("{}/{}", array.name, chunk_key(&at)), bytes.into())
            })?;
        consolidated.insert(array.name.to_string(), metadata);
    }
    let root = json!({
        "zarr_format": 3,
        "node_type": "group",
        "attributes": attributes,
        "consolidated_metadata": {"kind": "inline", "must_understand": false, "metadata": consolidated},
    });
    put(METADATA.to_owned(), pretty(&root))
}

/// Returns the codecs of a render group's chunks.
pub(crate) fn codecs(element: Element) -> Value {
    json!([
        {"name": "bytes", "configuration": {"endian": "little"}},
        {"name": "blosc", "configuration": {
            "cname": "zstd", "clevel": 3, "shuffle": "shuffle", "typesize": element.size(), "blocksize": 0,
        }},
        {"name": "crc32c"},
    ])
}

/// Returns the encoding of their names.
pub(crate) fn key_encoding() -> Value {
    json!({"name": "default", "configuration": {"separator": "/"}})
}

/// Returns the number of chunks along each dimension.
pub(crate) fn grid(shape: &[u64], chunk: &[u64]) -> Vec<u64> {
    let sizes = shape.iter().zip(chunk);
    sizes.map(|(s, c)| s.div_ceil(*c)).collect()
}

/// Returns the name of a chunk, relative to its array's folder.
pub(crate) fn chunk_key(at: &[u64]) -> String {
    let mut key = "c".to_owned();
    for index in at {
        key += &format!("/{index}");
    }
    key
}

fn write(path: &PathBuf, bytes: &[u8]) -> Result<(), StorageError> {
    if let Some(parent) = path.parent() {
        fs::create_dir_all(parent).map_err(|e| StorageError::io("create", parent, e))?;
    }
    fs::write(path, bytes).map_err(|e| StorageError::io("write", path, e))
}

/// Returns the chunk shape: the array's shape, with its longest dimension except the last halved
/// until the chunk is small enough.
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

pub(crate) fn unravel(mut index: u64, shape: &[u64]) -> Vec<u64> {
    let mut at = vec![0; shape.len()];
    for (at, n) in at.iter_mut().zip(shape).rev() {
        *at = index % n;
        index /= n;
    }
    at
}

/// Returns the values of a chunk, 0 outside the array.
fn gather<T: Stored>(array: &RenderArray<'_, T>, chunk: &[u64], at: &[u64]) -> Vec<T> {
    let mut values = vec![T::zeroed(); chunk.iter().product::<u64>() as usize];
    for run in runs(array.shape, chunk, at) {
        values[run.chunk..][..run.len].copy_from_slice(&array.data[run.array..][..run.len]);
    }
    values
}

/// Contiguous values shared by a chunk and its array.
pub(crate) struct Run {
    /// Start in the chunk.
    pub chunk: usize,
    /// Start in the array.
    pub array: usize,
    pub len: usize,
}

/// Returns the runs of chunk `at` inside the array.
pub(crate) fn runs<'a>(
    shape: &'a [u64],
    chunk: &'a [u64],
    at: &'a [u64],
) -> impl Iterator<Item = Run> + 'a {
    let last = chunk.last().copied().unwrap_or(1);
    let length = shape.last().copied().unwrap_or(1);
    let start = at.last().copied().unwrap_or(0) * last;
    let len = last.min(length - start) as usize;
    let outer = &chunk[..chunk.len().saturating_sub(1)];
    (0..outer.iter().product::<u64>()).filter_map(move |row| {
        let mut array = 0;
        for (d, within) in unravel(row, outer).iter().enumerate() {
            let index = at[d] * chunk[d] + within;
            if index >= shape[d] {
                return None;
            }
            array = array * shape[d] + index;
        }
        Some(Run {
            chunk: (row * last) as usize,
            array: (array * length + start) as usize,
            len,
        })
    })
}
