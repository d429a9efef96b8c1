//! Renders a scene of a task and encodes it for the data set.

use std::time::Instant;

use picofarm_dataset::{
    Dataset, DatasetSpec, EncodedScene, Intrinsics, Provenance, SceneRecord, Spot, SubsetRecord,
    photon_scale,
};
use picofarm_proto::{
    key::TaskKey,
    messages::log::DARK,
    spec::{RenderSettings, RenderTask, TaskKind},
    trace,
};
use picofarm_scene::{Camera, Scene};
use picofarm_store::StorageError;
use picofarm_transient::{Progress, RENDERER_VERSION, Rendered, Settings};
use serde_json::json;
use tracing::{debug_span, info, warn};

use crate::{
    errors::{dataset_error, render_error},
    input::scenes::{self, With},
    making::subsets,
    task::{Control, TaskError},
};

/// Photons in the brightest bin of the median pixel. Defines the stored scale, following the
/// convention of the measurement.
const PEAK_PHOTONS: f32 = 400.0;

/// Share of rendering in a task's progress. Encoding and storing make up the rest.
pub(crate) const RENDER_SHARE: f32 = 0.95;

/// Returns the version of all code of this program that determines a task's bytes: renderer,
/// generators, importer and encoder. It is part of every task key, so that a change to any of them
/// renames the results.
pub fn renderer_version() -> String {
    format!(
        "{RENDERER_VERSION}/{}/{}/{}/{}",
        picofarm_scene::furnished::GENERATOR_VERSION,
        picofarm_scene::primitive::GENERATOR_VERSION,
        picofarm_scene::import::IMPORT_VERSION,
        picofarm_dataset::ENCODER_VERSION
    )
}

/// Names the bytes of scene `index`.
pub(crate) fn scene_key(spec: &RenderTask, index: u64) -> Result<TaskKey, TaskError> {
    let key = spec.scene_key(index);
    key.ok_or_else(|| scenes::not_listed(&format!("scenes.files[{index}]")))
}

/// Scene `index` rendered in one piece and coded for the data set; `key` is its task's.
pub(crate) fn make(
    dataset: &Dataset,
    with: With<'_>,
    spec: &RenderTask,
    index: u64,
    key: &TaskKey,
    control: &Control,
) -> Result<EncodedScene, TaskError> {
    check_version(spec)?;
    let render = |scene: &Scene, settings: &Settings| {
        picofarm_transient::render(scene, settings, &Watched(control)).map_err(render_error)
    };
    make_by(dataset, with, spec, index, key, render)
}

/// Makes scene `index`, renders it with `render`, and encodes it for the data set.
pub(crate) fn make_by(
    dataset: &Dataset,
    with: With<'_>,
    spec: &RenderTask,
    index: u64,
    key: &TaskKey,
    render: impl FnOnce(&Scene, &Settings) -> Result<Rendered, TaskError>,
) -> Result<EncodedScene, TaskError> {
    let (scene, settings) = prepare(with, spec, dataset, index, key)?;
    let begun = Instant::now();
    let rendered =
        debug_span!(target: trace::TARGET, "render").in_scope(|| render(&scene, &settings))?;
    info!(
        samples = rendered.error.samples,
        median_error = rendered.error.median_relative,
        rays = rendered.rays,
        seconds = begun.elapsed().as_secs_f32(),
        "rendered"
    );
    for warning in &rendered.warnings {
        let mark = match rendered.dark.as_ref() == Some(warning) {
            true => DARK,
            false => "",
        };
        warn!("{mark}{warning}");
    }
    let made = By {
        task_key: key.to_string(),
        renderer: spec.render.renderer.clone(),
    };
    debug_span!(target: trace::TARGET, "encode")
        .in_scope(|| encode_render(dataset, index, &scene, &settings, &rendered, made))
        .map_err(dataset_error)
}

/// What made a scene, for its provenance.
pub struct By {
    /// Names the scene's bytes.
    pub task_key: String,
    /// Version of the code that determines them.
    pub renderer: String,
}

/// Encodes a render as scene `index` of a data set, with its ground truth.
///
/// # Errors
/// Those of [`Dataset::encode`].
pub fn encode_render(
    dataset: &Dataset,
    index: u64,
    scene: &Scene,
    settings: &Settings,
    rendered: &Rendered,
    by: By,
) -> Result<EncodedScene, StorageError> {
    let spots: Vec<_> = rendered
        .spots
        .iter()
        .map(|spot| spot.as_ref().map(|s| in_camera(s, &scene.camera)))
        .collect();
    let subsets = subsets::records(dataset.spec(), rendered);
    let record = record(scene, rendered, &subsets, &spots);
    let provenance = Provenance {
        task_key: by.task_key,
        renderer: by.renderer,
        seed: settings.seed,
        plan: account(scene, rendered, settings.max_bounces),
    };
    dataset.encode(index, &record, &provenance)
}

