//! Checks that a task fits into the memory available to this worker's tasks.
//! [`picofarm_proto::spec::memory`] defines that limit.

use picofarm_dataset::DatasetSpec;
use picofarm_proto::{
    show,
    spec::{
        SceneKind, StageSpec, TaskSpec,
        memory::{Known, Rendering, Shape, gib, peak_bytes},
    },
};
use picofarm_scene::Scene;
use picofarm_session::{Memory, TaskError};
use picofarm_transient::Settings;

/// Returns the properties of a data set's scenes that determine memory use.
pub(crate) fn shape(spec: &DatasetSpec) -> Shape {
    Shape {
        height: spec.height,
        width: spec.width,
        bins: spec.gate.bins,
        spots: spec.spots,
    }
}

/// Rejects a task that uses more than `limit_mib`; 0 = unknown, which rejects nothing. Returns the
/// memory left to the task, in MiB; `None` = unknown.
///
/// # Errors
/// [`TaskError::User`] with the required and available memory, and a remedy.
pub(crate) fn check(
    task: &TaskSpec,
    known: &Known,
    limit_mib: u64,
) -> Result<Option<u64>, TaskError> {
    let threads = rayon::current_num_threads() as u32;
    let Some(needed) = peak_bytes(task, known, threads) else {
        return Ok(None);
    };
    let limit = limit_mib << 20;
    if limit == 0 {
        return Ok(None);
    }
    if needed <= limit {
        return Ok(Some((limit - needed) >> 20));
    }
    Err(TaskError::User(format!(
        "a {} task like this takes about {} of memory, but tasks of this worker may take {}; run it on a larger machine, \
         or ask for fewer pixels, bins or histograms",
        task.kind(),
        gib(needed),
        gib(limit),
    )))
}

/// Side of the renderer's tiles, pixels. One thread renders a tile.
const TILE: u32 = 32;

/// Returns how many tasks of a stage may run at the same time on `threads`. Each has a thread for
/// each of its tiles, or the cores that it asks for if they are more. One more task computes while
/// another waits for its store. Together they take at most `limit_mib`; 0 = unknown. Only renders
/// of generated scenes run together, because the memory of other tasks depends on what they read.
pub(crate) fn together(stage: &StageSpec, threads: usize, limit_mib: u64) -> usize {
    let TaskSpec::Render(render) = &stage.task else {
        return 1;
    };
    let of_files = matches!(render.scenes.kind, SceneKind::Files { .. });
    if of_files || render.parts > 1 || stage.resources.gpus > 0 {
        return 1;
    }
    let size = render.render.resolution;
    let tiles = u64::from(size.width.div_ceil(TILE)) * u64::from(size.height.div_ceil(TILE));
    let cores = tiles.max(stage.resources.cores.into());
    let fit = match peak_bytes(&stage.task, &Known::default(), threads as u32) {
        Some(bytes) if limit_mib > 0 => (limit_mib << 20) / bytes.max(1),
        Some(_) => u64::MAX,
        None => 1,
    };
    let most = match threads as u64 / cores {
        0 => 1,
        side_by_side => side_by_side + 1,
    };
    usize::try_from(most.min(fit)).unwrap_or(usize::MAX).max(1)
}

/// Width and height of the image, and the number of triangles of a scene.
pub type SceneSize = ((u32, u32), usize);

/// Returns the size of a scene.
pub fn scene_size(scene: &Scene) -> SceneSize {
    let i = &scene.camera.intrinsics;
    ((i.width, i.height), scene.triangle_count())
}

fn rendering(
    settings: &Settings,
    ((width, height), triangles): SceneSize,
    threads: usize,
) -> Rendering {
    Rendering {
        shape: Shape {
            height,
            width,
            bins: settings.gate.bins,
            spots: 25,
        },
        histograms: 1 + settings.groups.len() as u32,
        split: settings.split,
        light_paths: settings.max_bounces.is_none_or(|most| most >= 2),
        triangles: triangles as u64,
        threads: threads as u32,
    }
}

/// Rejects a render of a known scene that uses more than `limit_mib`; 0 = unknown, which rejects
/// nothing.
///
/// # Errors
/// [`TaskError::User`] with the required and available memory, and a remedy.
pub(crate) fn check_render(
    settings: &Settings,
    scene: &Scene,
    limit_mib: u64,
) -> Result<(), TaskError> {
    let (size, limit) = (scene_size(scene), limit_mib << 20);
    let needed = render_bytes(settings, size, rayon::current_num_threads());
    if limit == 0 || needed <= limit {
        return Ok(());
    }
    Err(TaskError::User(format!(
        "scene {} has {} triangles: to render it takes about {} of memory, but tasks of this worker may take {}; run it on a larger \
         machine, or ask for fewer triangles, pixels, bins or histograms",
        show::line(&scene.name),
        size.1,
        gib(needed),
        gib(limit),
    )))
}

/// Returns the maximum memory of a render of a scene of this size, in bytes.
pub fn render_bytes(settings: &Settings, size: SceneSize, threads: usize) -> u64 {
    rendering(settings, size, threads).peak_bytes()
}

