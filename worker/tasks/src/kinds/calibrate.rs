//! Calibration: checks a measured scene, and publishes it with a corrected calibration in a data
//! set of its own, with the report in its manifest. The task adopts a scene that exists.

use picofarm_calibrate::{Checked, Measurement, VERSION, check};
use picofarm_dataset::{
    Dataset, DatasetSpec, ENCODER_VERSION, EncodedScene, Manifest, Profile, Provenance, Quantity,
    Spot,
};
use picofarm_demultiplex::{Capture, Place, Spot as Beam};
use picofarm_proto::{
    key::{TaskKey, derived_key},
    spec::{SpecError, TaskSpec, kinds::CalibrateTask},
};
use picofarm_results::Verdict;
use picofarm_scene::{Camera, Intrinsics, Vec3};
use picofarm_store::published::Manifest as _;
use serde_json::json;

use crate::{
    errors::dataset_error,
    input::{camera::Frame, source_manifest},
    making::reprocessed::open_source,
    stores::{Stores, manifest_sha256, saying},
    submission::Submission,
    task::{Context, Control, Output, RunTask, Task, TaskError, proceed},
};

/// Progress of the task after reading, and after the check.
const READ: f32 = 0.1;
const CHECKED: f32 = 0.8;

impl RunTask for CalibrateTask {
    fn code_version() -> String {
        format!("{VERSION}/{ENCODER_VERSION}")
    }

    fn run(&self, context: &Context, task: &Task, control: &Control) -> Result<Output, TaskError> {
        let (stores, index) = (&context.stores, task.index);
        let source = open_source(stores, &self.source, control)?;
        stores.fits(TaskSpec::Calibrate(self.clone()), Some(source.spec()))?;
        let found = source_manifest(stores, &source, index, control)?;
        let made_by = TaskKey::parse(&found.provenance.task_key).ok_or_else(|| {
            TaskError::User(format!(
                "source.dataset: the manifest of scene {index} names the task {:?}, which is no key of a task",
                found.provenance.task_key
            ))
        })?;
        let key = derived_key(&self.calibrate.stage_key(&self.output.profile), &made_by);
        let scene = Scene::read(stores, &source, &found, control)?;
        proceed(control, READ)?;
        control.say("compares the times".into(), &[]);
        let checked = scene.check(self.calibrate.pulses).map_err(|e| {
            TaskError::User(format!("source: scene {index} of {}: {e}", source.place()))
        })?;
        proceed(control, CHECKED)?;
        let (report, place) = (&checked.report, source.place());
        let verdict = Verdict::of_calibration(&json!(report));
        saying(&verdict, &format!("scene {index}"));
        if report.unexplained() && !self.calibrate.accept_unexplained {
            return Err(TaskError::User(format!(
                "source: scene {index} of {place}: {}; correct what is named and import it again, or set \
                 calibrate.accept_unexplained = true to pass it on unchanged",
                verdict.text
            )));
        }
        if checked.corrected.turn != Default::default() {
            return Err(TaskError::User(format!(
                "source: scene {index} of {place}: {}; a job corrects numbers and does not turn images, because the ground \
                 truth would have to turn with them: import it again with the right axes, or use `picofarm capture calibrate`",
                verdict.text
            )));
        }
        let profile = Profile::parse(&self.output.profile)
            .map_err(|e| TaskError::User(format!("output.profile: {e}")))?;
        let spec = DatasetSpec {
            gate: checked.corrected.gate,
            subsets: picofarm_dataset::Subsets::NONE,
            profile,
            ..*source.spec()
        };
        let place = &self.output;
        let dataset = stores.create_or_open(&place.store, &place.dataset, &spec, control)?;
        if !task.spec.force
            && let Some(manifest) = stores.finished(&dataset, index, &key, control)?
        {
            return Ok(Output {
                manifest_sha256: manifest_sha256(&manifest),
                bytes: manifest.total_bytes(),
                adopted: true,
            });
        }
        let provenance = Provenance {
            task_key: key.to_string(),
            renderer: self.calibrate.version.clone(),
            seed: 0,
            plan: account(self, &found, &checked),
        };
        let encoded = scene.encode(stores, (&source, &dataset), &checked, &provenance, control)?;
        let manifest = stores.publish(&dataset, encoded, control)?;
        control.at(1.0);
        Ok(Output {
            manifest_sha256: manifest_sha256(&manifest),
            bytes: manifest.total_bytes(),
            adopted: false,
        })
    }

    fn resolve(&mut self, here: &Submission<'_>) -> Result<(), SpecError> {
        here.profile(&self.output.profile)
    }
}

/// A measured scene.
struct Scene {
    index: u64,
    scale: f32,
    sum: Vec<f32>,
    per_spot: Option<Vec<f32>>,
    camera: Camera,
    laser: Vec3,
    spots: Vec<Option<Spot>>,
    gate: picofarm_settings::Gate,
}

