//! `scene.json`, and the arrays that it names with their expected shapes.

use std::path::{Path, PathBuf};

use super::super::ImportError;
use super::super::files::Files;
use super::super::npy::{self, Array};
use super::super::scene::Shape;
use super::{Description, SCENE};
use picofarm_dataset::Intrinsics;
use picofarm_dataset::{Gate, Subsets};

const LIGHT_M_S: f64 = 299_792_458.0;

/// A scene's description, and its location.
pub(super) struct About {
    pub folder: PathBuf,
    pub is: Description,
}

impl About {
    pub fn read(folder: &Path, files: &Files) -> Result<Self, ImportError> {
        let path = folder.join(SCENE);
        let is: Description = serde_json::from_slice(&files.bytes(&path)?).map_err(|e| {
            ImportError::unreadable(
                &path,
                e,
                "see `picofarm dataset import --help` for its fields",
            )
        })?;
        let about = Self {
            folder: folder.to_owned(),
            is,
        };
        if about.is.format != "picofarm-scene-1" {
            return Err(about.refused("format", "picofarm-scene-1", &about.is.format));
        }
        Ok(about)
    }

    pub fn refused(&self, field: &str, expected: &str, found: impl std::fmt::Debug) -> ImportError {
        let file = self.folder.join(SCENE);
        ImportError::refused(
            file,
            field,
            expected,
            format!("{found:?}"),
            "correct the field",
        )
    }

    pub fn unit(&self) -> Result<f64, ImportError> {
        match self.is.length_unit.as_str() {
            "m" => Ok(1.0),
            "cm" => Ok(0.01),
            "mm" => Ok(0.001),
            other => Err(self.refused("length_unit", "m, cm or mm", other)),
        }
    }

    /// Returns, for each of our axes (right, down, forward), the index of the file's axis and its
    /// sign.
    pub fn axes(&self) -> Result<[(usize, f64); 3], ImportError> {
        let expected = "right or left, down or up, forward or backward, each once";
        let mut axes = [None; 3];
        for (from, name) in self.is.camera.axes.iter().enumerate() {
            let (to, sign) = match name.as_str() {
                "right" => (0, 1.0),
                "left" => (0, -1.0),
                "down" => (1, 1.0),
                "up" => (1, -1.0),
                "forward" => (2, 1.0),
                "backward" => (2, -1.0),
                _ => return Err(self.refused("camera.axes", expected, &self.is.camera.axes)),
            };
            axes[to] = Some((from, sign));
        }
        let all: Option<Vec<(usize, f64)>> = axes.into_iter().collect();
        let all = all.ok_or_else(|| self.refused("camera.axes", expected, &self.is.camera.axes))?;
        Ok([all[0], all[1], all[2]])
    }

    pub fn intrinsics(&self) -> Result<Intrinsics, ImportError> {
        let c = &self.is.camera;
        if !(c.fx > 0.0 && c.fy > 0.0) {
            return Err(self.refused(
                "camera.fx, fy",
                "positive focal lengths in pixels",
                [c.fx, c.fy],
            ));
        }
        let shift = match c.pixel_centre {
            0.0 => 0.5,
            0.5 => 0.0,
            other => return Err(self.refused("camera.pixel_centre", "0 or 0.5", other)),
        };
        Ok(Intrinsics {
            fx: c.fx as f32,
            fy: c.fy as f32,
            cx: (c.cx + shift) as f32,
            cy: (c.cy + shift) as f32,
        })
    }

    pub fn gate(&self, bins: usize) -> Result<Gate, ImportError> {
        let h = &self.is.histogram;
        let metres = match h.gate_unit.as_str() {
            "length" => self.unit()?,
            "s" => LIGHT_M_S,
            "ns" => LIGHT_M_S * 1e-9,
            "ps" => LIGHT_M_S * 1e-12,
            other => return Err(self.refused("histogram.gate_unit", "length, s, ns or ps", other)),
        };
        Ok(Gate {
            start_m: h.gate_start * metres,
            bin_width_m: h.bin_width * metres,
            bins: bins as u32,
        })
    }

    pub fn axis(&self, name: &str) -> Result<usize, ImportError> {
        let axes = &self.is.histogram.axes;
        let at = axes.iter().position(|a| a == name);
        at.ok_or_else(|| self.refused("histogram.axes", "row, column and bin, each once", axes))
    }

