//! `picofarm demo`: renders furnished rooms with a whole farm on one machine, and shows them.

mod room;
mod rooms;
mod sheet;

use std::{io::IsTerminal as _, net::SocketAddr, path::Path};

use picofarm_proto::{
    ids::JobId,
    messages::{JobState, JobStatus},
    show,
    spec::{Budget, JobSpec, OutputSettings, RenderSettings, RenderTask, SceneKind, SceneSource},
};
use picofarm_settings::{FloorPlan, Resolution};
use picofarm_tasks::Access;
use serde_json::json;
use tokio_util::sync::CancellationToken;

use room::Room;
use rooms::Rooms;
use sheet::GrowingSheet;

use crate::{
    args::{Demo, OwnPython},
    client::{
        Client, Submitted,
        follow::{Show, follow, verdict},
        jobfile,
        stores::{self, Identity},
    },
    commands::{coordinator::Guarded, dataset, local::Local},
    error::{CliError, Result, io},
    output::{Output, bytes, program},
    settings::Settings,
    signals,
};

fn task(args: &Demo) -> RenderTask {
    RenderTask {
        parts: 1,
        scenes: SceneSource {
            kind: SceneKind::Furnished {
                assets: args.assets.clone(),
                min_specular: 1,
                floor_plan: FloorPlan::Box,
            },
            count: args.scenes,
            seed: args.seed,
            fov_deg: Some(90.0),
            spots: args.spots.clone(),
            laser_m: [0.0; 3],
        },
        render: RenderSettings {
            resolution: Resolution::square(args.resolution),
            budget: Budget::Samples(args.samples),
            ..RenderSettings::default()
        },
        output: OutputSettings {
            store: "store".into(),
            dataset: "rooms".into(),
            profile: "sqrt-u16".into(),
        },
    }
}

fn dataset_of(task: &RenderTask) -> String {
    format!("{}/{}", task.output.store, task.output.dataset)
}

/// The requested work, with locations and versions pinned.
struct Asked<'a> {
    reconstruct: bool,
    dir: &'a Path,
    settings: &'a Settings,
}

impl Asked<'_> {
    fn job(&self, task: &RenderTask) -> Result<JobSpec> {
        let mut job = JobSpec::render("demo", task.clone());
        if self.reconstruct {
            let stage = rooms::stage(task, self.dir, self.settings)?;
            job.stages.push(stage);
            job.resolve()?;
        }
        Ok(job)
    }
}

/// Returns whether the data set already belongs to other settings.
async fn taken(task: &RenderTask) -> Result<bool> {
    let place = dataset_of(task);
    if !Path::new(&place).join("zarr.json").exists() {
        return Ok(false);
    }
    let key = task.stage_key().to_string();
    let dataset = dataset::open(&place).await?;
    // Each worker stores its recipe before it makes a scene.
    let recipes = dataset.recipe_keys().await.map_err(dataset::failed)?;
    Ok(recipes.iter().any(|recipe| *recipe != key))
}

/// Whether a job is refused for the data set that it names. Of several stages, the field begins
/// with the stage's name.
fn is_of_dataset(error: &CliError) -> bool {
    let field = error.field.as_deref();
    field.is_some_and(|field| field.ends_with("output.dataset"))
}

/// Submits the demo. Where its data set is another demo's, whose furniture, resolution, spots or
/// samples were others, it gets one of its own, whose name is always the same for the same
/// settings.
async fn submit(
    client: &mut Client,
    mut task: RenderTask,
    asked: &Asked<'_>,
    output: Output,
) -> Result<(RenderTask, JobSpec, Submitted)> {
    if !taken(&task).await? {
        let mut first = asked.job(&task)?;
        stores::identify(&mut first, Identity::Create, output).await;
        match client.submit(first.clone(), false).await {
            Ok(submitted) => return Ok((task, first, submitted)),
            // A job of other settings was to write there, and made nothing yet.
            Err(e) if is_of_dataset(&e) => {}
            Err(e) => return Err(e),
        }
    }
    let before = dataset_of(&task);
    let key = task.stage_key().to_string();
    task.output.dataset += &format!("-{}", key.get(..8).unwrap_or(&key));
    output.say(format!(
        "{before} is for rooms of other settings (furniture, resolution, spots, seed or samples) and stays as it is; these \
         go to {}",
        dataset_of(&task)
    ));
    let mut own = asked.job(&task)?;
    stores::identify(&mut own, Identity::Create, output).await;
    let submitted = client.submit(own.clone(), false).await?;
    Ok((task, own, submitted))
}

