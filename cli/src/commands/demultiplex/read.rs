//! A render group as a capture, with its truth where the group holds it.

use std::path::Path;

use futures::executor::block_on;
use picofarm_dataset::{Quantity, RenderGroup, SingleRender};
use picofarm_demultiplex::{Capture, Place, Spot, Truth};
use picofarm_exchange::capture::is_capture;
use picofarm_scene::{self as scene, Camera, Vec3};
use picofarm_transient::Gate;
use serde_json::{Map, Value};

use crate::{
    args::PlacesArg,
    commands::rendered::{self, Folder, array},
    error::{CliError, Result},
};

/// One flash with its calibration and, if the render has it, its ground truth.
pub struct Flash {
    pub attributes: Map<String, Value>,
    pub histogram: Vec<f32>,
    pub gate: Gate,
    pub camera: Camera,
    pub laser: Vec3,
    pub spots: Vec<Spot>,
    /// Index of each spot's beam: beams that meet nothing have none.
    pub beams: Vec<usize>,
    /// Pixels with a stated spot are 0 here: their depth is part of the input.
    depth: Option<Vec<f32>>,
    /// The number of these pixels, of those whose depth is known.
    given: usize,
    specular: Vec<u8>,
    visibility: Vec<u8>,
}

impl Flash {
    /// Reads a group.
    ///
    /// # Errors
    /// No such group, one without histogram or calibration, or damage.
    pub fn read(folder: &Path, places: PlacesArg) -> Result<Self> {
        let source = Folder::open(folder)?;
        let attributes = source.attributes().clone();
        let camera: Camera = source.attribute(folder, "camera")?;
        let laser: Vec3 = source.attribute(folder, "laser_origin")?;
        let gate: Gate = source.attribute(folder, "gate")?;
        let all: Vec<Option<scene::Spot>> = source.attribute(folder, "spots")?;
        let measured = is_capture(&attributes);
        let towards: Vec<Option<Vec3>> = match measured {
            true => source.attribute(folder, "directions")?,
            false => Vec::new(),
        };
        let towards = |beam: usize| towards.get(beam).copied().flatten();
        let i = &camera.intrinsics;
        let image = [u64::from(i.height), u64::from(i.width)];
        let (histogram, truth) = match &source {
            Folder::Sensed(group) => {
                let cube = [image[0], image[1], u64::from(gate.bins)];
                (sensed(folder, group, &cube)?, None)
            }
            Folder::Render(render) if measured => {
                let depth = measured_depth(folder, render)?;
                let truth = depth.map(|depth| (depth, vec![], vec![]));
                (rendered::transient(folder, render)?, truth)
            }
            Folder::Render(render) => {
                let truth = (
                    rendered::image::<f32>(folder, render, Quantity::Depth)?,
                    rendered::image::<u8>(folder, render, Quantity::Specular)?,
                    rendered::masks(folder, render)?,
                );
                (rendered::transient(folder, render)?, Some(truth))
            }
        };
        let (depth, specular, visibility) = match truth {
            Some((depth, specular, visibility)) => (Some(depth), specular, visibility),
            None => (None, vec![], vec![]),
        };
        let pixels = (image[0] * image[1]) as usize;
        let beams: Vec<usize> = (0..all.len())
            .filter(|k| all[*k].is_some() || towards(*k).is_some())
            .collect();
        let visibility = match visibility.is_empty() {
            true => visibility,
            false => beams
                .iter()
                .flat_map(|k| visibility[k * pixels..][..pixels].iter().copied())
                .collect(),
        };
        let spot = |beam: &usize| {
            let Some(s) = &all[*beam] else {
                let direction = towards(*beam)?;
                return Some(Spot {
                    direction,
                    place: None,
                });
            };
            let way = s.point - laser;
            // A mirror folds the beam: where it left the laser is not in the group, so its place
            // stays as given.
            let folded = s.path_m - way.length() > 1e-3 * s.path_m;
            let known = places == PlacesArg::Given || folded;
            Some(Spot {
                direction: way,
                place: known.then_some(Place {
                    point: s.point,
                    path_m: s.path_m,
                }),
            })
        };
        let spots: Vec<Spot> = beams.iter().filter_map(spot).collect();
        let mut depth = depth;
        let given = match &mut depth {
            Some(depth) => without_spots(depth, &camera, &spots),
            None => 0,
        };
        Ok(Self {
            attributes,
            histogram,
            gate,
            camera,
            laser,
            spots,
            beams,
            depth,
            given,
            specular,
            visibility,
        })
    }

