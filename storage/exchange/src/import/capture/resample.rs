//! Captures on another gate, scale and image, without losing photons unseen.

use std::fmt;

use picofarm_dataset::{Gate, Intrinsics};
use picofarm_sensor::{SensorError, resample};
use rayon::prelude::*;

use super::{Beam, Capture};

/// Most rows or columns of an image, as data sets have.
const MOST_SIDE: u64 = 1 << 14;
/// Most bins of a gate, as data sets have.
const MOST_BINS: f64 = 262_144.0;

/// The changes. The default changes nothing, to the bit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Resampling {
    /// Start of the gate, metres of path after scaling.
    pub start_m: Option<f64>,
    /// Width of a bin, metres of path after scaling.
    pub bin_width_m: Option<f64>,
    /// Number of bins; without it, as many as cover the old gate's end.
    pub bins: Option<u32>,
    /// Factor of all lengths: paths, laser, spots and depth.
    pub scale: f64,
    /// First column, first row, columns and rows to keep.
    pub crop: Option<[u32; 4]>,
    /// Dark columns and rows to add: left, top, right, bottom.
    pub pad: [u32; 4],
    /// Adds dark columns and rows until the camera's axis is within half a pixel of the middle.
    pub centre: bool,
}

impl Default for Resampling {
    fn default() -> Self {
        Self {
            start_m: None,
            bin_width_m: None,
            bins: None,
            scale: 1.0,
            crop: None,
            pad: [0; 4],
            centre: false,
        }
    }
}

impl fmt::Display for Resampling {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut all = Vec::new();
        let mut add = |name: &str, value: Option<String>| {
            all.extend(value.map(|value| format!("{name} {value}")));
        };
        let list = |list: [u32; 4]| list.map(|n| n.to_string()).join(",");
        add("start-m", self.start_m.map(|x| x.to_string()));
        add("bin-width-m", self.bin_width_m.map(|x| x.to_string()));
        add("bins", self.bins.map(|n| n.to_string()));
        add("scale", (self.scale != 1.0).then(|| self.scale.to_string()));
        add("crop", self.crop.map(list));
        add("pad", (self.pad != [0; 4]).then(|| list(self.pad)));
        add("centre", self.centre.then(String::new));
        f.write_str(all.join(", ").trim_end())
    }
}

/// A window of an image in pixels: it may reach beyond the image, where it is dark.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Window {
    left: i64,
    top: i64,
    columns: u32,
    rows: u32,
}

impl Capture {
    /// Returns the capture on another gate, scale and image. Photons are kept: those outside the
    /// new gate are added to [`super::Origin::outside`], and those of pixels outside the new image
    /// to [`super::Origin::cropped`].
    ///
    /// # Errors
    /// [`SensorError::Invalid`] names the field of `to` that is out of range.
    pub fn resampled(&self, to: &Resampling) -> Result<Self, SensorError> {
        let window = self.window(to)?;
        let gate = self.new_gate(to)?;
        let planes = |all: &[f32]| -> Result<(Vec<f32>, [f64; 2]), SensorError> {
            let (cut, dropped) = self.cut(all, self.gate.bins as usize, &window);
            let made = resample(&cut, &self.gate, &gate, to.scale)?;
            Ok((made.data, [made.outside, dropped]))
        };
        let (sum, [outside, cropped]) = planes(&self.sum)?;
        let per_spot = match &self.per_spot {
            None => None,
            Some(all) => Some(planes(all)?.0),
        };
        // The sum of resampled histograms, so that both stay equal to the bit.
        let sum = match &per_spot {
            Some(all) => super::arrays::sum(all, self.beams.len()),
            None => sum,
        };
        let i = self.intrinsics;
        let mut origin = self.origin.clone();
        origin.outside += outside;
        origin.cropped += cropped;
        if *to != Resampling::default() {
            origin.conversions.push(format!("resampled: {to}"));
        }
        let scale = to.scale as f32;
        let beam = |beam: &Beam| match beam {
            Beam::Spot { position, path_m } => Beam::Spot {
                position: position.map(|x| x * scale),
                path_m: path_m * scale,
            },
            other => *other,
        };
        let depth = self.depth.as_ref().map(|depth| {
            let (cut, _) = self.cut(depth, 1, &window);
            cut.into_iter().map(|z| z * scale).collect()
        });
        Ok(Self {
            name: self.name.clone(),
            height: window.rows,
            width: window.columns,
            gate,
            sum,
            per_spot,
            intrinsics: Intrinsics {
                cx: i.cx - window.left as f32,
                cy: i.cy - window.top as f32,
                ..i
            },
            laser: self.laser.map(|x| x * scale),
            beams: self.beams.iter().map(beam).collect(),
            depth,
            origin,
        })
    }

