//! The kinds of files, recognised by their first bytes, and the error for unknown ones.

use std::io::Read;
use std::path::Path;

use super::super::files::Files;
use super::super::mat::{Mat, is_hdf5};
use super::super::{ImportError, npy};
use super::arrays::{Part, Stated, Strided};
use super::describe::{Described, Description};
use super::{EXAMPLE, consumer_nlos, h5, own, ptu, tables};

/// Most numbers of an array.
const MOST_VALUES: usize = 1 << 32;
/// Bytes at the start of a file that tell its kind.
const HEAD: u64 = 8192;

/// Reads one file.
pub(super) fn read(
    file: &Path,
    description: &Description,
    described: &Described,
    reader: &Files,
) -> Result<Part, ImportError> {
    let mut head = Vec::new();
    let io = |e| ImportError::io("read", file, e);
    let opened = reader.open(file)?;
    opened.take(HEAD).read_to_end(&mut head).map_err(io)?;
    let (format, array) = match &head[..] {
        h if h.starts_with(b"\x93NUMPY") => {
            if let Some(error) = consumer_nlos::pickled(file, h) {
                return Err(error);
            }
            let array = npy::parse(file, &reader.bytes(file)?)?;
            ("numpy", Strided::rows(array.shape, array.values))
        }
        h if h.starts_with(b"PK\x03\x04") => {
            let bytes = reader.bytes(file)?;
            let names = npy::names_npz(file, &bytes)?;
            if description.array.is_none() && consumer_nlos::is_frame(&names) {
                return consumer_nlos::read(file, &bytes, &names, description);
            }
            let name = chosen(file, &names, description)?;
            let array = npy::parse_npz(file, &bytes, name, MOST_VALUES)?;
            ("numpy", Strided::rows(array.shape, array.values))
        }
        h if is_matlab(h, file) => ("matlab", matlab(file, description, reader)?),
        h if h.starts_with(ptu::MAGIC) => return ptu::read(file, description, described, reader),
        h if is_hdf5(h) => return h5::read(file, description, described, reader),
        h if h.get(257..262) == Some(&b"ustar"[..]) => return own::webdataset(file, reader),
        h if is_text(h) => return tables::read(file, description, described, reader),
        h => {
            return Err(unknown(
                file,
                &format!("an unknown file that begins with {}", shown(h)),
            ));
        }
    };
    ordered(file, format, array, description)
}

/// Puts the axes of an array in order.
pub(super) fn ordered(
    file: &Path,
    format: &str,
    array: Strided,
    description: &Description,
) -> Result<Part, ImportError> {
    let mut notes = Vec::new();
    let axes = description.axes.as_deref();
    let (dims, apart, values) = array.ordered(file, axes, description.pixels, &mut notes)?;
    Ok(Part {
        file: file.to_owned(),
        format: format.into(),
        dims,
        apart,
        values,
        stated: Stated::default(),
        notes,
        outside: 0.0,
        binned: false,
    })
}

/// The error for a file that cannot be read: what it looks like, and how to describe it.
pub(super) fn unknown(file: &Path, looks: &str) -> ImportError {
    let hint = format!(
        "save the histograms as .npy, .npz, .mat or HDF5, or photon events as a table (.csv), and describe them, for example\n{EXAMPLE}"
    );
    ImportError::unreadable(file, format!("looks like {looks}"), hint)
}

/// The first bytes as text.
fn shown(head: &[u8]) -> String {
    let bytes = &head[..head.len().min(16)];
    format!("{:?}", String::from_utf8_lossy(bytes))
}

fn is_text(head: &[u8]) -> bool {
    let plain = |b: &u8| matches!(b, b'\t' | b'\r' | b'\n' | 0x20..=0x7e);
    !head.is_empty() && head.iter().all(plain)
}

/// Version 5, or version 7.3, which is HDF5.
fn is_matlab(head: &[u8], file: &Path) -> bool {
    let version_5 = head.len() >= 128 && matches!(&head[126..128], b"IM" | b"MI");
    let named = file.extension().is_some_and(|e| e == "mat");
    version_5 || (is_hdf5(head) && (named || head.starts_with(b"MATLAB")))
}

fn matlab(file: &Path, description: &Description, reader: &Files) -> Result<Strided, ImportError> {
    let mat = Mat::open(file, reader)?;
    let names = mat.names();
    if let (None, Some(array)) = (&description.array, confocal(&names)) {
        let what = format!(
            "looks like a confocal scan of a relay wall (Stanford's layout, with the array {array}): each pixel is lit by a laser point of its own. A capture of picofarm has spots that light all pixels, and shadows compare pixels of one spot, so this scan has neither"
        );
        let hint = "record with a fixed laser point, or a few, and the detector's whole grid for each; for confocal scans use a solver for hidden scenes, such as the light-cone transform or f-k migration";
        return Err(ImportError::unreadable(file, what, hint));
    }
    let name = chosen(file, &names, description)?;
    let matrix = mat.matrix(name)?;
    let values = matrix.values.iter().map(|x| *x as f32).collect();
    Ok(Strided::columns(matrix.dims, values))
}

/// The array of a confocal scan: `rect_data` with `width` (O'Toole et al. 2018), or `meas` with
/// `tofgrid` (Lindell et al. 2019).
fn confocal(names: &[String]) -> Option<&'static str> {
    let has = |name: &str| names.iter().any(|n| n == name);
    match () {
        () if has("rect_data") && has("width") => Some("rect_data"),
        () if has("meas") && has("tofgrid") => Some("meas"),
        () => None,
    }
}

/// The array of the description, or the only one.
pub(super) fn chosen<'a>(
    file: &Path,
    names: &'a [String],
    description: &Description,
) -> Result<&'a str, ImportError> {
    let found = match &description.array {
        Some(name) => names.iter().find(|n| *n == name),
        None => (names.len() == 1).then(|| names.first()).flatten(),
    };
    found.map(String::as_str).ok_or_else(|| {
        let expected = match &description.array {
            Some(name) => format!("{name:?}"),
            None => "one array".into(),
        };
        let hint = format!(
            "name the array of the histograms with \"array\" in the description, for example\n{EXAMPLE}"
        );
        ImportError::refused(file, "arrays", expected, format!("{names:?}"), hint)
    })
}