    /// The histogram and its calibration.
    pub fn capture(&self) -> Capture<'_> {
        Capture {
            histogram: &self.histogram,
            gate: self.gate,
            camera: &self.camera,
            laser: self.laser,
            spots: &self.spots,
        }
    }

    /// What it is compared with, where the group holds it. Pixels with a stated spot are not
    /// compared, because a method takes their depth from the spot.
    pub fn truth(&self) -> Option<Truth<'_>> {
        let depth_m = self.depth.as_deref()?;
        depth_m.iter().any(|z| *z > 0.0).then_some(Truth {
            depth_m,
            specular: &self.specular,
            visibility: &self.visibility,
        })
    }

    /// Returns why errors of depth are missing, or leave pixels out.
    pub fn note(&self) -> Option<String> {
        if self.given == 0 {
            return None;
        }
        let text = match self.truth() {
            None => {
                "no error of depth: each pixel whose depth is known has a stated spot, so that input would be compared \
                 with itself; `demultiplex --places returns` looks for the spots in the histogram and is compared"
                    .into()
            }
            Some(_) => format!(
                "{} pixels with a stated spot are left out of the error of depth, because their depth is input",
                self.given
            ),
        };
        Some(text)
    }
}

/// Sets the depth of pixels with a stated spot to 0, unknown. Returns the number of pixels whose
/// depth was known.
fn without_spots(depth: &mut [f32], camera: &Camera, spots: &[Spot]) -> usize {
    let i = &camera.intrinsics;
    let mut given = 0;
    for place in spots.iter().filter_map(|spot| spot.place) {
        let q = camera.to_camera(place.point);
        let (u, v) = (i.fx * q.x / q.z + i.cx, i.fy * q.y / q.z + i.cy);
        let inside =
            q.z > 0.0 && (0.0..i.width as f32).contains(&u) && (0.0..i.height as f32).contains(&v);
        if inside {
            let known = &mut depth[v as usize * i.width as usize + u as usize];
            given += usize::from(*known > 0.0);
            *known = 0.0;
        }
    }
    given
}

/// The true depth of a capture whose files have it.
fn measured_depth(folder: &Path, render: &SingleRender) -> Result<Option<Vec<f32>>> {
    let manifest = block_on(render.dataset.manifest(0));
    let manifest = manifest.map_err(|e| rendered::unreadable(folder, e))?;
    match manifest.missing().iter().any(|m| m == "depth") {
        true => Ok(None),
        false => rendered::image::<f32>(folder, render, Quantity::Depth).map(Some),
    }
}

/// The histogram of all spots that a sensor measured.
fn sensed(folder: &Path, group: &RenderGroup, shape: &[u64]) -> Result<Vec<f32>> {
    if group.has("rate") {
        return array::<f32>(folder, group, "rate", shape);
    }
    if !group.has("counts") {
        let what = format!("{}: has no array rate or counts", folder.display());
        return Err(CliError::input(what).hint("expected a folder of `picofarm scene sense`"));
    }
    // Counts are stored in the narrowest type that holds them.
    if let Ok(counts) = array::<u16>(folder, group, "counts", shape) {
        return Ok(counts.into_iter().map(f32::from).collect());
    }
    let counts = array::<u32>(folder, group, "counts", shape)?;
    Ok(counts.into_iter().map(|c| c as f32).collect())
}