impl Scene {
    fn read(
        stores: &Stores,
        dataset: &Dataset,
        found: &Manifest,
        control: &Control,
    ) -> Result<Self, TaskError> {
        let (spec, index) = (dataset.spec(), found.scene);
        let missing = found.missing();
        let needed = ["transient", "spots", "spots.path"];
        if let Some(none) = missing.iter().find(|m| needed.contains(&m.as_str())) {
            return Err(TaskError::User(format!(
                "source: scene {index} of {} was imported without {none:?}, which a calibration needs; import it with it, or \
                 use `picofarm capture calibrate` for beams that are known by their directions",
                dataset.place()
            )));
        }
        let each = async {
            match spec.per_spot {
                true => dataset
                    .read_histogram(index, Quantity::TransientSpots)
                    .await
                    .map(Some),
                false => Ok(None),
            }
        };
        let read = async {
            futures::try_join!(
                dataset.read_transient(index),
                each,
                dataset.read_spots(index),
                dataset.read_intrinsics(index),
                dataset.read::<f32>(index, Quantity::Camera),
                dataset.read::<f32>(index, Quantity::Laser),
            )
        };
        let (sum, per_spot, spots, i, pose, laser) = stores.wait(control, read)?;
        if let Some(none) = spots.iter().position(Option::is_none) {
            return Err(TaskError::User(format!(
                "source: the beam of spot {none} of scene {index} of {} meets nothing, so that its times cannot be judged; \
                 import the scene without it",
                dataset.place()
            )));
        }
        let frame = Frame(&pose);
        Ok(Self {
            index,
            scale: found.scale,
            sum,
            per_spot,
            camera: frame.camera(Intrinsics {
                fx: i.fx,
                fy: i.fy,
                cx: i.cx,
                cy: i.cy,
                width: spec.width,
                height: spec.height,
            }),
            laser: frame.point([laser[0], laser[1], laser[2]]),
            spots: spots
                .into_iter()
                .map(|spot| {
                    spot.map(|s| Spot {
                        position: frame.point(s.position).into(),
                        ..s
                    })
                })
                .collect(),
            gate: spec.gate,
        })
    }

    fn check(&self, pulses: Option<u64>) -> Result<Checked, picofarm_calibrate::CalibrateError> {
        let spots: Vec<Beam> = self
            .spots
            .iter()
            .flatten()
            .map(|s| Beam {
                direction: Vec3::from(s.position) - self.laser,
                place: Some(Place {
                    point: s.position.into(),
                    path_m: s.path_m,
                }),
            })
            .collect();
        check(&Measurement {
            capture: Capture {
                histogram: &self.sum,
                gate: self.gate,
                camera: &self.camera,
                laser: self.laser,
                spots: &spots,
            },
            per_spot: self.per_spot.as_deref(),
            masks: None,
            pulses,
        })
    }

    fn encode(
        &self,
        stores: &Stores,
        (source, dataset): (&Dataset, &Dataset),
        checked: &Checked,
        provenance: &Provenance,
        control: &Control,
    ) -> Result<EncodedScene, TaskError> {
        let found = &checked.corrected;
        let local = |p: Vec3| -> [f32; 3] { self.camera.to_camera(p).into() };
        let spots: Vec<Option<Spot>> = found
            .spots
            .iter()
            .map(|spot| {
                spot.place.map(|place| Spot {
                    position: local(place.point),
                    normal: [0.0; 3],
                    path_m: place.path_m,
                })
            })
            .collect();
        let i = found.camera.intrinsics;
        let intrinsics = picofarm_dataset::Intrinsics {
            fx: i.fx,
            fy: i.fy,
            cx: i.cx,
            cy: i.cy,
        };
        let truth = stores.wait(control, source.read_truth(self.index))?;
        let truth = truth
            .calibrated(&spots, intrinsics, local(found.laser))
            .map_err(dataset_error)?;
        let per_spot = self.per_spot.as_ref().map(|all| found.histograms(all));
        let sum = match &per_spot {
            None => found.histograms(&self.sum),
            Some(all) => {
                let mut sum = vec![0.0f64; self.sum.len()];
                for h in all.chunks_exact(sum.len()) {
                    sum.iter_mut().zip(h).for_each(|(s, x)| *s += f64::from(*x));
                }
                sum.into_iter().map(|s| s as f32).collect()
            }
        };
        let planes: Vec<&[f32]> = per_spot
            .iter()
            .flat_map(|all| all.chunks_exact(self.sum.len()))
            .collect();
        dataset
            .encode_derived_with(self.index, &truth, (&sum, &planes), self.scale, provenance)
            .map_err(dataset_error)
    }
}

/// Describes the source and the report for the manifest. The description depends on the task only.
fn account(task: &CalibrateTask, source: &Manifest, checked: &Checked) -> serde_json::Value {
    let stated = &source.provenance.plan;
    let mut missing = source.missing();
    // Corrected spots have no normals.
    missing.push("spots.normal".into());
    missing.sort();
    missing.dedup();
    json!({
        "kind": "calibrate",
        "source": {
            "task_key": source.provenance.task_key,
            "manifest_sha256": manifest_sha256(source),
            "renderer": source.provenance.renderer,
            "scale": source.scale,
        },
        "settings": task.calibrate,
        "report": checked.report,
        "value": stated["value"],
        "labels": stated["labels"],
        "scene": stated["scene"],
        "missing": missing,
    })
}
