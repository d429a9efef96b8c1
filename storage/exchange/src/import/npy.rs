//! Reads NumPy files: `.npy` of any numeric type, and `.npz` archives of them. Values are returned
//! as f32 in C order.

use std::io::{Cursor, Read};
use std::path::Path;

use half::f16;
use rayon::prelude::*;

use super::ImportError;
use super::files::Files;

/// An array of numbers in C order.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Array {
    /// Size along each axis; the last varies fastest.
    pub shape: Vec<usize>,
    pub values: Vec<f32>,
    /// NumPy's name of the stored type, e.g. `<f2`.
    pub stored: String,
}

/// Magic number, version, header length (two bytes in version 1).
const FIXED: usize = 10;
const HINT: &str = "save it again with numpy.save, as an array of numbers";

const HINT_NPZ: &str = "save it again with numpy.savez_compressed";

/// A parsed header.
struct Header {
    shape: Vec<usize>,
    stored: String,
    fortran: bool,
    /// Offset of the values.
    end: usize,
}

/// Returns the shape of the array in a `.npy` file.
pub(super) fn peek(file: &Path, files: &Files) -> Result<Vec<usize>, ImportError> {
    let failed = |e| ImportError::io("read", file, e);
    let opened = files.open(file)?;
    let mut head = Vec::new();
    opened
        .take(1 << 16)
        .read_to_end(&mut head)
        .map_err(failed)?;
    Ok(header(file, &head)?.shape)
}

/// Parses a `.npy` file.
pub(crate) fn parse(file: &Path, bytes: &[u8]) -> Result<Array, ImportError> {
    let damaged = |what: String| ImportError::unreadable(file, what, HINT);
    let Header {
        shape,
        stored,
        fortran,
        end,
    } = header(file, bytes)?;
    let count = shape
        .iter()
        .try_fold(1usize, |n, side| n.checked_mul(*side))
        .filter(|n| *n <= 1 << 34)
        .ok_or_else(|| damaged(format!("its shape {shape:?} is too large")))?;
    let values = decode(&stored, &bytes[end..], count).map_err(damaged)?;
    let values = match fortran && shape.len() > 1 {
        true => from_fortran(&shape, &values),
        false => values,
    };
    Ok(Array {
        shape,
        values,
        stored,
    })
}

fn header(file: &Path, bytes: &[u8]) -> Result<Header, ImportError> {
    let damaged = |what: String| ImportError::unreadable(file, what, HINT);
    if bytes.len() < FIXED || &bytes[..6] != b"\x93NUMPY" {
        return Err(damaged("not a .npy file".into()));
    }
    let (start, len) = match bytes[6] {
        1 => (FIXED, usize::from(u16::from_le_bytes([bytes[8], bytes[9]]))),
        2 | 3 if bytes.len() >= 12 => {
            let len = u32::from_le_bytes([bytes[8], bytes[9], bytes[10], bytes[11]]);
            (12, len as usize)
        }
        version => return Err(damaged(format!("unknown version {version} of .npy"))),
    };
    let header = bytes
        .get(start..start.saturating_add(len))
        .and_then(|h| std::str::from_utf8(h).ok())
        .ok_or_else(|| damaged("its header is cut off".into()))?;
    let stored = quoted(header, "descr").ok_or_else(|| {
        damaged("its header names no plain type of number (descr); structures and objects cannot be read".into())
    })?;
    let fortran = match field(header, "fortran_order").map(|v| v.starts_with("True")) {
        Some(fortran) => fortran,
        None => return Err(damaged("its header has no fortran_order".into())),
    };
    let shape = shape(header).ok_or_else(|| damaged("its header has no shape".into()))?;
    Ok(Header {
        shape,
        stored: stored.to_owned(),
        fortran,
        end: start + len,
    })
}

/// Returns the names of the arrays in a `.npz` file, sorted.
pub(super) fn names_npz(file: &Path, bytes: &[u8]) -> Result<Vec<String>, ImportError> {
    let archive = archive(file, bytes)?;
    let mut names: Vec<String> = archive
        .file_names()
        .filter_map(|n| n.strip_suffix(".npy").map(str::to_owned))
        .collect();
    names.sort();
    Ok(names)
}

