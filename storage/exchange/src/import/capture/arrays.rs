//! Histograms with named axes, put into the order spot, row, column, bin.

use std::ops::Range;
use std::path::{Path, PathBuf};

use rayon::prelude::*;

use super::super::ImportError;
use super::Beam;
use picofarm_dataset::Intrinsics;

/// The names of axes, in the order of [`Part::dims`].
const ORDER: [&str; 4] = ["spot", "row", "column", "bin"];
/// Names of axes that an array may have.
const NAMES: &str = "spot, row, column, bin, each at most once; pixel (rows after rows, with \"pixels\") instead of row and column; channel (averaged)";

/// The histograms of one file.
pub(super) struct Part {
    pub file: PathBuf,
    /// Name of the file's format.
    pub format: String,
    /// Numbers of spots, rows, columns, bins.
    pub dims: [usize; 4],
    /// Whether each spot has its own histograms.
    pub apart: bool,
    /// `[spot][row][column][bin]`.
    pub values: Vec<f32>,
    pub stated: Stated,
    pub notes: Vec<String>,
    /// Photons that fell outside the bins.
    pub outside: f64,
    /// Whether the values were binned into the description's gate already.
    pub binned: bool,
}

/// The calibration that a file itself has, in the camera's axes.
#[derive(Default)]
pub(super) struct Stated {
    /// Start and width of the bins, metres of path.
    pub gate: Option<[f64; 2]>,
    pub intrinsics: Option<Intrinsics>,
    pub laser: Option<[f64; 3]>,
    pub beams: Option<Vec<Beam>>,
    /// True z-depth, `[row][column]`.
    pub depth: Option<Vec<f32>>,
}

/// An array as a file has it: the size and the stride of each axis.
pub(super) struct Strided {
    pub shape: Vec<usize>,
    pub strides: Vec<usize>,
    pub values: Vec<f32>,
}

impl Strided {
    /// Returns an array whose last axis varies fastest.
    pub fn rows(shape: Vec<usize>, values: Vec<f32>) -> Self {
        let mut strides = vec![1; shape.len()];
        for axis in (1..shape.len()).rev() {
            strides[axis - 1] = strides[axis] * shape[axis];
        }
        Self {
            shape,
            strides,
            values,
        }
    }

    /// Returns an array whose first axis varies fastest.
    pub fn columns(shape: Vec<usize>, values: Vec<f32>) -> Self {
        let mut strides = vec![1; shape.len()];
        for axis in 1..shape.len() {
            strides[axis] = strides[axis - 1] * shape[axis - 1];
        }
        Self {
            shape,
            strides,
            values,
        }
    }