    fn window(&self, to: &Resampling) -> Result<Window, SensorError> {
        let [x, y, columns, rows] = to.crop.unwrap_or([0, 0, self.width, self.height]);
        let fits = |first: u32, n: u32, of: u32| {
            n > 0 && first.checked_add(n).is_some_and(|end| end <= of)
        };
        if !(fits(x, columns, self.width) && fits(y, rows, self.height)) {
            let what = format!(
                "expected a part of {} columns and {} rows, found {columns}x{rows} from ({x}, {y})",
                self.width, self.height
            );
            return Err(SensorError::new("crop", what));
        }
        let mut pad = to.pad.map(u64::from);
        if to.centre {
            let i = self.intrinsics;
            for (low, high, axis, first, n) in [(0, 2, i.cx, x, columns), (1, 3, i.cy, y, rows)] {
                let size = f64::from(n) + (pad[low] + pad[high]) as f64;
                let at = f64::from(axis) - f64::from(first) + pad[low] as f64;
                // Dark pixels on one side move the middle by half of their number.
                let off = (2.0 * at - size).round();
                if off.abs() > MOST_SIDE as f64 {
                    let what = format!("the camera's axis is {} pixels from the middle", off / 2.0);
                    return Err(SensorError::new("centre", what));
                }
                match off > 0.0 {
                    true => pad[high] += off as u64,
                    false => pad[low] += -off as u64,
                }
            }
        }
        let [left, top, right, bottom] = pad;
        let (columns, rows) = (
            u64::from(columns) + left + right,
            u64::from(rows) + top + bottom,
        );
        if columns > MOST_SIDE || rows > MOST_SIDE {
            let what =
                format!("expected at most {MOST_SIDE} columns and rows, found {columns}x{rows}");
            return Err(SensorError::new("pad", what));
        }
        Ok(Window {
            left: i64::from(x) - left as i64,
            top: i64::from(y) - top as i64,
            columns: columns as u32,
            rows: rows as u32,
        })
    }

    fn new_gate(&self, to: &Resampling) -> Result<Gate, SensorError> {
        if !(to.scale.is_finite() && to.scale > 0.0) {
            let what = format!("expected a positive factor, found {}", to.scale);
            return Err(SensorError::new("scale", what));
        }
        let old = Gate {
            start_m: self.gate.start_m * to.scale,
            bin_width_m: self.gate.bin_width_m * to.scale,
            ..self.gate
        };
        let start_m = to.start_m.unwrap_or(old.start_m);
        let bin_width_m = to.bin_width_m.unwrap_or(old.bin_width_m);
        if !(bin_width_m.is_finite() && bin_width_m > 0.0 && start_m.is_finite()) {
            let what = format!(
                "expected a finite start and a positive width, found {start_m} and {bin_width_m}"
            );
            return Err(SensorError::new("bin_width_m", what));
        }
        // Within a millionth of a bin, the last bin is whole.
        let covering = ((old.end_m() - start_m) / bin_width_m - 1e-6).ceil();
        let bins = to.bins.map_or(covering, f64::from);
        if !(1.0..=MOST_BINS).contains(&bins) {
            let what = format!(
                "expected 1 to {MOST_BINS} bins, found {bins}: the light is between {} and {} m of path",
                old.start_m,
                old.end_m()
            );
            return Err(SensorError::new("bins", what));
        }
        Ok(Gate {
            start_m,
            bin_width_m,
            bins: bins as u32,
        })
    }

    /// Values `[…][row][column][size]` in a window, and the sum of those outside.
    fn cut(&self, all: &[f32], size: usize, window: &Window) -> (Vec<f32>, f64) {
        let (height, width) = (self.height as usize, self.width as usize);
        let planes = all.len() / (height * width * size);
        let (rows, columns) = (window.rows as usize, window.columns as usize);
        if (window.left, window.top, rows, columns) == (0, 0, height, width) {
            return (all.to_vec(), 0.0);
        }
        let mut out = vec![0.0f32; planes * rows * columns * size];
        out.par_chunks_mut(columns * size)
            .enumerate()
            .for_each(|(line, out)| {
                let (plane, row) = (line / rows, (line % rows) as i64 + window.top);
                if !(0..height as i64).contains(&row) {
                    return;
                }
                let from = (plane * height + row as usize) * width;
                for (column, out) in out.chunks_exact_mut(size).enumerate() {
                    let column = column as i64 + window.left;
                    if (0..width as i64).contains(&column) {
                        let at = (from + column as usize) * size;
                        out.copy_from_slice(&all[at..at + size]);
                    }
                }
            });
        let total = |h: &[f32]| h.iter().map(|x| f64::from(*x)).sum::<f64>();
        let dropped = total(all) - total(&out);
        (out, dropped.max(0.0))
    }
}