fn archive<'a>(
    file: &Path,
    bytes: &'a [u8],
) -> Result<zip::ZipArchive<Cursor<&'a [u8]>>, ImportError> {
    zip::ZipArchive::new(Cursor::new(bytes)).map_err(|e| {
        let what = format!("not a .npz file ({e})");
        ImportError::unreadable(file, what, HINT_NPZ)
    })
}

/// Reads the array `name` of a `.npz` file.
///
/// It is decompressed only if it announces at most `values` numbers.
pub(super) fn parse_npz(
    file: &Path,
    bytes: &[u8],
    name: &str,
    values: usize,
) -> Result<Array, ImportError> {
    let damaged = |what: String| ImportError::unreadable(file, what, HINT_NPZ);
    let mut archive = archive(file, bytes)?;
    let entry = format!("{name}.npy");
    if archive.index_for_name(&entry).is_none() {
        let there: Vec<&str> = archive
            .file_names()
            .filter_map(|n| n.strip_suffix(".npy"))
            .collect();
        return Err(ImportError::refused(
            file,
            "arrays",
            format!("{name:?}"),
            format!("{there:?}"),
            "rename the array",
        ));
    }
    let packed = archive
        .by_name(&entry)
        .map_err(|e| damaged(format!("{entry}: {e}")))?;
    // Space for the widest number type, and a header.
    let most = (values as u64).saturating_mul(8).saturating_add(1 << 20);
    let announced = packed.size();
    let inner = picofarm_files::read_entry(packed, announced, most)
        .map_err(|e| damaged(format!("{entry}: {e}")))?;
    parse(&file.join(entry), &inner)
}

/// Writes a `.npy` file of 32-bit floats or bytes, in C order.
pub(crate) fn write<T: bytemuck::Pod>(descr: &str, shape: &[usize], values: &[T]) -> Vec<u8> {
    let sides: String = shape.iter().map(|s| format!("{s}, ")).collect();
    let shape = match shape.len() {
        1 => sides.trim_end().to_owned(),
        _ => sides.trim_end_matches(", ").to_owned(),
    };
    let mut header =
        format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': ({shape}), }}");
    while !(FIXED + header.len() + 1).is_multiple_of(64) {
        header.push(' ');
    }
    header.push('\n');
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((header.len() as u16).to_le_bytes());
    bytes.extend(header.as_bytes());
    bytes.extend(bytemuck::cast_slice::<T, u8>(values));
    bytes
}

fn field<'a>(header: &'a str, name: &str) -> Option<&'a str> {
    let at = header.find(&format!("'{name}'"))?;
    let rest = &header[at + name.len() + 2..];
    Some(rest.trim_start().strip_prefix(':')?.trim_start())
}

fn quoted<'a>(header: &'a str, name: &str) -> Option<&'a str> {
    let rest = field(header, name)?.strip_prefix('\'')?;
    rest.split_once('\'').map(|(value, _)| value)
}

fn shape(header: &str) -> Option<Vec<usize>> {
    let rest = field(header, "shape")?.strip_prefix('(')?;
    let (inside, _) = rest.split_once(')')?;
    let sides = inside.split(',').map(str::trim).filter(|s| !s.is_empty());
    sides.map(|s| s.parse().ok()).collect()
}

/// Decodes `count` numbers of the named type.
fn decode(stored: &str, data: &[u8], count: usize) -> Result<Vec<f32>, String> {
    macro_rules! numbers {
        ($type:ty, $to_f32:expr) => {{
            const SIZE: usize = size_of::<$type>();
            let expected = count * SIZE;
            if data.len() != expected {
                return Err(format!(
                    "expected {expected} bytes of values, found {}",
                    data.len()
                ));
            }
            let big = stored.starts_with('>');
            let one = |raw: &[u8]| {
                let mut raw: [u8; SIZE] = raw.try_into().expect("chunks have this size");
                if big {
                    raw.reverse();
                }
                $to_f32(<$type>::from_le_bytes(raw))
            };
            Ok(data.par_chunks_exact(SIZE).map(one).collect())
        }};
    }
    let kind = stored.trim_start_matches(['<', '>', '|', '=']);
    match kind {
        "f2" => numbers!(u16, |x| f16::from_bits(x).to_f32()),
        "f4" => numbers!(f32, |x| x),
        "f8" => numbers!(f64, |x| x as f32),
        "u1" | "b1" => numbers!(u8, f32::from),
        "i1" => numbers!(i8, f32::from),
        "u2" => numbers!(u16, f32::from),
        "i2" => numbers!(i16, f32::from),
        "u4" => numbers!(u32, |x| x as f32),
        "i4" => numbers!(i32, |x| x as f32),
        "u8" => numbers!(u64, |x| x as f32),
        "i8" => numbers!(i64, |x| x as f32),
        _ => Err(format!(
            "values of type {stored:?}, which are no real numbers"
        )),
    }
}

