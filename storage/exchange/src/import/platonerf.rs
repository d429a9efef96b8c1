//! PlatoNeRF's simulated captures: `transforms_train.json` and, for each illumination spot, a
//! `.npy` file `[row][column][bin]` of half floats.
//!
//! The field of view is in degrees (NeRF's own convention is radians). Lights are given in a world
//! with x right, y up, z backward. In the camera's matrix, rows x and z have the wrong sign, which
//! their code corrects after loading. The files do not contain the gate: 15 m from 0 in bins of
//! 0.0384 m. They have no depth or shadows. What can be checked: one-bounce light is brightest at
//! the laser's target.

use std::path::{Path, PathBuf};

use serde::Deserialize;
use serde_json::{Value, json};

use picofarm_files::Opener;

use super::files::Files;
use super::scene::{ImportedScene, Shape, clean, of_fov};
use super::vector::norm;
use super::{Captures, ImportError, ImportOptions, Item, npy};
use picofarm_dataset::Intrinsics;
use picofarm_dataset::{Gate, Subsets};

const TRANSFORMS: &str = "transforms_train.json";
/// Maximum distance in pixels of the brightest pixel from the laser's target.
const NEAR_PX: f64 = 3.0;

#[derive(Debug, Deserialize)]
struct Transforms {
    camera_angle_x: Value,
    frames: Vec<Frame>,
    #[serde(default)]
    walls: Vec<Wall>,
}

#[derive(Debug, Clone, Deserialize)]
struct Frame {
    file_path: String,
    transform_matrix: [[f64; 4]; 4],
    light_origin: [f64; 3],
    light_direction: [f64; 3],
    #[serde(default)]
    wall_idx_light: Value,
}

/// A plane with spots.
#[derive(Debug, Clone, Deserialize)]
struct Wall {
    /// Normal.
    plane: Vec<f64>,
    point: Vec<f64>,
}

pub(super) fn find(
    root: &Path,
    options: &ImportOptions,
    opener: &Opener,
) -> Result<Vec<Item>, ImportError> {
    let folders = super::folders_with(root, opener, |folder| folder.join(TRANSFORMS).is_file())?;
    if options.captures == Captures::Sum {
        return Ok(folders);
    }
    let mut items = Vec::new();
    for item in folders {
        let (_, transforms) = read_transforms(&item.folder, &item.files())?;
        for (capture, frame) in transforms.frames.iter().enumerate() {
            let short = frame.file_path.rsplit('/').next().unwrap_or_default();
            items.push(Item {
                name: format!("{}/{short}", item.name),
                folder: item.folder.clone(),
                capture: Some(capture),
                opener: opener.clone(),
            });
        }
    }
    Ok(items)
}

fn read_transforms(folder: &Path, files: &Files) -> Result<(PathBuf, Transforms), ImportError> {
    let path = folder.join(TRANSFORMS);
    let transforms: Transforms = serde_json::from_slice(&files.bytes(&path)?).map_err(|e| {
        ImportError::unreadable(
            &path,
            e,
            "expected camera_angle_x, frames and walls as PlatoNeRF has them",
        )
    })?;
    if transforms.frames.is_empty() {
        return Err(ImportError::refused(
            &path,
            "frames",
            "at least one",
            "none",
            "see preprocess_tof.py of PlatoNeRF",
        ));
    }
    Ok((path, transforms))
}

fn histogram_file(folder: &Path, frame: &Frame, files: &Files) -> Result<PathBuf, ImportError> {
    let path = files.named(folder, &frame.file_path)?;
    Ok(path.with_extension("npy"))
}

fn chosen(item: &Item, transforms: &Transforms) -> Vec<Frame> {
    match item.capture {
        Some(capture) => transforms
            .frames
            .get(capture)
            .cloned()
            .into_iter()
            .collect(),
        None => transforms.frames.clone(),
    }
}