/// Checks that the job asks for this version of the renderer.
pub(crate) fn check_version(spec: &RenderTask) -> Result<(), TaskError> {
    let ours = renderer_version();
    if spec.render.renderer == ours {
        return Ok(());
    }
    Err(TaskError::User(format!(
        "render.renderer: the job asks for {:?}, this worker renders {ours:?}; submit the job again with this \
         version, or run workers of the other one",
        spec.render.renderer
    )))
}

/// Makes scene `index` and returns it with its render settings, which depend on `key`.
pub(crate) fn prepare(
    with: With<'_>,
    spec: &RenderTask,
    dataset: &Dataset,
    index: u64,
    key: &TaskKey,
) -> Result<(Scene, Settings), TaskError> {
    let begun = Instant::now();
    let scene = debug_span!(target: trace::TARGET, "scene")
        .in_scope(|| scenes::scene(&spec.scenes, spec.render.resolution, index, with))?;
    info!(
        scene = scene.name,
        triangles = scene.triangle_count(),
        seconds = begun.elapsed().as_secs_f32(),
        "scene made"
    );
    Ok((scene, settings(spec, dataset.spec(), key)))
}

/// Forwards the renderer's progress to the task's control.
pub(crate) struct Watched<'a>(pub &'a Control);

impl Progress for Watched<'_> {
    fn at(&self, done: f32) -> bool {
        self.0.at(done * RENDER_SHARE)
    }
}

/// Returns the renderer's settings for the render settings of a job or of the command line.
pub fn renderer_settings(render: &RenderSettings) -> Settings {
    Settings {
        max_bounces: (render.max_bounces != 0).then_some(render.max_bounces),
        one_bounce: true,
        strategy: render.strategy,
        optics: render.optics,
        ..Settings::new(render.gate(), render.budget)
    }
}

/// Returns the renderer's settings for a task. The seed is the first bytes of the task's key, so
/// that only the task determines the result.
fn settings(spec: &RenderTask, dataset: &DatasetSpec, key: &TaskKey) -> Settings {
    let head = key.0[..8].try_into().expect("a key has 32 bytes");
    Settings {
        seed: u64::from_le_bytes(head),
        groups: subsets::groups(dataset),
        ..renderer_settings(&spec.render)
    }
}

/// Returns the render in the form that the data set stores.
pub(crate) fn record<'a>(
    scene: &Scene,
    rendered: &'a Rendered,
    subsets: &'a [SubsetRecord<'a>],
    spots: &'a [Option<Spot>],
) -> SceneRecord<'a> {
    let (camera, truth) = (&scene.camera, &rendered.truth);
    let i = camera.intrinsics;
    let (r, d, f, o) = (camera.right, camera.down, camera.forward, camera.origin);
    SceneRecord {
        transient: &rendered.transient,
        subsets,
        depth: &truth.depth,
        range: &truth.range,
        normal: &truth.normal,
        instance: &truth.instance,
        label: &truth.label,
        specular: &truth.specular,
        visibility: &truth.visibility,
        two_bounce: &[],
        rgb: &truth.rgb,
        spots,
        intrinsics: Intrinsics {
            fx: i.fx,
            fy: i.fy,
            cx: i.cx,
            cy: i.cy,
        },
        camera: [
            [r.x, d.x, f.x, o.x],
            [r.y, d.y, f.y, o.y],
            [r.z, d.z, f.z, o.z],
            [0.0, 0.0, 0.0, 1.0],
        ],
        laser: camera.to_camera(scene.laser.origin).into(),
        scale: photon_scale(
            &rendered.transient,
            rendered.gate.bins as usize,
            PEAK_PHOTONS,
        ),
    }
}

pub(crate) fn in_camera(spot: &picofarm_scene::Spot, camera: &Camera) -> Spot {
    Spot {
        position: camera.to_camera(spot.point).into(),
        normal: camera.direction_to_camera(spot.normal).into(),
        path_m: spot.path_m,
    }
}

/// Describes the scene and its render for the manifest. The description depends on the task only.
/// It contains no time and no machine. It also omits the scene's name: this can be a file name, but
/// the task's key covers only the file's content.
fn account(scene: &Scene, rendered: &Rendered, max_bounces: Option<u32>) -> serde_json::Value {
    let mut plan = json!({
        "scene": scene.provenance,
        "labels": scene.labels,
        "strategies": rendered.plan.strategies,
        "approximations": rendered.plan.approximations,
        "overflow": rendered.overflow,
        "error": rendered.error,
        "rays": rendered.rays,
    });
    if let Some(most) = max_bounces {
        plan["max_bounces"] = json!(most);
    }
    plan
}
