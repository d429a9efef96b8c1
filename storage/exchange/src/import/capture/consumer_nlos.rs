//! Captures of sidsoma/consumer-nlos: an ST VL53L8CH that looks at a relay wall, one frame in each
//! `.npz` file, and the refusal of the ams scans there, which are pickles.
//!
//! Arrays of a frame: `hists` `[zone][bin]`, rows of zones after rows; `pt_cloud` `[zone][3]`, the
//! point of the wall that each zone sees, metres, with the wall at z = 0; `cam_z`, in some, the
//! sensor's distance from the wall, above x = y = 0. The returns of the wall itself are removed,
//! and time 0 is when light leaves the wall for the hidden scene. A bin is 250 ps. Both are stated
//! by the code there (`load_data`, and `t_res` of the settings). The flash lights the whole view.

use std::path::Path;

use picofarm_dataset::Intrinsics;

use super::super::scene::{direction, intrinsics_from_fov};
use super::super::vector::norm;
use super::super::{ImportError, npy};
use super::Beam;
use super::arrays::{Part, Stated};
use super::describe::{Description, LIGHT_M_PS};

/// Name of the format of these frames, whose paths count from a relay wall.
pub const FORMAT: &str = "consumer-nlos";
/// Names of the arrays of a frame.
const HISTOGRAMS: &str = "hists";
const POINTS: &str = "pt_cloud";
const DISTANCE: &str = "cam_z";
/// Width of a bin, picoseconds.
const BIN_PS: f64 = 250.0;
/// Field of view of the VL53L8CH, degrees (data sheet DS14161).
const VIEW_DEG: f64 = 45.0;
/// Most numbers of an array: 64 zones of 1024 bins.
const MOST_VALUES: usize = 1 << 16;

/// Whether an archive with these arrays is a frame.
pub(super) fn is_frame(names: &[String]) -> bool {
    [HISTOGRAMS, POINTS]
        .iter()
        .all(|wanted| names.iter().any(|name| name == wanted))
}

/// Reads a frame.
pub(super) fn read(
    file: &Path,
    bytes: &[u8],
    names: &[String],
    description: &Description,
) -> Result<Part, ImportError> {
    let refused = |field: &str, expected: String, found: String| {
        let hint = "see whether the file is a frame of consumer-nlos; for another layout, name the array of the \
                    histograms with \"array\" in the description";
        ImportError::refused(file, field, expected, found, hint)
    };
    let histograms = npy::parse_npz(file, bytes, HISTOGRAMS, MOST_VALUES)?;
    let &[zones, bins] = &histograms.shape[..] else {
        let found = format!("{:?}", histograms.shape);
        return Err(refused(HISTOGRAMS, "[zone][bin]".into(), found));
    };
    let [rows, columns] = match description.pixels {
        Some([rows, columns]) => [rows as usize, columns as usize],
        None => [zones.isqrt(); 2],
    };
    if rows * columns != zones || zones == 0 || bins == 0 {
        let expected = match description.pixels {
            Some(_) => format!("{rows} x {columns} zones, as \"pixels\" says"),
            None => {
                "a square of zones (16 or 64), or \"pixels\": [rows, columns] in the description"
                    .into()
            }
        };
        return Err(refused(
            HISTOGRAMS,
            expected,
            format!("{zones} zones of {bins} bins"),
        ));
    }
    let points = npy::parse_npz(file, bytes, POINTS, MOST_VALUES)?;
    if points.shape != [zones, 3] {
        let found = format!("{:?}", points.shape);
        return Err(refused(POINTS, format!("[{zones}, 3]"), found));
    }
    let sensor_m = match names.iter().any(|name| name == DISTANCE) {
        false => None,
        true => {
            let array = npy::parse_npz(file, bytes, DISTANCE, 1)?;
            match array.values[..] {
                [z] if z.is_finite() && z > 0.0 => Some(f64::from(z)),
                _ => {
                    let found = format!("{:?}", array.values);
                    return Err(refused(DISTANCE, "one distance in metres".into(), found));
                }
            }
        }
    };
    let intrinsics = intrinsics_from_fov(columns as u32, rows as u32, VIEW_DEG);
    let (beams, depth) = wall(intrinsics, columns, &points.values, sensor_m);
    let mut notes = vec![
        format!(
            "{rows}x{columns} zones of an ST VL53L8CH, {VIEW_DEG}° wide, bins of {BIN_PS} ps; the flash lights the \
             whole view, and the middle of each zone stands for it as a spot"
        ),
        "paths count from the relay wall to the hidden scene and back to the wall, and the wall's own returns are \
         removed, as in the file: depth and shadows of the hidden scene cannot be found from them"
            .into(),
    ];
    notes.push(match sensor_m {
        Some(z) => format!(
            "the sensor is {z:.4} m in front of the wall's plane; depth is that of the wall"
        ),
        None => "the file does not say where the sensor is, so the wall's depth is unknown".into(),
    });
    Ok(Part {
        file: file.to_owned(),
        format: FORMAT.into(),
        dims: [1, rows, columns, bins],
        apart: false,
        values: histograms.values,
        stated: Stated {
            gate: Some([0.0, BIN_PS * LIGHT_M_PS]),
            intrinsics: Some(intrinsics),
            laser: Some([0.0; 3]),
            beams: Some(beams),
            depth,
        },
        notes,
        outside: 0.0,
        binned: false,
    })
}