pub(super) fn shape(item: &Item, options: &ImportOptions) -> Result<Shape, ImportError> {
    let files = item.files();
    let (path, transforms) = read_transforms(&item.folder, &files)?;
    let frames = chosen(item, &transforms);
    let Some(first) = frames.first() else {
        return Err(ImportError::refused(
            path,
            "frames",
            "as many as before",
            "fewer",
            "open the source again",
        ));
    };
    let file = histogram_file(&item.folder, first, &files)?;
    shape_of(&file, &npy::peek(&file, &files)?, frames.len(), options)
}

fn shape_of(
    file: &Path,
    shape: &[usize],
    spots: usize,
    options: &ImportOptions,
) -> Result<Shape, ImportError> {
    let [height, width, bins] = shape[..] else {
        let found = format!("{shape:?}");
        return Err(ImportError::refused(
            file,
            "shape",
            "[rows, columns, bins]",
            found,
            "save it so",
        ));
    };
    Ok(Shape {
        height: height as u32,
        width: width as u32,
        spots: spots as u32,
        subsets: Subsets::NONE,
        two_bounce: false,
        gate: Gate {
            start_m: options.gate_start_m.unwrap_or(0.0),
            bin_width_m: options.bin_width_m.unwrap_or(0.0384),
            bins: bins as u32,
        },
    })
}

/// Returns the horizontal field of view in degrees.
fn fov(path: &Path, transforms: &Transforms, options: &ImportOptions) -> Result<f64, ImportError> {
    if let Some(degrees) = options.fov_deg {
        return Ok(degrees);
    }
    let stated = match &transforms.camera_angle_x {
        Value::Number(n) => n.as_f64(),
        Value::String(s) => s.parse().ok(),
        _ => None,
    };
    match stated.filter(|x| (4.0..179.0).contains(x)) {
        Some(degrees) => Ok(degrees),
        None => Err(ImportError::refused(
            path,
            "camera_angle_x",
            "4 to 179 degrees (less may be radians)",
            transforms.camera_angle_x.to_string(),
            "give --fov-deg",
        )),
    }
}

pub(super) fn read(
    item: &Item,
    options: &ImportOptions,
    files: &Files,
) -> Result<ImportedScene, ImportError> {
    let (path, transforms) = read_transforms(&item.folder, files)?;
    let degrees = fov(&path, &transforms, options)?;
    let frames = chosen(item, &transforms);
    let mut conversions = Vec::new();
    let mut total: Option<(Shape, Vec<f32>)> = None;
    let (mut positions, mut checks, mut pose) = (Vec::new(), Vec::new(), None);
    for frame in &frames {
        let file = histogram_file(&item.folder, frame, files)?;
        let array = npy::parse(&file, &files.bytes(&file)?)?;
        let shape = shape_of(&file, &array.shape, frames.len(), options)?;
        let mut h = array.values;
        clean(&file, &mut h, shape.gate.bins as usize, &mut conversions)?;
        let camera = Pose::of(&path, frame)?;
        if *pose.get_or_insert(camera) != camera {
            let hint = "import captures as scenes of their own: --captures separate";
            return Err(ImportError::refused(
                &path,
                "transform_matrix",
                "the same for all summed captures",
                "others",
                hint,
            ));
        }
        let intrinsics = of_fov(shape.width, shape.height, degrees);
        let spot = Spotted::find(&camera, frame, &shape, intrinsics, &h);
        if !options.unchecked {
            checks.push(spot.check(&path, &file, &transforms, frame, &camera, &shape)?);
        }
        positions.push(spot.position.map(|x| x as f32));
        match &mut total {
            None => total = Some((shape, h)),
            Some((first, sum)) => {
                if let Some((field, expected, found)) = first.difference(&shape) {
                    return Err(ImportError::refused(
                        &file,
                        field,
                        expected,
                        found,
                        "sum captures of one shape",
                    ));
                }
                sum.iter_mut().zip(&h).for_each(|(s, h)| *s += h);
            }
        }
    }
    let (Some((shape, transient)), Some(pose)) = (total, pose) else {
        return Err(ImportError::refused(
            path,
            "frames",
            "as many as before",
            "fewer",
            "open the source again",
        ));
    };
    let mut scene = ImportedScene::new(
        &item.name,
        shape,
        transient,
        of_fov(shape.width, shape.height, degrees),
    );
    conversions.push(format!(
        "field of view {degrees}°; gate from {} m in bins of {} m",
        shape.gate.start_m, shape.gate.bin_width_m
    ));
    conversions.push("light and camera from axes right, up, backward to right, down, forward; rows x and z of transform_matrix turned round".into());
    conversions.push(
        "spots found along light_direction at the brightest bin of the brightest pixel".into(),
    );
    if frames.len() > 1 {
        conversions.push(format!("{} captures summed", frames.len()));
    }
    scene.conversions = conversions;
    scene.laser = pose.in_camera(frames[0].light_origin).map(|x| x as f32);
    scene.set_spots(&positions);
    // The spots were computed from straight beams.
    scene.judge_beams(true);
    scene.camera = pose.ours();
    scene.missing.extend([
        "depth",
        "range",
        "visibility",
        "specular",
        "normal",
        "instance",
        "label",
        "rgb",
    ]);
    if !options.unchecked {
        scene.check = Value::Array(checks);
    }
    Ok(scene)
}