    /// Puts the axes in order. Returns the sizes, whether there is an axis of spots, and the
    /// values.
    pub fn ordered(
        self,
        file: &Path,
        axes: Option<&[String]>,
        pixels: Option<[u32; 2]>,
        notes: &mut Vec<String>,
    ) -> Result<([usize; 4], bool, Vec<f32>), ImportError> {
        let refused = |expected: String, found: String, hint: &str| {
            ImportError::refused(file, "axes", expected, found, hint)
        };
        let standard: Vec<String> = match self.shape.len() {
            3 => ORDER[1..].iter().map(ToString::to_string).collect(),
            _ => ORDER.iter().map(ToString::to_string).collect(),
        };
        let names = axes.unwrap_or(&standard);
        if names.len() != self.shape.len() {
            return Err(refused(
                format!(
                    "a name for each of the {} axes {:?}",
                    self.shape.len(),
                    self.shape
                ),
                format!("{names:?}"),
                "give \"axes\" in the description, for example [\"row\", \"column\", \"bin\"]",
            ));
        }
        let mut found: [Option<(usize, usize)>; 4] = [None; 4];
        let mut channels: Option<(usize, usize)> = None;
        for ((name, size), stride) in names.iter().zip(&self.shape).zip(&self.strides) {
            let known =
                ["channel", "pixel"].contains(&name.as_str()) || ORDER.contains(&name.as_str());
            let twice = || match known {
                true => refused(
                    "each axis once, and \"pixel\" instead of \"row\" and \"column\"".into(),
                    format!("{names:?}"),
                    "correct \"axes\" in the description, for example [\"row\", \"column\", \"bin\"]",
                ),
                false => refused(
                    NAMES.into(),
                    format!("{name:?} in {names:?}"),
                    "correct \"axes\" in the description, for example [\"row\", \"column\", \"bin\"]",
                ),
            };
            match name.as_str() {
                "channel" if channels.is_none() => channels = Some((*size, *stride)),
                "pixel" if found[1].is_none() && found[2].is_none() => {
                    let Some([rows, columns]) = pixels.map(|p| p.map(|n| n as usize)) else {
                        return Err(refused(
                            "\"pixels\": [rows, columns] with the axis \"pixel\"".into(),
                            "none".into(),
                            "add it to the description",
                        ));
                    };
                    if rows * columns != *size {
                        return Err(refused(
                            format!("{rows} x {columns} pixels"),
                            format!("{size} along the axis \"pixel\""),
                            "correct \"pixels\" in the description",
                        ));
                    }
                    found[1] = Some((rows, stride * columns));
                    found[2] = Some((columns, *stride));
                }
                other => match ORDER.iter().position(|o| *o == other) {
                    Some(axis) if found[axis].is_none() => found[axis] = Some((*size, *stride)),
                    _ => return Err(twice()),
                },
            }
        }
        let apart = found[0].is_some();
        let axis = |n: usize| {
            found[n].ok_or_else(|| {
                refused(
                    format!("an axis {:?}", ORDER[n]),
                    format!("{names:?}"),
                    "name it in \"axes\" of the description, for example [\"row\", \"column\", \"bin\"]",
                )
            })
        };
        let all = [found[0].unwrap_or((1, 0)), axis(1)?, axis(2)?, axis(3)?];
        let dims = all.map(|a| a.0);
        if dims.contains(&0) {
            return Err(ImportError::refused(
                file,
                "shape",
                "at least one spot, row, column and bin",
                format!("{dims:?}"),
                "see whether it is the right array",
            ));
        }
        let channels = channels.unwrap_or((1, 0));
        let count: usize = dims.iter().product();
        let plain = Self::rows(dims.to_vec(), Vec::new()).strides;
        let in_order = all.iter().zip(&plain).all(|(a, s)| a.0 == 1 || a.1 == *s);
        if in_order && channels.0 == 1 && self.values.len() == count {
            return Ok((dims, apart, self.values));
        }
        notes.push(format!(
            "axes {names:?} put in the order spot, row, column, bin"
        ));
        if channels.0 > 1 {
            notes.push(format!("{} channels averaged", channels.0));
        }
        let values = &self.values;
        let [_, rows, columns, bins] = dims;
        let one = |pixel: usize| {
            let (spot, row, column) = (
                pixel / (rows * columns),
                pixel / columns % rows,
                pixel % columns,
            );
            let base = spot * all[0].1 + row * all[1].1 + column * all[2].1;
            (0..bins).map(move |bin| {
                let at = base + bin * all[3].1;
                match channels.0 {
                    1 => values[at],
                    n => {
                        let sum: f64 = (0..n).map(|c| f64::from(values[at + c * channels.1])).sum();
                        (sum / n as f64) as f32
                    }
                }
            })
        };
        let ordered: Vec<f32> = (0..dims[0] * rows * columns)
            .into_par_iter()
            .flat_map_iter(one)
            .collect();
        Ok((dims, apart, ordered))
    }
}

/// Returns some bins of each histogram, and the sum of the others.
pub(super) fn cut(values: &[f32], bins: usize, kept: &Range<usize>) -> (Vec<f32>, f64) {
    let mut out = Vec::with_capacity(values.len() / bins * kept.len());
    let mut outside = 0.0;
    for h in values.chunks_exact(bins) {
        out.extend_from_slice(&h[kept.clone()]);
        let rest = h[..kept.start].iter().chain(&h[kept.end..]);
        outside += rest.map(|x| f64::from(*x)).sum::<f64>();
    }
    (out, outside)
}

/// Returns the sum over spots, added as f64 in their order.
pub(super) fn sum(values: &[f32], spots: usize) -> Vec<f32> {
    let len = values.len() / spots;
    (0..len)
        .into_par_iter()
        .map(|at| {
            let all = (0..spots).map(|s| f64::from(values[s * len + at]));
            all.sum::<f64>() as f32
        })
        .collect()
}