#[cfg(test)]
mod tests {
    use picofarm_dataset::{Gate, Intrinsics};
    use picofarm_exchange::capture::{Beam, Capture, Origin};

    use super::*;

    /// A capture of three beams: a spot, a direction, and a beam that meets nothing.
    fn capture(depth: Option<Vec<f32>>) -> Capture {
        let each: Vec<f32> = (0..3 * 2 * 3 * 4).map(|n| n as f32).collect();
        Capture {
            name: "lab".into(),
            height: 2,
            width: 3,
            gate: Gate {
                start_m: 1.0,
                bin_width_m: 0.1,
                bins: 4,
            },
            sum: (0..24)
                .map(|at| (0..3).map(|s| each[s * 24 + at]).sum())
                .collect(),
            per_spot: Some(each),
            intrinsics: Intrinsics {
                fx: 2.0,
                fy: 2.0,
                cx: 1.5,
                cy: 1.0,
            },
            laser: [0.1, 0.2, 0.0],
            beams: vec![
                Beam::Spot {
                    position: [0.1, 0.2, 2.0],
                    path_m: 2.0,
                },
                Beam::Nothing,
                Beam::Direction([0.0, 0.6, 0.8]),
            ],
            depth,
            origin: Origin::default(),
        }
    }

    #[test]
    fn a_capture_is_read_with_its_calibration_and_its_depth_where_it_is_known() {
        let folder = tempfile::tempdir().unwrap();
        for depth in [None, Some(vec![2.0; 6])] {
            let (made, out) = (capture(depth), folder.path().join("out"));
            block_on(made.write(&out, b"picture")).unwrap();
            let flash = Flash::read(&out, PlacesArg::Given).unwrap();
            assert_eq!(flash.histogram, made.sum);
            assert_eq!(flash.beams, [0, 2]);
            // The world's axes are turned; the camera's are those of the capture.
            let seen = |x: Vec3| <[f32; 3]>::from(flash.camera.to_camera(x));
            assert_eq!(seen(flash.laser), made.laser);
            let place = flash.spots[0].place.unwrap();
            assert_eq!((seen(place.point), place.path_m), ([0.1, 0.2, 2.0], 2.0));
            assert!(flash.spots[1].place.is_none());
            assert_eq!(seen(flash.spots[1].direction), [0.0, 0.6, 0.8]);
            let truth = flash.truth();
            assert_eq!(truth.is_some(), made.depth.is_some());
            if let Some(truth) = truth {
                // The spot is in the middle of the second row.
                assert_eq!(truth.depth_m, [2.0, 2.0, 2.0, 2.0, 0.0, 2.0]);
                assert!(flash.note().unwrap().starts_with("1 pixels"));
                // Neither shadows nor mirrors are known.
                assert!(truth.visibility.is_empty() && truth.specular.is_empty());
            }
            let returns = Flash::read(&out, PlacesArg::Returns).unwrap();
            assert!(returns.spots.iter().all(|s| s.place.is_none()));
            assert_eq!(returns.depth, made.depth);
            std::fs::remove_dir_all(out).unwrap();
        }
    }

    #[test]
    fn depth_that_is_known_only_where_spots_are_is_no_truth() {
        let folder = tempfile::tempdir().unwrap();
        let mut made = capture(Some(vec![0.0, 0.0, 0.0, 0.0, 2.0, 0.0]));
        made.beams.truncate(1);
        made.per_spot = None;
        block_on(made.write(&folder.path().join("out"), b"picture")).unwrap();
        let read = |places| Flash::read(&folder.path().join("out"), places).unwrap();
        let given = read(PlacesArg::Given);
        assert!(given.truth().is_none());
        assert!(given.note().unwrap().starts_with("no error of depth"));
        let found = read(PlacesArg::Returns);
        assert!(found.truth().is_some() && found.note().is_none());
    }
}