/// A camera in the files' world: rotation and centre, camera axes right, up, backward.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Pose {
    rotation: [[f64; 3]; 3],
    centre: [f64; 3],
}

impl Pose {
    fn of(file: &Path, frame: &Frame) -> Result<Self, ImportError> {
        let mut m = frame.transform_matrix;
        for row in [0, 2] {
            m[row] = m[row].map(|x| 0.0 - x);
        }
        let rotation = [0, 1, 2].map(|r| [m[r][0], m[r][1], m[r][2]]);
        let dot = |a: usize, b: usize| (0..3).map(|k| rotation[a][k] * rotation[b][k]).sum::<f64>();
        let cross = |k: usize| {
            let (i, j) = ((k + 1) % 3, (k + 2) % 3);
            rotation[0][i] * rotation[1][j] - rotation[0][j] * rotation[1][i]
        };
        let right_handed = (0..3).all(|k| libm::fabs(cross(k) - rotation[2][k]) < 1e-4);
        let unit =
            (0..2).all(|r| libm::fabs(dot(r, r) - 1.0) < 1e-4) && libm::fabs(dot(0, 1)) < 1e-4;
        if !(unit && right_handed) {
            let found = format!("{:?}", frame.transform_matrix);
            return Err(ImportError::refused(
                file,
                "transform_matrix",
                "a rotation and a translation",
                found,
                "correct the file",
            ));
        }
        Ok(Self {
            rotation,
            centre: [m[0][3], m[1][3], m[2][3]],
        })
    }

    /// Returns a vector of the world in our camera axes.
    fn turned(&self, v: [f64; 3]) -> [f64; 3] {
        let along = |axis: usize| (0..3).map(|r| self.rotation[r][axis] * v[r]).sum::<f64>();
        // 0 - x avoids negative zeros.
        [along(0), 0.0 - along(1), 0.0 - along(2)]
    }

    fn in_camera(&self, p: [f64; 3]) -> [f64; 3] {
        self.turned([0, 1, 2].map(|k| p[k] - self.centre[k]))
    }

    /// Returns camera-to-world for our camera axes.
    fn ours(&self) -> [[f32; 4]; 4] {
        let mut m = super::scene::IDENTITY;
        for (row, out) in m.iter_mut().enumerate().take(3) {
            let r = self.rotation[row];
            *out = [r[0], 0.0 - r[1], 0.0 - r[2], self.centre[row]].map(|x| x as f32);
        }
        m
    }
}

/// The source of one-bounce light.
struct Spotted {
    /// Position in the camera frame.
    position: [f64; 3],
    /// Path of the brightest bin.
    path_m: f64,
    /// Column and row of the brightest pixel's centre, and the projection of the spot.
    brightest: [f64; 2],
    projected: [f64; 2],
}

