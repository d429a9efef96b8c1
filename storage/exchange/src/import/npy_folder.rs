//! Imports our minimal layout: `scene.json` with a complete description, and the `.npy` files that
//! it names.

mod about;

use std::path::Path;

use serde::Deserialize;
use serde_json::Value;

use picofarm_files::Opener;

use super::check::check;
use super::files::Files;
use super::npy::{self, Array};
use super::paths;
use super::profile::{Blame, Geometry};
use super::scene::{ImportedScene, Shape, clean};
use super::{DepthKind, ImportError, ImportOptions, Item, Polarity};
use about::About;

const SCENE: &str = "scene.json";

/// `scene.json`. There are no defaults: an omitted quantity does not exist.
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
    /// `[spot][3]`: where the beams hit the scene, in the camera's axes; NaN if one hits nothing.
    spots: Spots,
    /// Without depth, the histogram cannot be checked.
    depth: Option<Depth>,
    /// `[spot][row][column]`.
    visibility: Option<Visibility>,
    /// `[spot][row][column]`: measured path of each spot's two-bounce light, in the length unit;
    /// 0 = not measured.
    two_bounce: Option<File>,
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
    /// Photons per unit of the histogram, if known.
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
    /// `[spot]`: length of each beam from the laser, in the length unit, including reflections in
    /// mirrors.
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
    /// The directions of x, y and z: `right` or `left`, `down` or `up`, `forward` or `backward`.
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
    let metres = |a: Array| -> Vec<f32> {
        let metres = a.values.iter().map(|x| (f64::from(*x) * unit) as f32);
        metres.collect()
    };
    match &is.depth {
        None => scene.missing.extend(["depth", "range"]),
        Some(of) => {
            let depth = metres(about.sized(&of.file, &[h, w], files)?);
            let path = about.folder.join(&of.file);
            scene.set_depth(&path, &depth, of.kind == DepthKind::Range)?;
        }
    }
    if let Some(f) = &is.two_bounce {
        scene.two_bounce = metres(about.sized(&f.file, &[n, h, w], files)?);
        let valid = |x: &f32| x.is_finite() && *x >= 0.0;
        if let Some(odd) = scene.two_bounce.iter().find(|x| !valid(x)) {
            return Err(ImportError::refused(
                about.folder.join(&f.file),
                "values",
                "lengths of at least 0 (0 where none was measured)",
                odd.to_string(),
                "correct the file",
            ));
        }
    }
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
            let lengths = metres(paths);
            scene.set_paths(&lengths).map_err(|(beam, straight)| {
                ImportError::refused(
                    about.folder.join(file),
                    format!("length of beam {beam}"),
                    format!("{straight} m at least, the straight line from the laser to its spot"),
                    format!("{} m", lengths[beam]),
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
        // 32-bit floats represent integers exactly up to this limit.
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
    match &is.depth {
        Some(depth) if !options.unchecked => scene.check = checked(&about, depth, &path, &scene)?,
        Some(_) => {}
        None => {
            let what = "histogram not checked: there is no depth";
            scene.conversions.push(what.into());
        }
    }
    if let Some(file) = is.two_bounce.as_ref().filter(|_| !options.unchecked) {
        let found = paths::check(&scene, &about.folder.join(&file.file))?;
        if !found.is_null() {
            scene.check["two_bounce_paths"] = found;
        }
    }
    Ok(scene)
}

/// Checks that light arrives at the times predicted from the geometry.
fn checked(
    about: &About,
    depth: &Depth,
    histogram: &Path,
    scene: &ImportedScene,
) -> Result<Value, ImportError> {
    let masks = about.is.visibility.as_ref();
    let geometry = Geometry {
        shape: &scene.shape,
        transient: &scene.transient,
        depth: &scene.depth,
        of_range: depth.kind == DepthKind::Range,
        intrinsics: scene.intrinsics,
        laser: scene.laser,
        spots: &scene.spots,
        visibility: masks.map(|_| &scene.visibility[..]),
        specular: &scene.specular,
    };
    let file = |name: &str| about.folder.join(name);
    let blame = Blame {
        histogram,
        depth: &file(&depth.file),
        spots: &file(&about.is.spots.file),
        visibility: &masks.map_or_else(|| histogram.to_owned(), |v| file(&v.file)),
        hint: "correct scene.json",
        polarity: "visibility.one_means in scene.json",
    };
    check(&geometry, &blame)
}