/// Converts column-major values to row-major order.
pub(super) fn from_fortran(shape: &[usize], values: &[f32]) -> Vec<f32> {
    let mut strides = vec![1; shape.len()];
    for axis in 1..shape.len() {
        strides[axis] = strides[axis - 1] * shape[axis - 1];
    }
    let last = shape.len() - 1;
    let mut out = Vec::with_capacity(values.len());
    let mut index = vec![0; shape.len()];
    while out.len() < values.len() {
        let base: usize = index.iter().zip(&strides).map(|(i, s)| i * s).sum();
        out.extend((0..shape[last]).map(|i| values[base + i * strides[last]]));
        for axis in (0..last).rev() {
            index[axis] += 1;
            if index[axis] < shape[axis] {
                break;
            }
            index[axis] = 0;
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_archive_that_announces_more_numbers_than_wanted_is_not_unpacked() {
        use std::io::Write;
        let mut zip = zip::ZipWriter::new(Cursor::new(Vec::new()));
        let options = zip::write::SimpleFileOptions::default();
        zip.start_file("shadows.npy", options).unwrap();
        zip.write_all(&write("|u1", &[64 << 20], &vec![0u8; 64 << 20]))
            .unwrap();
        let bytes = zip.finish().unwrap().into_inner();
        assert!(bytes.len() < 1 << 18, "{}", bytes.len());
        let file = Path::new("a.npz");
        let said = parse_npz(file, &bytes, "shadows", 1000)
            .unwrap_err()
            .to_string();
        assert!(
            said.contains("announces") && said.contains("a.npz"),
            "{said}"
        );
        let whole = parse_npz(file, &bytes, "shadows", 64 << 20).unwrap();
        assert_eq!(whole.values.len(), 64 << 20);
    }

    #[test]
    fn what_is_written_is_read() {
        let values = [1.0f32, -2.5, 3.0, 0.0, 1e-30, 6.0];
        for shape in [vec![6], vec![2, 3], vec![1, 2, 3]] {
            let bytes = write("<f4", &shape, &values);
            assert_eq!((bytes.len() - values.len() * 4) % 64, 0);
            let array = parse(Path::new("a.npy"), &bytes).unwrap();
            assert_eq!((array.shape, &array.values[..]), (shape, &values[..]));
        }
    }

    #[test]
    fn columns_first_and_big_endian_numbers_are_put_right() {
        let fortran = [1u16, 4, 2, 5, 3, 6].map(u16::to_be).map(u16::to_ne_bytes);
        let mut bytes = write("<f4", &[2, 3], &[0f32; 0]);
        let text = String::from_utf8_lossy(&bytes[FIXED..]).into_owned();
        let text = text.replace("<f4", ">u2").replace("False", "True ");
        bytes.splice(FIXED.., text.into_bytes());
        bytes.extend(fortran.as_flattened());
        let array = parse(Path::new("a.npy"), &bytes).unwrap();
        assert_eq!(array.values, [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
    }

    #[test]
    fn broken_files_are_refused_by_name() {
        let whole = write("<f4", &[2, 3], &[1f32; 6]);
        for cut in [0, 5, 9, 40, whole.len() - 1] {
            let error = parse(Path::new("d/a.npy"), &whole[..cut]).unwrap_err();
            assert!(error.to_string().starts_with("d/a.npy: "), "{error}");
        }
        let objects = write("|O", &[1], &[0u8; 8]);
        let error = parse(Path::new("a.npy"), &objects).unwrap_err().to_string();
        assert!(error.contains("no real numbers"), "{error}");
    }
}