impl Spotted {
    fn find(pose: &Pose, frame: &Frame, shape: &Shape, i: Intrinsics, h: &[f32]) -> Self {
        let bins = shape.gate.bins as usize;
        let at = (0..h.len())
            .max_by(|a, b| h[*a].total_cmp(&h[*b]))
            .unwrap_or(0);
        let (pixel, bin) = (at / bins, at % bins);
        let path_m = shape.gate.start_m + (bin as f64 + 0.5) * shape.gate.bin_width_m;
        let origin = pose.in_camera(frame.light_origin);
        let d = pose.turned(frame.light_direction);
        let d = d.map(|x| x / norm(d));
        let position = along(origin, d, path_m);
        let w = shape.width as usize;
        Self {
            position,
            path_m,
            brightest: [(pixel % w) as f64 + 0.5, (pixel / w) as f64 + 0.5],
            projected: [
                f64::from(i.fx) * position[0] / position[2] + f64::from(i.cx),
                f64::from(i.fy) * position[1] / position[2] + f64::from(i.cy),
            ],
        }
    }

    fn check(
        &self,
        transforms_file: &Path,
        file: &Path,
        transforms: &Transforms,
        frame: &Frame,
        pose: &Pose,
        shape: &Shape,
    ) -> Result<Value, ImportError> {
        let off = libm::hypot(
            self.brightest[0] - self.projected[0],
            self.brightest[1] - self.projected[1],
        );
        if !(off <= NEAR_PX && self.position[2] > 0.0) {
            return Err(ImportError::refused(
                file,
                "brightest pixel (column, row)",
                format!(
                    "within {NEAR_PX} pixels of ({:.1}, {:.1}), where light_direction of {} points at",
                    self.projected[0],
                    self.projected[1],
                    transforms_file.display()
                ),
                format!("({:.1}, {:.1})", self.brightest[0], self.brightest[1]),
                "axes, field of view (--fov-deg) or pose may be others; or import as it is with --unchecked",
            ));
        }
        let wall = frame
            .wall_idx_light
            .as_u64()
            .and_then(|w| transforms.walls.get(w as usize));
        let mut account = json!({"one_bounce_off_px": off, "path_m": self.path_m});
        if let Some(wall) = wall.filter(|w| w.plane.len() == 3 && w.point.len() == 3) {
            let d = frame.light_direction;
            let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(x, y)| x * y).sum::<f64>();
            let reach: Vec<f64> = (0..3)
                .map(|k| wall.point[k] - frame.light_origin[k])
                .collect();
            let t = dot(&wall.plane, &reach) / dot(&wall.plane, &d);
            let hit = pose.in_camera([0, 1, 2].map(|k| frame.light_origin[k] + t * d[k]));
            let laser = pose.in_camera(frame.light_origin);
            let path = norm([0, 1, 2].map(|k| hit[k] - laser[k])) + norm(hit);
            let apart = libm::fabs(path - self.path_m);
            if apart.is_nan() || apart > 2.0 * shape.gate.bin_width_m {
                return Err(ImportError::refused(
                    file,
                    "brightest bin",
                    format!(
                        "a path of {path:.3} m, to the wall of {} and back",
                        transforms_file.display()
                    ),
                    format!("{:.3} m", self.path_m),
                    "give the gate with --gate-start-m and --bin-width-m, or import as it is with --unchecked",
                ));
            }
            account["wall_off_m"] = json!(apart);
        }
        Ok(account)
    }
}

/// Returns the point on a ray from which light that came along the ray reaches the origin after
/// `path` in total.
pub(super) fn along(origin: [f64; 3], d: [f64; 3], path: f64) -> [f64; 3] {
    let dot: f64 = origin.iter().zip(&d).map(|(a, b)| a * b).sum();
    let square: f64 = origin.iter().map(|x| x * x).sum();
    let t = (path * path - square) / (2.0 * (path + dot));
    [0, 1, 2].map(|k| origin[k] + t * d[k])
}
