//! Completes scenes from files: chooses the unit, the camera and the laser that a file does not
//! state, and notes each choice with the option that changes it.

use picofarm_settings::{Resolution, Spots};

use crate::{
    Affine, Aim, Camera, Intrinsics, Laser, Object, Provenance, Scene, Vec3,
    viewpoint::{Kind, Surroundings, Viewpoint},
};

use super::{ImportOptions, Unit, View, add_note, quoted};

/// The number of spots of a laser that neither the file nor the options describe.
const SPOTS: u32 = 25;
/// The least share of a grid's spots that must hit a surface; otherwise the spots are spread over
/// what the camera sees.
const LEAST_HITS: f32 = 0.8;
/// The number of rays along each side of the image that probe what the camera sees.
const RAYS: usize = 64;
/// The image size of a camera that the file does not describe, pixels on each side.
const PIXELS: u32 = 256;
/// The horizontal field of view of such a camera, degrees.
const FOV_DEG: f32 = 60.0;
/// The largest diagonal of a scene that is taken to be in metres, if its format has no unit. A
/// larger one is taken to be in millimetres.
const LARGEST_M: f32 = 50.0;

/// A scene as its file describes it.
pub(super) struct Draft {
    pub(super) name: String,
    pub(super) objects: Vec<Object>,
    pub(super) labels: Vec<String>,
    /// The cameras in the order of the file, with their names (which may be empty). An error is
    /// reported only if the camera is used.
    pub(super) cameras: Vec<(String, Result<Camera, String>)>,
    pub(super) laser: Option<FileLaser>,
    /// Whether the format or the file defines the unit of length.
    pub(super) has_unit: bool,
    pub(super) provenance: Provenance,
}

/// The laser of a file.
pub(super) enum FileLaser {
    /// A position and directions.
    Beams(Laser),
    /// Spots over the view of the camera.
    Spots(Aim),
}

impl Draft {
    /// Returns the scene with everything that the renderer needs. The error is the fault, without
    /// the file.
    pub(super) fn complete(mut self, options: &ImportOptions) -> Result<Scene, String> {
        if self.objects.is_empty() {
            return Err("has no shapes; add a mesh with faces".into());
        }
        if self.objects.iter().all(|o| o.mesh.triangles.is_empty()) {
            return Err("has no triangles; export a mesh with faces".into());
        }
        self.scale(options);
        let camera = self.camera(options)?;
        let laser = self.laser(options, &camera);
        Ok(Scene {
            name: self.name,
            objects: self.objects,
            labels: self.labels,
            camera,
            laser,
            provenance: self.provenance,
        })
    }

    fn note(&mut self, key: &str, what: String) {
        add_note(&mut self.provenance.notes, &format!("chosen.{key}"), what);
    }

    /// Converts all lengths to metres.
    fn scale(&mut self, options: &ImportOptions) {
        let unit = match options.unit {
            Some(unit) => unit,
            None if self.has_unit => return,
            None => {
                let diagonal = bounds(&self.objects).map_or(0.0, |(lo, hi)| (hi - lo).length());
                let unit = match diagonal > LARGEST_M {
                    true => Unit::Millimetre,
                    false => Unit::Metre,
                };
                let what = format!(
                    "{unit}, because the file has no unit and measures {diagonal:.3} across; --unit changes it"
                );
                self.note("unit", what);
                unit
            }
        };
        let metres = unit.metres();
        if metres == 1.0 {
            return;
        }
        for object in &mut self.objects {
            let Affine {
                linear,
                translation,
            } = object.to_world;
            object.to_world = Affine {
                linear: linear.map(|row| row * metres),
                translation: translation * metres,
            };
        }
        for camera in self.cameras.iter_mut().filter_map(|c| c.1.as_mut().ok()) {
            camera.origin = camera.origin * metres;
        }
        if let Some(FileLaser::Beams(laser)) = &mut self.laser {
            laser.origin = laser.origin * metres;
            for spot in laser.beams.iter_mut().filter_map(|b| b.spot.as_mut()) {
                spot.point = spot.point * metres;
                spot.path_m *= metres;
            }
        }
    }

