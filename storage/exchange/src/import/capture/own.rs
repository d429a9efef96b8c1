//! picofarm's own exports: HDF5 files and WebDataset samples. They have the light of all spots;
//! data sets with a histogram for each spot are not exported.

use std::collections::BTreeMap;
use std::io::Read;
use std::path::Path;

use picofarm_dataset::{Gate, Intrinsics, Spot};
use serde_json::Value;

use super::super::files::Files;
use super::super::{ImportError, npy};
use super::Beam;
use super::arrays::{Part, Stated};
use super::h5::H5;

/// Most bytes of a sample's part.
const MOST: u64 = 16 << 30;
const HINT: &str = "export it again with `picofarm dataset export`";

/// Shape and values of an array of an export.
type Array = (Vec<usize>, Vec<f32>);

/// Reads a scene that was exported as HDF5.
pub(super) fn hdf5(h5: &H5<'_>) -> Result<Part, ImportError> {
    let attribute = |name: &str| {
        h5.attribute(name)?
            .ok_or_else(|| h5.refused(name, "an attribute of the file", "none".into()))
    };
    let gate = Gate {
        start_m: attribute("gate_start_m")?,
        bin_width_m: attribute("bin_width_m")?,
        bins: attribute("bins")? as u32,
    };
    let mut get = |name: &str| -> Result<Option<Array>, ImportError> {
        if h5.shape(name)?.is_none() {
            return Ok(None);
        }
        let (shape, values) = h5.array(name)?;
        Ok(Some((
            shape,
            values.into_iter().map(|x| x as f32).collect(),
        )))
    };
    scene(h5.file, gate, &mut get)
}

/// Reads a WebDataset tar file of one sample: `NNNNNN.npz` and `NNNNNN.json`.
pub(super) fn webdataset(file: &Path, reader: &Files) -> Result<Part, ImportError> {
    reader.hash(file)?;
    let io = |e| ImportError::io("read", file, e);
    let mut parts: BTreeMap<String, Vec<u8>> = BTreeMap::new();
    let mut archive = tar::Archive::new(reader.open(file)?);
    for entry in archive.entries().map_err(io)? {
        let entry = entry.map_err(io)?;
        let name = entry.path().map_err(io)?.to_string_lossy().into_owned();
        if !(name.ends_with(".npz") || name.ends_with(".json")) {
            continue;
        }
        if parts.len() == 2 {
            let expected = "one sample: a capture is one scene";
            let hint = "export one scene (`picofarm dataset export --scenes`), or take one sample out of the file";
            return Err(ImportError::refused(
                file, "samples", expected, "several", hint,
            ));
        }
        let mut bytes = Vec::new();
        entry.take(MOST).read_to_end(&mut bytes).map_err(io)?;
        parts.insert(name, bytes);
    }
    let part = |end: &str| {
        let found = parts.iter().find(|(name, _)| name.ends_with(end));
        found.ok_or_else(|| {
            let names: Vec<&String> = parts.keys().collect();
            let expected = format!("a sample with NNNNNN{end}, as picofarm exports it");
            ImportError::refused(file, "samples", expected, format!("{names:?}"), HINT)
        })
    };
    let (name, npz) = part(".npz")?;
    let about: Value = serde_json::from_slice(part(".json")?.1)
        .map_err(|e| ImportError::unreadable(file, e, HINT))?;
    let gate: Gate = serde_json::from_value(about["gate"].clone()).map_err(|e| {
        ImportError::refused(
            file,
            "gate",
            "start_m, bin_width_m and bins",
            e.to_string(),
            HINT,
        )
    })?;
    let inside = file.join(name);
    let names = npy::names_npz(&inside, npz)?;
    let mut get = |name: &str| -> Result<Option<Array>, ImportError> {
        if !names.iter().any(|n| n == name) {
            return Ok(None);
        }
        let array = npy::parse_npz(&inside, npz, name, 1 << 32)?;
        Ok(Some((array.shape, array.values)))
    };
    scene(file, gate, &mut get)
}

/// The arrays of a scene as a part.
fn scene(
    file: &Path,
    gate: Gate,
    get: &mut dyn FnMut(&str) -> Result<Option<Array>, ImportError>,
) -> Result<Part, ImportError> {
    let refused = |name: &str, expected: String, found: String| {
        ImportError::refused(file, name, expected, found, HINT)
    };
    let name = "transient";
    let Some((shape, values)) = get(name)? else {
        return Err(refused(name, "histograms".into(), "none".into()));
    };
    let &[h, w, b] = &shape[..] else {
        let found = format!("{shape:?}");
        return Err(refused(name, "[row, column, bin]".into(), found));
    };
    let dims = [1, h, w, b];
    if dims[3] != gate.bins as usize {
        return Err(refused(
            name,
            format!("{} bins", gate.bins),
            dims[3].to_string(),
        ));
    }
    let intrinsics = get("intrinsics")?.map(|a| a.1);
    let laser = get("laser")?.map(|a| a.1);
    let beams = get("spots")?.map(|(_, rows)| {
        let beam = |row: &[f32]| match Spot::from_row(row) {
            Some(spot) => Beam::Spot {
                position: spot.position,
                path_m: spot.path_m,
            },
            None => Beam::Nothing,
        };
        rows.chunks_exact(7).map(beam).collect::<Vec<_>>()
    });
    if let Some(beams) = &beams
        && beams
            .iter()
            .any(|b| matches!(b, Beam::Spot { path_m, .. } if !path_m.is_finite()))
    {
        let expected = "the length of the path from the laser to each spot";
        return Err(refused("spots", expected.into(), "none".into()));
    }
    let depth = get("depth")?.map(|a| a.1);
    if depth.as_ref().is_some_and(|d| d.len() != dims[1] * dims[2]) {
        return Err(refused(
            "depth",
            format!("{}x{} pixels", dims[1], dims[2]),
            "others".into(),
        ));
    }
    Ok(Part {
        file: file.to_owned(),
        format: "picofarm".into(),
        dims,
        apart: false,
        values,
        stated: Stated {
            gate: Some([gate.start_m, gate.bin_width_m]),
            intrinsics: match intrinsics.as_deref() {
                Some(&[fx, fy, cx, cy]) => Some(Intrinsics { fx, fy, cx, cy }),
                _ => None,
            },
            laser: match laser.as_deref() {
                Some(&[x, y, z]) => Some([x, y, z].map(f64::from)),
                _ => None,
            },
            beams,
            depth,
        },
        notes: Vec::new(),
        outside: 0.0,
        binned: false,
    })
}
