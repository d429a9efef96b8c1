//! The benchmark's scenes: rendered now, or from a data set with unmodified floats.

use std::{net::SocketAddr, path::Path};

use picofarm_dataset::{Dataset, Profile};
use picofarm_proto::spec::{
    Budget, JobSpec, OutputSettings, RenderSettings, RenderTask, SceneKind, SceneSource, Spots,
};
use picofarm_settings::{FloorPlan, Resolution};
use picofarm_tasks::Access;
use tokio_util::sync::CancellationToken;

use super::sample::Sample;
use crate::args::Store as StoreArgs;
use picofarm_cli::{
    args::OwnPython,
    client::{
        Client,
        follow::{Show, follow, verdict},
        jobfile,
    },
    commands::{coordinator::Guarded, dataset, local::Local},
    error::{CliError, Result, io},
    output::Output,
    settings::Settings,
    signals,
};

/// Returns the data set to measure: `--from`, or rooms rendered into `dir` by a farm of one worker.
///
/// # Errors
/// Fails if the data set has lost precision or has no scenes, if a render fails, or on an
/// interruption.
pub async fn source(
    args: &StoreArgs,
    dir: &Path,
    settings: &Settings,
    output: Output,
    stop: &CancellationToken,
) -> Result<Dataset> {
    if let Some(place) = &args.from {
        let dataset = dataset::open(place).await?;
        if dataset.spec().profile != Profile::LOSSLESS {
            let what = format!(
                "--from {place}: expected the profile lossless, found {}",
                dataset.spec().profile
            );
            return Err(CliError::input(what)
                .hint("render with profile = \"lossless\" under [output], or leave --from out"));
        }
        return Ok(dataset);
    }
    let task = RenderTask {
        scenes: SceneSource {
            kind: SceneKind::Furnished {
                assets: "parametric".into(),
                min_specular: 1,
                floor_plan: FloorPlan::Box,
            },
            count: args.scenes,
            seed: args.seed,
            fov_deg: Some(90.0),
            spots: Spots::Grid(25),
            laser_m: [0.0; 3],
        },
        render: RenderSettings {
            resolution: Resolution::square(args.resolution),
            budget: Budget::Samples(args.samples),
            ..RenderSettings::default()
        },
        output: OutputSettings {
            store: "store".into(),
            dataset: "lossless".into(),
            profile: "lossless".into(),
        },
        parts: 1,
    };
    std::fs::create_dir_all(dir).map_err(|e| io(dir.display(), &e))?;
    let dir = std::path::absolute(dir).map_err(|e| io(dir.display(), &e))?;
    let task = jobfile::resolve_render(task, &dir, &settings.assets)?;
    let place = format!("{}/{}", task.output.store, task.output.dataset);
    render(JobSpec::render("bench", task), &dir, settings, output, stop).await?;
    dataset::open(&place).await
}

async fn render(
    spec: JobSpec,
    dir: &Path,
    settings: &Settings,
    output: Output,
    stop: &CancellationToken,
) -> Result<()> {
    let any = SocketAddr::from(([127, 0, 0, 1], 0));
    let catalog = dir.join("catalog.sqlite");
    let mut farm = Local::start(
        &catalog,
        any,
        (1, &[], &OwnPython::default()),
        settings,
        Guarded::default(),
        None,
        None,
    )
    .await?;
    // This process's own coordinator requires no authentication.
    let mut client = Client::connect(&farm.url, &Access::default()).await?;
    let job = client.submit(spec, false).await?.job;
    let show = match output.json {
        true => Show::Nothing,
        false => Show::Progress,
    };
    let status = tokio::select! {
        status = follow(&mut client, job, output, show) => Some(status),
        lost = farm.worker_lost() => Some(Err(lost)),
        () = stop.cancelled() => None,
    };
    farm.stop().await?;
    match status {
        Some(status) => verdict(&status?),
        None => Err(signals::interrupted(
            "with --keep, the same command goes on with what is rendered",
        )),
    }
}

/// Reads the scenes to measure.
///
/// # Errors
/// Fails if there are none, or one cannot be read.
pub async fn samples(dataset: &Dataset, most: u64) -> Result<Vec<Sample>> {
    let scenes = dataset.scenes_present().await.map_err(CliError::input)?;
    let mut samples = Vec::new();
    for scene in scenes.into_iter().take(most as usize) {
        let sample = Sample::read(dataset, scene).await;
        samples.push(sample.map_err(CliError::input)?);
    }
    if samples.is_empty() {
        return Err(CliError::input("the data set has no published scene"));
    }
    Ok(samples)
}