/// Renders, verifies and shows a data set, and reconstructs its rooms if requested.
///
/// # Errors
/// Fails on invalid arguments, a folder with another demo, an interruption, or any failed step.
pub async fn run(args: Demo, settings: &Settings, output: Output) -> Result<()> {
    let dir = std::path::absolute(&args.dir).map_err(|e| io(args.dir.display(), &e))?;
    let task = jobfile::resolve_render(task(&args), &dir, &settings.assets)?;
    std::fs::create_dir_all(&dir).map_err(|e| io(dir.display(), &e))?;
    let workers = args
        .workers
        .unwrap_or_else(|| picofarm_tasks::cores().min(2))
        .max(1);
    let r = &task.render;
    output.say(format!(
        "{} furnished rooms, {1}x{1} pixels x {2} bins, {3} spots, {4}; {workers} worker{5} in {6}",
        task.scenes.count,
        r.resolution,
        r.bins,
        task.scenes.spots,
        furniture(&task),
        if workers == 1 { "" } else { "s" },
        dir.display(),
    ));
    if args.reconstruct {
        output.say(rooms::announced());
    }
    let asked = Asked {
        reconstruct: args.reconstruct,
        dir: &dir,
        settings,
    };
    let stop = signals::stop_on_signal()?;
    let any = SocketAddr::from(([127, 0, 0, 1], 0));
    let mut farm = Local::start(
        &dir.join("catalog.sqlite"),
        any,
        (workers, &[], &OwnPython::default()),
        settings,
        Guarded::default(),
        None,
        args.traces.url(),
    )
    .await?;
    // This process's own coordinator requires no authentication.
    let mut client = Client::connect(&farm.url, &Access::default()).await?;
    let rendered = tokio::select! {
        status = render(&mut client, task, &asked, output) => Some(status),
        lost = farm.worker_lost() => Some(Err(lost)),
        () = stop.cancelled() => None,
    };
    farm.stop().await?;
    let Some(status) = rendered else {
        return Err(signals::interrupted(
            "run the same command again: it continues where it stopped",
        ));
    };
    let (place, job, status) = status?;
    verdict(&status)?;
    tokio::select! {
        told = tell(&args, &dir, &place, job, &status, output) => told?,
        () = stop.cancelled() => return Err(signals::interrupted(
            "run the same command again: it continues where it stopped",
        )),
    }
    // Scripts have no use for pages, and wait for the end.
    let person = std::io::stdin().is_terminal() && std::io::stdout().is_terminal();
    match person && !output.json && !args.no_web {
        true => serve(&dir, settings, output, stop).await,
        false => Ok(()),
    }
}

/// Serves the rooms to a browser until a signal.
#[cfg(feature = "web")]
async fn serve(
    dir: &Path,
    settings: &Settings,
    output: Output,
    stop: CancellationToken,
) -> Result<()> {
    // The demo's farm has ended: there are only its data sets.
    let farm = super::web::Coordinator::new(&settings.coordinator, settings.access()?);
    let server = super::web::start_for_up(dir.display().to_string(), farm).await?;
    if let Some(path) = server.first_flight().await {
        output.say(format!("light in flight  {}", server.link(&path)));
    }
    output.say(format!("in a browser     {}", server.link("/data")));
    output.say("Ctrl-C ends the pages; all results stay");
    server.serve(stop).await;
    Ok(())
}

#[cfg(not(feature = "web"))]
#[expect(clippy::unused_async, reason = "like the other")]
async fn serve(_: &Path, _: &Settings, _: Output, _: CancellationToken) -> Result<()> {
    Ok(())
}

