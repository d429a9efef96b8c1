//! Our own minimal layout: `scene.json`, which says everything, and the `.npy` files that it names.

use std::path::{Path, PathBuf};

use serde::Deserialize;

use picofarm_files::Opener;

use super::check::check;
use super::files::Files;
use super::npy::{self, Array};
use super::profile::{Blame, Geometry};
use super::scene::{ImportedScene, Shape, clean};
use super::{DepthKind, ImportError, ImportOptions, Item, Polarity};
use crate::layout::record::Intrinsics;
use crate::layout::spec::{Gate, Subsets};

const SCENE: &str = "scene.json";
const LIGHT_M_S: f64 = 299_792_458.0;

/// `scene.json`. Nothing has a default: what is left out is not there.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Description {
    /// Always `picofarm-scene-1`.
    format: String,
    /// Unit of depth, positions and gate: `m`, `cm` or `mm`.
    length_unit: String,
    histogram: Histogram,
    camera: Camera,
    /// Laser origin in the camera's axes.
    laser: [f64; 3],
    /// `[spot][3]`: where the beams meet the scene, in the camera's axes; NaN where one meets nothing.
    spots: Spots,
    depth: Depth,
    /// `[spot][row][column]`.
    visibility: Option<Visibility>,
    /// `[row][column]`, 1 = mirror.
    specular: Option<File>,
    /// `[row][column][3]`, unit vectors in the camera's axes.
    normal: Option<File>,
    /// `[row][column]`, 0 = nothing.
    instance: Option<File>,
    /// `[row][column]`, 0 = nothing.
    label: Option<File>,
    /// `[row][column][3]`, linear, 0 to 1.
    rgb_linear: Option<File>,
    /// Photons per unit of the histogram, where known.
    photons_per_unit: Option<f32>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    file: String,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Spots {
    file: String,
    /// `[spot]`: length of each beam from the laser, in the length unit; with the reflections, where mirrors fold it.
    paths: Option<String>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Histogram {
    file: String,
    /// `row`, `column` and `bin` in the array's order.
    axes: [String; 3],
    /// Start of bin 0 and width of a bin, in `gate_unit`.
    gate_start: f64,
    bin_width: f64,
    /// `length` (optical path, in the length unit), or a time: `s`, `ns` or `ps`.
    gate_unit: String,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Camera {
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
    /// Coordinates of the centre of the first pixel: 0 or 0.5.
    pixel_centre: f64,
    /// Where x, y and z point: `right` or `left`, `down` or `up`, `forward` or `backward`.
    axes: [String; 3],
    /// Camera-to-world matrix, points as columns, translation in the length unit.
    to_world: Option<[[f64; 4]; 4]>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Depth {
    file: String,
    kind: DepthKind,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct Visibility {
    file: String,
    one_means: Polarity,
}

pub(super) fn find(root: &Path, opener: &Opener) -> Result<Vec<Item>, ImportError> {
    super::folders_with(root, opener, |folder| folder.join(SCENE).is_file())
}

pub(super) fn shape(item: &Item) -> Result<Shape, ImportError> {
    let files = item.files();
    let about = About::read(&item.folder, &files)?;
    let histogram = files.named(&about.folder, &about.is.histogram.file)?;
    let shape = npy::peek(&histogram, &files)?;
    let spots = files.named(&about.folder, &about.is.spots.file)?;
    let spots = npy::peek(&spots, &files)?;
    about.shape(&histogram, &shape, &spots)
}

pub(super) fn read(
    item: &Item,
    options: &ImportOptions,
    files: &Files,
) -> Result<ImportedScene, ImportError> {
    let about = About::read(&item.folder, files)?;
    let is = &about.is;
    let path = files.named(&about.folder, &is.histogram.file)?;
    let histogram = npy::parse(&path, &files.bytes(&path)?)?;
    let spots = about.array(&is.spots.file, files)?;
    let shape = about.shape(&path, &histogram.shape, &spots.shape)?;
    let (h, w, n) = (
        shape.height as usize,
        shape.width as usize,
        shape.spots as usize,
    );
    let mut conversions = Vec::new();
    let mut transient = about.row_column_bin(&path, histogram, &mut conversions)?;
    clean(
        &path,
        &mut transient,
        shape.gate.bins as usize,
        &mut conversions,
    )?;
    let unit = about.unit()?;
    if unit != 1.0 {
        conversions.push(format!("lengths times {unit} to metres"));
    }
    let axes = about.axes()?;
    if axes != [(0, 1.0), (1, 1.0), (2, 1.0)] {
        conversions.push(format!("axes {:?} to right, down, forward", is.camera.axes));
    }
    let to_ours = |v: [f64; 3], unit: f64| axes.map(|(from, sign)| (v[from] * sign * unit) as f32);
    let mut scene = ImportedScene::new(&item.name, shape, transient, about.intrinsics()?);
    scene.conversions = conversions;
    scene.laser = to_ours(is.laser, unit);
    let triples = |a: &Array| -> Vec<[f64; 3]> {
        let triple = |t: &[f32]| [t[0], t[1], t[2]].map(f64::from);
        a.values.chunks_exact(3).map(triple).collect()
    };
    let positions: Vec<[f32; 3]> = triples(&spots)
        .into_iter()
        .map(|p| to_ours(p, unit))
        .collect();
    scene.set_spots(&positions);
    let depth_path = about.folder.join(&is.depth.file);
    let depth = about.sized(&is.depth.file, &[h, w], files)?;
    let metres: Vec<f32> = depth
        .values
        .iter()
        .map(|d| (f64::from(*d) * unit) as f32)
        .collect();
    scene.set_depth(&depth_path, &metres, is.depth.kind == DepthKind::Range)?;
    match &is.visibility {
        None => scene.missing.push("visibility"),
        Some(v) => {
            let masks = about.sized(&v.file, &[n, h, w], files)?;
            scene.visibility = about.bits(&v.file, &masks, v.one_means == Polarity::Shadow)?;
            if v.one_means == Polarity::Shadow {
                scene
                    .conversions
                    .push("visibility turned round: 1 = lit".into());
            }
        }
    }
    match &is.specular {
        None => scene.missing.push("specular"),
        Some(f) => {
            scene.specular = about.bits(&f.file, &about.sized(&f.file, &[h, w], files)?, false)?
        }
    }
    match &is.spots.paths {
        None => scene.judge_beams(options.straight_beams),
        Some(file) => {
            let paths = about.sized(file, &[n], files)?;
            let metres = paths.values.iter().map(|x| (f64::from(*x) * unit) as f32);
            let set = scene.set_paths(&metres.collect::<Vec<_>>());
            set.map_err(|(beam, straight)| {
                ImportError::refused(
                    about.folder.join(file),
                    format!("length of beam {beam}"),
                    format!("{straight} m at least, the straight line from the laser to its spot"),
                    format!("{} m", f64::from(paths.values[beam]) * unit),
                    "correct the length, or leave spots.paths out",
                )
            })?;
        }
    }
    match &is.normal {
        None => scene.missing.push("normal"),
        Some(f) => {
            let normals = about.sized(&f.file, &[h, w, 3], files)?;
            scene.normal = triples(&normals)
                .into_iter()
                .flat_map(|v| to_ours(v, 1.0))
                .collect();
        }
    }
    match &is.instance {
        None => scene.missing.push("instance"),
        // 32-bit floats count so far exactly.
        Some(f) => scene.instance = about.counts(&f.file, &[h, w], (1 << 24) as f32, files)?,
    }
    match &is.label {
        None => scene.missing.push("label"),
        Some(f) => {
            let labels = about.counts(&f.file, &[h, w], 65_535.0, files)?;
            scene.label = labels.into_iter().map(|x| x as u16).collect();
        }
    }
    match &is.rgb_linear {
        None => scene.missing.push("rgb"),
        Some(f) => scene.rgb = about.sized(&f.file, &[h, w, 3], files)?.values,
    }
    match is.camera.to_world {
        None => scene.missing.push("camera"),
        Some(m) => scene.camera = about.pose(&m, &axes, unit),
    }
    scene.scale = is.photons_per_unit;
    if !options.unchecked {
        let geometry = Geometry {
            shape: &scene.shape,
            transient: &scene.transient,
            depth: &scene.depth,
            of_range: is.depth.kind == DepthKind::Range,
            intrinsics: scene.intrinsics,
            laser: scene.laser,
            spots: &scene.spots,
            visibility: is.visibility.as_ref().map(|_| &scene.visibility[..]),
            specular: &scene.specular,
        };
        let file = |name: &str| about.folder.join(name);
        let blame = Blame {
            histogram: &path,
            depth: &depth_path,
            spots: &file(&is.spots.file),
            visibility: &is
                .visibility
                .as_ref()
                .map_or_else(|| path.clone(), |v| file(&v.file)),
            hint: "correct scene.json",
            polarity: "visibility.one_means in scene.json",
        };
        scene.check = check(&geometry, &blame)?;
    }
    Ok(scene)
}

/// A scene's description, and where it lies.
struct About {
    folder: PathBuf,
    is: Description,
}

impl About {
    fn read(folder: &Path, files: &Files) -> Result<Self, ImportError> {
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

    fn refused(&self, field: &str, expected: &str, found: impl std::fmt::Debug) -> ImportError {
        let file = self.folder.join(SCENE);
        ImportError::refused(
            file,
            field,
            expected,
            format!("{found:?}"),
            "correct the field",
        )
    }

    fn unit(&self) -> Result<f64, ImportError> {
        match self.is.length_unit.as_str() {
            "m" => Ok(1.0),
            "cm" => Ok(0.01),
            "mm" => Ok(0.001),
            other => Err(self.refused("length_unit", "m, cm or mm", other)),
        }
    }

    /// For each of our axes (right, down, forward): which of theirs it is, and its sign.
    fn axes(&self) -> Result<[(usize, f64); 3], ImportError> {
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

    fn intrinsics(&self) -> Result<Intrinsics, ImportError> {
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

    fn gate(&self, bins: usize) -> Result<Gate, ImportError> {
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

    fn axis(&self, name: &str) -> Result<usize, ImportError> {
        let axes = &self.is.histogram.axes;
        let at = axes.iter().position(|a| a == name);
        at.ok_or_else(|| self.refused("histogram.axes", "row, column and bin, each once", axes))
    }

    fn shape(
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
            gate: self.gate(histogram[self.axis("bin")?])?,
        })
    }

    /// The histogram with its axes in our order.
    fn row_column_bin(
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

    fn array(&self, name: &str, files: &Files) -> Result<Array, ImportError> {
        let path = files.named(&self.folder, name)?;
        npy::parse(&path, &files.bytes(&path)?)
    }

    fn sized(&self, name: &str, shape: &[usize], files: &Files) -> Result<Array, ImportError> {
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

    fn bits(&self, name: &str, array: &Array, turn: bool) -> Result<Vec<u8>, ImportError> {
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

    fn counts(
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

    /// Camera-to-world from our camera axes.
    fn pose(&self, m: &[[f64; 4]; 4], axes: &[(usize, f64); 3], unit: f64) -> [[f32; 4]; 4] {
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
