//! Reads MATLAB files: numeric arrays of version 5 (plain or compressed) and of version 7.3 (HDF5).

use std::collections::BTreeMap;
use std::io::Read;
use std::ops::Range;
use std::path::{Path, PathBuf};

use super::ImportError;
use super::files::Files;
#[cfg(feature = "formats")]
use super::hdf5::Hdf5;
#[cfg(not(feature = "formats"))]
use super::without_formats::Hdf5;

const HINT: &str = "save it again with save('file.mat', '-v7'), or in Python with scipy.io.savemat";

/// A numeric array, first index fastest.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Matrix {
    pub dims: Vec<usize>,
    pub values: Vec<f64>,
}

/// An open file.
pub(super) struct Mat {
    path: PathBuf,
    content: Content,
}

enum Content {
    V5(BTreeMap<String, Matrix>),
    V73(Hdf5),
}

impl Mat {
    /// Opens a file. With version 7.3, arrays stay on disk until they are read.
    pub fn open(path: &Path, files: &Files) -> Result<Self, ImportError> {
        let mut head = Vec::new();
        let io = |e| ImportError::io("read", path, e);
        let mut file = files.open(path)?.take(HDF5_AT.end + 8);
        file.read_to_end(&mut head).map_err(io)?;
        let whole_head = head.len() >= 128;
        let content = if is_hdf5(&head) {
            files.hash(path)?;
            Content::V73(Hdf5::open(path).map_err(|e| ImportError::unreadable(path, e, HINT))?)
        } else if whole_head && matches!(&head[126..128], b"IM" | b"MI") {
            let bytes = files.bytes(path)?;
            let arrays = version_5(&bytes).map_err(|e| ImportError::unreadable(path, e, HINT))?;
            Content::V5(arrays)
        } else {
            let what = "neither a MATLAB file of version 5 nor one of version 7.3 (HDF5)";
            return Err(ImportError::unreadable(path, what, HINT));
        };
        Ok(Self {
            path: path.to_owned(),
            content,
        })
    }

    /// Returns the names of the numeric arrays.
    pub fn names(&self) -> Vec<String> {
        match &self.content {
            Content::V5(arrays) => arrays.keys().cloned().collect(),
            Content::V73(file) => file.names(),
        }
    }

    /// Returns the dimensions of an array in MATLAB's order.
    pub fn dims(&self, name: &str) -> Result<Vec<usize>, ImportError> {
        match &self.content {
            Content::V5(arrays) => arrays
                .get(name)
                .map(|m| m.dims.clone())
                .ok_or_else(|| self.absent(name)),
            Content::V73(file) => {
                let shape = file.shape(name).map_err(|e| self.broken(name, e))?;
                let shape = shape.ok_or_else(|| self.absent(name))?;
                Ok(shape.iter().rev().map(|s| *s as usize).collect())
            }
        }
    }

    /// Reads a whole array.
    pub fn matrix(&self, name: &str) -> Result<Matrix, ImportError> {
        let dims = self.dims(name)?;
        match &self.content {
            Content::V5(arrays) => Ok(arrays[name].clone()),
            Content::V73(file) => {
                self.check_size(name, &dims)?;
                let values = file.all(name).map_err(|e| self.broken(name, e))?;
                Ok(Matrix { dims, values })
            }
        }
    }

    /// Reads a single number.
    pub fn number(&self, name: &str) -> Result<f64, ImportError> {
        let matrix = self.matrix(name)?;
        match matrix.values[..] {
            [x] => Ok(x),
            _ => {
                let found = format!("{:?}", matrix.dims);
                Err(ImportError::refused(
                    &self.path,
                    name,
                    "one number",
                    found,
                    "save it so",
                ))
            }
        }
    }