/// Renders the rooms. Returns the location, the job and its final status.
async fn render(
    client: &mut Client,
    task: RenderTask,
    asked: &Asked<'_>,
    output: Output,
) -> Result<(String, JobId, JobStatus)> {
    let (task, spec, mut submitted) = submit(client, task, asked, output).await?;
    let earlier = client.status(submitted.job).await?;
    match earlier.state {
        JobState::Failed => {
            client.retry(submitted.job).await?;
        }
        JobState::Cancelled => submitted = client.submit(spec, true).await?,
        JobState::Active | JobState::Done => {}
    }
    if submitted.existed {
        for (stage, what) in earlier.stages.iter().zip(["scenes", "reconstructions"]) {
            if stage.tasks.done > 0 {
                let done = stage.tasks.done;
                output.say(format!(
                    "{done} {what} are finished already and stay as they are"
                ));
            }
        }
    }
    let progress = if output.json {
        Show::Nothing
    } else {
        Show::Progress
    };
    let place = dataset_of(&task);
    output.say(format!(
        "pictures of finished rooms: {}",
        asked.dir.join(dataset::SHEET).display()
    ));
    let sheet = GrowingSheet::start(place.clone(), task.scenes.count, asked.dir.to_owned());
    let followed = follow(client, submitted.job, output, progress).await;
    sheet.stop().await;
    Ok((place, submitted.job, followed?))
}

async fn tell(
    args: &Demo,
    dir: &Path,
    place: &str,
    job: JobId,
    status: &JobStatus,
    output: Output,
) -> Result<()> {
    output.say("verifying what was written …");
    let report = dataset::verify::check(place).await?;
    let scenes: Vec<u64> = (0..args.scenes).collect();
    output.say("drawing …");
    let pictures = dataset::draw(place, &scenes[..scenes.len().min(sheet::ROOMS)], dir).await?;
    let rooms = match args.reconstruct {
        true => Some(Rooms::verify(place, dir).await?),
        false => None,
    };
    output.say("taking one flash apart, and reconstructing its room …");
    let room = Room::of(place, dir).await?;
    let took = status.ended_at_ms.map_or(0, |e| e - status.submitted_at_ms) as f64 / 1000.0;
    let reused = status.stages.first().map_or(0, |s| s.tasks.reused);
    let mut summary = json!({
        "job": job, "dataset": place, "scenes": args.scenes, "reused": reused,
        "bytes": report.bytes, "objects": report.objects, "seconds": took,
        "contact_sheet": pictures.sheet, "light_in_flight": pictures.flight, "room": room.facts(),
    });
    if let Some(rooms) = &rooms {
        summary["reconstructions"] = rooms.facts();
    }
    let program = program();
    output.result(&summary, || {
        format!(
            "{} scenes, {} in {} objects, all verified\n\
             data set         {}\n\
             contact sheet    {}\n\
             light in flight  {}\n\
             {}{}\
             next:\n  \
             {program} web --store {}\n  \
             {program} dataset info {}\n  \
             {}\
             {program} scene generate --kind furnished --seed 7 --out room.glb\n  \
             {program} reconstruct room.glb --spots-from flash --out room-3d\n  \
             {program} job init && {program} up\n",
            args.scenes,
            bytes(report.bytes),
            report.objects,
            show::line(place),
            pictures.sheet.display(),
            pictures.flight.display(),
            room.told(),
            rooms.as_ref().map(Rooms::summary).unwrap_or_default(),
            show::argument(&dir.display().to_string()),
            show::argument(place),
            rooms.as_ref().map(Rooms::next).unwrap_or_default(),
        )
    });
    Ok(())
}

fn furniture(task: &RenderTask) -> String {
    match &task.scenes.kind {
        SceneKind::Furnished { assets, .. } if assets.starts_with("parametric") => {
            "parametric furniture (`picofarm assets install` fetches real models)".into()
        }
        SceneKind::Furnished { assets, .. } => format!("furniture {assets}"),
        _ => String::new(),
    }
}