/// Returns the beams to the middles of the zones, and the depth of the wall, if the sensor's place
/// is known: its distance to each point is the range along the zone's ray.
fn wall(
    intrinsics: Intrinsics,
    columns: usize,
    points: &[f32],
    sensor_m: Option<f64>,
) -> (Vec<Beam>, Option<Vec<f32>>) {
    let mut depth = Vec::new();
    let beams = points.chunks_exact(3).enumerate().map(|(zone, p)| {
        let ray = direction(intrinsics, zone / columns, zone % columns);
        let length = norm(ray);
        let Some(sensor) = sensor_m else {
            return Beam::Direction(ray.map(|x| (x / length) as f32));
        };
        let range = norm([f64::from(p[0]), f64::from(p[1]), f64::from(p[2]) - sensor]);
        if !range.is_finite() || range <= 0.0 {
            depth.push(0.0);
            return Beam::Nothing;
        }
        depth.push((range / length) as f32);
        Beam::Spot {
            position: ray.map(|x| (x * range / length) as f32),
            path_m: range as f32,
        }
    });
    let beams = beams.collect();
    (beams, sensor_m.map(|_| depth))
}

/// Returns the error about a `.npy` file of pickled Python objects, if it is one. `head` is the
/// file's beginning.
pub(super) fn pickled(file: &Path, head: &[u8]) -> Option<ImportError> {
    let has = |wanted: &[u8]| head.windows(wanted.len()).any(|w| w == wanted);
    if !(head.starts_with(b"\x93NUMPY") && has(b"'|O'")) {
        return None;
    }
    let what = "holds pickled Python objects, which are programs: picofarm does not run them";
    if !(has(b"numpy") && has(b"histogram")) {
        let hint = "save the histograms alone, as an array of numbers, with numpy.save";
        return Some(ImportError::unreadable(file, what, hint));
    }
    // Bins of 88 ps and time 0 in bin 13 are the calibration there; the distances fit them.
    let what = format!("{what} (it looks like an ams scan of consumer-nlos)");
    let hint = "if you trust the file, convert it: python3 -c \"import numpy; \
                numpy.save('hists.npy', numpy.load('iter_0.npy', allow_pickle=True).item()['histogram'])\"; then import \
                hists.npy with the description {\"gate\": {\"t0_ps\": 1144, \"bin_width_ps\": 88}, \
                \"camera\": {\"fov_deg\": 33}, \"laser_m\": [0, 0, 0], \"directions\": [[0, 0, 1]]}";
    Some(ImportError::unreadable(file, what, hint))
}