    /// Reads some columns of a matrix `[row, column]` as `[row][column]`, without reading the
    /// others.
    pub fn columns(&self, name: &str, columns: Range<usize>) -> Result<Vec<f32>, ImportError> {
        let dims = self.dims(name)?;
        let rows = dims[0];
        self.check_size(name, &[rows, columns.len()])?;
        let mut out = vec![0.0; rows * columns.len()];
        let mut put = |column: usize, values: &[f64]| {
            for (row, x) in values.iter().enumerate() {
                out[row * columns.len() + column - columns.start] = *x as f32;
            }
        };
        match &self.content {
            Content::V5(arrays) => {
                for c in columns.clone() {
                    put(c, &arrays[name].values[c * rows..][..rows]);
                }
            }
            Content::V73(file) => {
                // HDF5 has the reverse order of axes: a column is a row there.
                const AT_ONCE: usize = 64;
                for first in columns.clone().step_by(AT_ONCE) {
                    let n = AT_ONCE.min(columns.end - first);
                    let read = file.rows(name, first as u64, n as u64);
                    let values = read.map_err(|e| self.broken(name, e))?;
                    for (k, column) in values.chunks_exact(rows).enumerate() {
                        put(first + k, column);
                    }
                }
            }
        }
        Ok(out)
    }

    /// Returns an error if the announced size is too large to allocate, because the file need not
    /// contain the announced data.
    fn check_size(&self, name: &str, dims: &[usize]) -> Result<(), ImportError> {
        let count = dims.iter().try_fold(1usize, |n, d| n.checked_mul(*d));
        if count.is_some_and(|count| count <= MAX_VALUES) {
            return Ok(());
        }
        let what = format!("{name}: announces {dims:?} values, more than {MAX_VALUES}");
        Err(ImportError::unreadable(&self.path, what, HINT))
    }

    fn absent(&self, name: &str) -> ImportError {
        let found = format!("{:?}", self.names());
        ImportError::refused(
            &self.path,
            "arrays",
            format!("a numeric array {name}"),
            found,
            "see whether it is the right file",
        )
    }

    fn broken(&self, name: &str, error: String) -> ImportError {
        ImportError::unreadable(&self.path, format!("{name}: {error}"), HINT)
    }
}

/// Offsets at which HDF5 data may begin: 0, or 512 and its doubles. Other programs may store their
/// own data before it.
const HDF5_AT: std::ops::Range<u64> = 0..4096;

/// Returns whether the file's first bytes contain the HDF5 signature.
pub(super) fn is_hdf5(head: &[u8]) -> bool {
    let begins = |at: u64| head[(at as usize).min(head.len())..].starts_with(b"\x89HDF\r\n\x1a\n");
    begins(HDF5_AT.start) || [512, 1024, 2048, HDF5_AT.end].into_iter().any(begins)
}

/// One element: its type and contents.
struct Element<'a> {
    kind: u32,
    data: &'a [u8],
}

/// An iterator over elements.
struct Elements<'a> {
    rest: &'a [u8],
    big: bool,
}

impl<'a> Elements<'a> {
    fn word(&self, at: usize) -> Option<u32> {
        let raw: [u8; 4] = self.rest.get(at..at + 4)?.try_into().ok()?;
        Some(if self.big {
            u32::from_be_bytes(raw)
        } else {
            u32::from_le_bytes(raw)
        })
    }

    fn next(&mut self) -> Result<Option<Element<'a>>, String> {
        const CUT: &str = "an element is cut off";
        if self.rest.is_empty() {
            return Ok(None);
        }
        let first = self.word(0).ok_or(CUT)?;
        if first >> 16 != 0 {
            let size = (first >> 16) as usize;
            let data = self
                .rest
                .get(4..4 + size.min(5))
                .filter(|_| size <= 4)
                .ok_or(CUT)?;
            self.rest = self.rest.get(8..).unwrap_or_default();
            return Ok(Some(Element {
                kind: first & 0xffff,
                data,
            }));
        }
        let size = self.word(4).ok_or(CUT)? as usize;
        let data = self.rest.get(8..8 + size).ok_or(CUT)?;
        let padded = if first == COMPRESSED {
            size
        } else {
            size.next_multiple_of(8)
        };
        self.rest = self.rest.get(8 + padded..).unwrap_or_default();
        Ok(Some(Element { kind: first, data }))
    }

    fn expect(&mut self) -> Result<Element<'a>, String> {
        self.next()?.ok_or_else(|| "an array is cut off".into())
    }
}

const MATRIX: u32 = 14;
const COMPRESSED: u32 = 15;
/// Maximum size in bytes of a decompressed element.
const MAX: u64 = 1 << 32;
/// Maximum number of values of an array.
pub(super) const MAX_VALUES: usize = 1 << 28;