/// Checks that a render fits into the memory available to tasks on this machine, if the system
/// reports it.
///
/// # Errors
/// Returns a message with the required and available memory, and a remedy.
pub fn check_memory(settings: &Settings, size: SceneSize, threads: usize) -> Result<(), String> {
    let needed = render_bytes(settings, size, threads);
    match Memory::here() {
        Some(there) if needed > there.for_tasks_mib() << 20 => Err(format!(
            "{} histograms of {}x{} pixels x {} bins, and a scene of {} triangles, take about {} of memory, but there is {there}; \
             ask for fewer of any",
            rendering(settings, size, threads).histograms + if settings.split { 6 } else { 0 },
            size.0.0,
            size.0.1,
            settings.gate.bins,
            size.1,
            gib(needed),
        )),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use picofarm_proto::spec::JobSpec;
    use picofarm_scene::primitive::{self, PrimitiveSettings};
    use picofarm_transient::{Budget, Gate};

    use super::*;

    fn settings() -> Settings {
        let gate = Gate {
            start_m: 1.0,
            bin_width_m: 0.0384,
            bins: 637,
        };
        Settings {
            one_bounce: true,
            ..Settings::new(gate, Budget::Samples(4))
        }
    }

    #[test]
    fn a_scene_of_too_many_triangles_is_refused_once_it_is_known() {
        let small = PrimitiveSettings {
            width: 8,
            height: 8,
            ..PrimitiveSettings::default()
        };
        let mut scene = primitive::generate(1, &small).unwrap();
        assert!(check_render(&settings(), &scene, 1024).is_ok());
        let mesh = Arc::make_mut(&mut scene.objects[0].mesh);
        mesh.triangles.resize(2_000_000, [0, 1, 2]);
        mesh.triangle_material.resize(2_000_000, 0);
        let refused = check_render(&settings(), &scene, 1024).unwrap_err();
        let refused = refused.to_string();
        assert!(
            refused.contains("triangles: to render it takes about 1."),
            "{refused}"
        );
        assert!(refused.contains("may take 1.0 GiB"), "{refused}");
        assert!(check_render(&settings(), &scene, 0).is_ok());
        assert!(check_render(&settings(), &scene, 4096).is_ok());
    }

    #[test]
    fn a_render_that_no_machine_holds_is_refused_with_what_it_takes() {
        let mut settings = settings();
        assert_eq!(check_memory(&settings, ((16, 16), 12), 2), Ok(()));
        settings.groups = (0..100).map(|beam| vec![beam]).collect();
        let bytes = render_bytes(&settings, ((256, 256), 12), 1) as f64;
        assert!((16.8e9..30e9).contains(&bytes), "{bytes}");
        if Memory::here().is_some() {
            let refused = check_memory(&settings, ((16_384, 16_384), 12), 1).unwrap_err();
            assert!(
                refused.contains("101 histograms of 16384x16384"),
                "{refused}"
            );
        }
    }

    #[test]
    fn a_task_is_refused_by_the_workers_own_limit() {
        let job = r#"{"name": "m", "stage": [{"scenes": {"kind": "primitive", "count": 1},
            "render": {"renderer": "r", "resolution": 1024}, "output": {"store": "/s", "dataset": "d"}}]}"#;
        let job: JobSpec = serde_json::from_str(job).unwrap();
        let of = |limit| check(&job.stages[0].task, &Known::default(), limit);
        let refused = of(1024).unwrap_err().to_string();
        assert!(refused.contains("GiB of memory"), "{refused}");
        assert!(refused.contains("may take 1.0 GiB"), "{refused}");
        let left = of(1 << 20).unwrap().unwrap();
        assert!(left < 1 << 20);
        // A task that uses all of a worker's memory is accepted, with none left.
        assert_eq!(of((1 << 20) - left), Ok(Some(0)));
        assert!(of((1 << 20) - left - 1).is_err());
        assert_eq!(of(0), Ok(None), "not known");
    }

    #[test]
    fn small_renders_share_threads_and_memory_and_large_ones_run_alone() {
        let stage = |side: u32, cores: u32| -> StageSpec {
            let text = format!(
                r#"{{"name": "j", "scenes": {{"kind": "primitive", "count": 9}},
                    "render": {{"renderer": "r", "resolution": {side}, "bins": 64}},
                    "resources": {{"cores": {cores}}}, "output": {{"store": "s", "dataset": "d"}}}}"#
            );
            let job: picofarm_proto::spec::JobSpec = serde_json::from_str(&text).unwrap();
            job.stages[0].clone()
        };
        let plenty = 1 << 20;
        // One renders while another is published, also on a single thread.
        assert_eq!(together(&stage(1, 0), 1, plenty), 2);
        assert_eq!(together(&stage(32, 1), 16, plenty), 17);
        assert_eq!(together(&stage(64, 1), 16, plenty), 5);
        assert_eq!(together(&stage(256, 1), 16, plenty), 1);
        // The cores that a task asks for count if they are more than its tiles.
        assert_eq!(together(&stage(1, 8), 16, plenty), 3);
        assert_eq!(together(&stage(1, 16), 16, plenty), 2);
        let one = peak_bytes(&stage(1, 1).task, &Known::default(), 16).unwrap() >> 20;
        assert_eq!(together(&stage(1, 1), 16, 3 * (one + 1)), 3);
        assert_eq!(together(&stage(1, 1), 16, 1), 1);
        assert_eq!(together(&stage(1, 1), 16, 0), 17);
    }
}