    /// Returns the stated camera, one of the file's, or a chosen one, with an image of the stated
    /// size.
    fn camera(&mut self, options: &ImportOptions) -> Result<Camera, String> {
        let sized = |mut camera: Camera| {
            if let Some(size) = options.size {
                camera.intrinsics = camera.intrinsics.reshaped(size.width, size.height);
            }
            camera
        };
        if let Some(camera) = options.camera {
            return Ok(sized(camera));
        }
        let view = &options.view;
        let own = match &view.camera {
            Some(wanted) => Some(self.named_camera(wanted)?),
            None => self.cameras.first().map(|(_, camera)| camera.clone()),
        };
        let own = own.transpose()?.map(sized);
        let mut camera = match (own, view.from, view.at) {
            (Some(camera), None, None) => {
                self.note_first_camera(view);
                camera
            }
            (own, from, at) => {
                let fov_deg = view.fov_deg.unwrap_or(FOV_DEG);
                let intrinsics = match own {
                    Some(camera) => camera.intrinsics,
                    None => {
                        let size = options.size.unwrap_or(Resolution::square(PIXELS));
                        Intrinsics::from_fov(fov_deg, size.width, size.height)
                    }
                };
                let viewpoint = Viewpoint {
                    from: from.or(own.map(|c| c.origin)),
                    at,
                    up: view.up.unwrap_or(Vec3::new(0.0, 1.0, 0.0)),
                };
                let (camera, kind) = viewpoint.camera(&self.objects, intrinsics)?;
                self.note_viewpoint(&viewpoint, &camera, kind, fov_deg);
                camera
            }
        };
        if let Some(fov_deg) = view.fov_deg {
            let i = camera.intrinsics;
            camera.intrinsics = Intrinsics::from_fov(fov_deg, i.width, i.height);
        }
        Ok(camera)
    }

    /// Notes the use of the first of several cameras.
    fn note_first_camera(&mut self, view: &View) {
        if view.camera.is_some() || self.cameras.len() < 2 {
            return;
        }
        let (name, _) = &self.cameras[0];
        let what = format!(
            "the first of {}, {}; --camera changes it",
            self.cameras.len(),
            quoted(name)
        );
        self.note("camera", what);
    }

    /// Notes what was chosen of a viewpoint.
    fn note_viewpoint(&mut self, stated: &Viewpoint, camera: &Camera, kind: Kind, fov_deg: f32) {
        let show = |p: Vec3| {
            let [x, y, z] = <[f32; 3]>::from(p);
            format!("{x:.3},{y:.3},{z:.3}")
        };
        let from = show(camera.origin);
        let what = match (stated.from, stated.at) {
            (Some(_), Some(_)) => return,
            (Some(_), None) => "towards the middle of the objects; --look-at changes it".to_owned(),
            (None, Some(_)) => {
                format!("{kind}, at {from}, because the file has none; --look-from changes it")
            }
            (None, None) => format!(
                "{kind}, at {from} towards {}, {fov_deg}° wide, because the file has none; --look-from, --look-at, \
                 --fov and --up change it",
                show(camera.origin + camera.forward)
            ),
        };
        self.note("camera", what);
    }

    /// Returns the camera of a name or number (from 0).
    fn named_camera(&self, wanted: &str) -> Result<Result<Camera, String>, String> {
        let by_name = self.cameras.iter().find(|(name, _)| name == wanted);
        let by_number = || self.cameras.get(wanted.parse::<usize>().ok()?);
        by_name
            .or_else(by_number)
            .map(|(_, camera)| camera.clone())
            .ok_or_else(|| {
                let names = self.cameras.iter().enumerate();
                let names: Vec<String> = names
                    .take(20)
                    .map(|(k, (name, _))| format!("{k} ({})", quoted(name)))
                    .collect();
                let has = match names.is_empty() {
                    true => "it has none".to_owned(),
                    false => format!("it has {}", names.join(", ")),
                };
                format!(
                    "camera {}: the file has no such camera; {has}",
                    quoted(wanted)
                )
            })
    }