    pub fn shape(
        &self,
        file: &Path,
        histogram: &[usize],
        spots: &[usize],
    ) -> Result<Shape, ImportError> {
        let hint = "save the arrays as scene.json says, or correct it";
        if histogram.len() != 3 {
            let found = format!("{histogram:?}");
            return Err(ImportError::refused(
                file,
                "shape",
                "three axes: row, column, bin",
                found,
                hint,
            ));
        }
        if spots.len() != 2 || spots[1] != 3 {
            let (file, found) = (self.folder.join(&self.is.spots.file), format!("{spots:?}"));
            return Err(ImportError::refused(
                file,
                "shape",
                "[spots, 3]",
                found,
                hint,
            ));
        }
        Ok(Shape {
            height: histogram[self.axis("row")?] as u32,
            width: histogram[self.axis("column")?] as u32,
            spots: spots[0] as u32,
            subsets: Subsets::NONE,
            two_bounce: self.is.two_bounce.is_some(),
            gate: self.gate(histogram[self.axis("bin")?])?,
        })
    }

    /// Returns the histogram with its axes in our order.
    pub fn row_column_bin(
        &self,
        file: &Path,
        a: Array,
        conversions: &mut Vec<String>,
    ) -> Result<Vec<f32>, ImportError> {
        let order = [self.axis("row")?, self.axis("column")?, self.axis("bin")?];
        if order == [0, 1, 2] {
            return Ok(a.values);
        }
        conversions.push(format!(
            "{} transposed from {:?}",
            file.file_name().unwrap_or_default().to_string_lossy(),
            self.is.histogram.axes
        ));
        let strides = [a.shape[1] * a.shape[2], a.shape[2], 1];
        let [rows, columns, bins] = order.map(|axis| a.shape[axis]);
        let [row, column, bin] = order.map(|axis| strides[axis]);
        let mut out = Vec::with_capacity(a.values.len());
        for r in 0..rows {
            for c in 0..columns {
                let base = r * row + c * column;
                out.extend((0..bins).map(|b| a.values[base + b * bin]));
            }
        }
        Ok(out)
    }

    pub fn array(&self, name: &str, files: &Files) -> Result<Array, ImportError> {
        let path = files.named(&self.folder, name)?;
        npy::parse(&path, &files.bytes(&path)?)
    }

    pub fn sized(&self, name: &str, shape: &[usize], files: &Files) -> Result<Array, ImportError> {
        let array = self.array(name, files)?;
        match array.shape == shape {
            true => Ok(array),
            false => Err(ImportError::refused(
                self.folder.join(name),
                "shape",
                format!("{shape:?}, as the histogram and the spots have it"),
                format!("{:?}", array.shape),
                "save it in this shape",
            )),
        }
    }

    pub fn bits(&self, name: &str, array: &Array, turn: bool) -> Result<Vec<u8>, ImportError> {
        let bit = |x: &f32| match *x {
            0.0 => Some(u8::from(turn)),
            1.0 => Some(u8::from(!turn)),
            _ => None,
        };
        let bits: Option<Vec<u8>> = array.values.iter().map(bit).collect();
        bits.ok_or_else(|| {
            let odd = array.values.iter().find(|x| bit(x).is_none());
            let found = format!("{}", odd.copied().unwrap_or_default());
            let hint = "threshold the mask before saving it";
            ImportError::refused(self.folder.join(name), "values", "0 and 1", found, hint)
        })
    }

    pub fn counts(
        &self,
        name: &str,
        shape: &[usize],
        max: f32,
        files: &Files,
    ) -> Result<Vec<u32>, ImportError> {
        let array = self.sized(name, shape, files)?;
        if let Some(odd) = array
            .values
            .iter()
            .find(|x| !(0.0..=max).contains(*x) || x.fract() != 0.0)
        {
            let expected = format!("whole numbers from 0 to {max}");
            let hint = "number them anew, 0 for nothing";
            return Err(ImportError::refused(
                self.folder.join(name),
                "values",
                expected,
                odd.to_string(),
                hint,
            ));
        }
        Ok(array.values.into_iter().map(|x| x as u32).collect())
    }

    /// Returns camera-to-world for our camera axes.
    pub fn pose(&self, m: &[[f64; 4]; 4], axes: &[(usize, f64); 3], unit: f64) -> [[f32; 4]; 4] {
        let mut pose = [[0.0; 4]; 4];
        for (row, out) in m.iter().zip(&mut pose).take(3) {
            for (to, (from, sign)) in axes.iter().enumerate() {
                out[to] = (row[*from] * sign) as f32;
            }
            out[3] = (row[3] * unit) as f32;
        }
        pose[3][3] = 1.0;
        pose
    }
}