/// Returns the numeric arrays of a version 5 file; others (text, structures, cells) are skipped.
fn version_5(bytes: &[u8]) -> Result<BTreeMap<String, Matrix>, String> {
    let big = &bytes[126..128] == b"MI";
    let mut arrays = BTreeMap::new();
    let mut elements = Elements {
        rest: &bytes[128..],
        big,
    };
    while let Some(element) = elements.next()? {
        let inflated;
        let element = match element.kind {
            COMPRESSED => {
                inflated = inflate(element.data, big)?;
                Elements {
                    rest: &inflated,
                    big,
                }
                .expect()?
            }
            _ => element,
        };
        if element.kind == MATRIX
            && let Some((name, matrix)) = matrix(element.data, big)?
        {
            arrays.insert(name, matrix);
        }
    }
    Ok(arrays)
}

/// Decompresses an element. Its first eight decompressed bytes are a tag with its size.
fn inflate(packed: &[u8], big: bool) -> Result<Vec<u8>, String> {
    let failed = |e: std::io::Error| format!("a compressed element {e}");
    let mut reader = flate2::read::ZlibDecoder::new(packed);
    let mut tag = [0; 8];
    reader.read_exact(&mut tag).map_err(failed)?;
    let size: [u8; 4] = tag[4..].try_into().expect("a tag has eight bytes");
    let size = u64::from(if big {
        u32::from_be_bytes(size)
    } else {
        u32::from_le_bytes(size)
    });
    // Deflate cannot compress better, so a larger announcement is false.
    let most = (packed.len() as u64).saturating_mul(1032).min(MAX);
    let rest = picofarm_files::read_entry(reader.take(size), size, most).map_err(failed)?;
    Ok([&tag[..], &rest].concat())
}

fn matrix(data: &[u8], big: bool) -> Result<Option<(String, Matrix)>, String> {
    let mut parts = Elements { rest: data, big };
    if data.is_empty() {
        return Ok(None);
    }
    let flags = numbers(&parts.expect()?, big)?;
    let class = flags.first().copied().unwrap_or(0.0) as u32 & 0xff;
    // From double to 64-bit integers.
    if !(6..=15).contains(&class) {
        return Ok(None);
    }
    let dims: Vec<usize> = numbers(&parts.expect()?, big)?
        .iter()
        .map(|d| *d as usize)
        .collect();
    let name = String::from_utf8_lossy(parts.expect()?.data).into_owned();
    let values = numbers(&parts.expect()?, big)?;
    let count = dims.iter().try_fold(1usize, |n, d| n.checked_mul(*d));
    if count != Some(values.len()) {
        return Err(format!(
            "{name}: dimensions {dims:?} with {} values",
            values.len()
        ));
    }
    Ok(Some((name, Matrix { dims, values })))
}

fn numbers(element: &Element<'_>, big: bool) -> Result<Vec<f64>, String> {
    macro_rules! read {
        ($type:ty) => {{
            let one = |raw: &[u8]| {
                let raw = raw.try_into().expect("chunks have this size");
                (if big {
                    <$type>::from_be_bytes(raw)
                } else {
                    <$type>::from_le_bytes(raw)
                }) as f64
            };
            Ok(element
                .data
                .chunks_exact(size_of::<$type>())
                .map(one)
                .collect())
        }};
    }
    match element.kind {
        1 => read!(i8),
        2 => read!(u8),
        3 => read!(i16),
        4 => read!(u16),
        5 => read!(i32),
        6 => read!(u32),
        7 => read!(f32),
        9 => read!(f64),
        12 => read!(i64),
        13 => read!(u64),
        other => Err(format!("numbers of unknown type {other}")),
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::*;

    #[test]
    fn a_compressed_element_that_announces_what_it_cannot_hold_is_not_unpacked() {
        let packed = |announced: u32, holds: usize| {
            let mut zlib = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::fast());
            zlib.write_all(&MATRIX.to_le_bytes()).unwrap();
            zlib.write_all(&announced.to_le_bytes()).unwrap();
            zlib.write_all(&vec![0; holds]).unwrap();
            zlib.finish().unwrap()
        };
        assert_eq!(inflate(&packed(64, 64), false).unwrap().len(), 72);
        // Data after the announced size is not decompressed at all.
        assert_eq!(inflate(&packed(64, 64 << 20), false).unwrap().len(), 72);
        for (announced, holds) in [(4_000_000_000, 64), (1 << 20, 64)] {
            let said = inflate(&packed(announced, holds), false).unwrap_err();
            assert!(said.contains("announces"), "{said}");
        }
    }
}