    fn laser(&mut self, options: &ImportOptions, camera: &Camera) -> Laser {
        if let Some(aim) = &options.laser {
            return aim.laser(camera);
        }
        match (self.laser.take(), &options.spots_if_none) {
            (Some(FileLaser::Beams(laser)), _) => laser,
            (Some(FileLaser::Spots(aim)), _) => aim.laser(camera),
            (None, Some(aim)) => aim.laser(camera),
            (None, None) => {
                let seen = seen(&self.objects, camera);
                let grid = Aim::grid(SPOTS).expect("a grid of that size exists");
                let (aim, how) = match share_of_hits(&grid, &seen) >= LEAST_HITS {
                    true => (grid, "in a grid over its view"),
                    false => (spread(&seen).unwrap_or(grid), "spread over what it sees"),
                };
                self.note(
                    "laser",
                    format!(
                        "at the camera, {SPOTS} spots {how}, because the file has none; --spots changes it"
                    ),
                );
                aim.laser(camera)
            }
        }
    }
}

/// Returns which pixels of a coarse image see a surface that shows spots, row by row.
fn seen(objects: &[Object], camera: &Camera) -> Vec<bool> {
    let world = Surroundings::opaque(objects);
    let i = &camera.intrinsics;
    let centres = (0..RAYS * RAYS).map(|k| [k % RAYS, k / RAYS].map(film));
    centres
        .map(|[x, y]| {
            let ray = camera.ray(x * i.width as f32, y * i.height as f32);
            let hit = world.as_ref().and_then(|w| w.closest(camera.origin, ray));
            hit.is_some()
        })
        .collect()
}

/// Returns the film position of the centre of a coarse row or column.
fn film(k: usize) -> f32 {
    (k as f32 + 0.5) / RAYS as f32
}

fn share_of_hits(aim: &Aim, seen: &[bool]) -> f32 {
    let pixel = |x: f32| ((x * RAYS as f32) as usize).min(RAYS - 1);
    let spots = aim.film().iter();
    let hits = spots.filter(|[x, y]| seen[pixel(*y) * RAYS + pixel(*x)]);
    hits.count() as f32 / aim.film().len().max(1) as f32
}

/// Returns spots at pixels that see a surface, each as far from the earlier ones as possible, and
/// the first nearest to their centre. Returns `None` if no pixel sees a surface.
fn spread(seen: &[bool]) -> Option<Aim> {
    let places: Vec<[f32; 2]> = (0..seen.len())
        .filter(|k| seen[*k])
        .map(|k| [film(k % RAYS), film(k / RAYS)])
        .collect();
    let count = places.len() as f32;
    let centre = [0, 1].map(|k: usize| places.iter().map(|p| p[k]).sum::<f32>() / count);
    let square = |a: [f32; 2], b: [f32; 2]| (a[0] - b[0]).powi(2) + (a[1] - b[1]).powi(2);
    let first = *places
        .iter()
        .min_by(|a, b| square(**a, centre).total_cmp(&square(**b, centre)))?;
    let mut chosen = vec![first];
    let mut far: Vec<f32> = places.iter().map(|p| square(*p, first)).collect();
    while chosen.len() < (SPOTS as usize).min(places.len()) {
        let next = (0..far.len()).max_by(|a, b| far[*a].total_cmp(&far[*b]).then(b.cmp(a)))?;
        chosen.push(places[next]);
        for (distance, place) in far.iter_mut().zip(&places) {
            *distance = distance.min(square(*place, places[next]));
        }
    }
    let chosen = chosen.into_iter().map(|p| p.map(f64::from)).collect();
    Aim::of(&Spots::At(chosen), 0).ok()
}

/// Returns the smallest and largest world coordinates of all finite vertices.
pub(super) fn bounds<'a>(objects: impl IntoIterator<Item = &'a Object>) -> Option<(Vec3, Vec3)> {
    let points = objects.into_iter().flat_map(|o| {
        let vertices = o.mesh.triangles.iter().flatten();
        vertices.map(|&v| o.to_world.point(o.mesh.positions[v as usize]))
    });
    points
        .filter(|p| p.is_finite())
        .fold(None, |known, p| match known {
            None => Some((p, p)),
            Some((lo, hi)) => Some((p.min(lo), p.max(hi))),
        })
}
