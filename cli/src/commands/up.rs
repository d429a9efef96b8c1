//! `picofarm up`: a coordinator and workers on one machine.

use picofarm_settings::Gpus;
use serde_json::json;
use tokio_util::sync::CancellationToken;

use crate::{
    args::Up,
    commands::{
        coordinator::{Guarded, refuse_unguarded},
        local::Local,
    },
    error::{Result, io},
    output::{Output, program},
    settings::Settings,
    signals,
};

/// Runs a coordinator and workers until a signal.
///
/// # Errors
/// Fails if the address or catalog is in use, or if a worker ends.
pub async fn run(args: Up, settings: &Settings, output: Output) -> Result<()> {
    let guarded = Guarded::from_args(&args.guard);
    let open = guarded.is_open();
    refuse_unguarded(args.listen, &args.guard, true)?;
    let gpus = gpu_names(&args.gpus)?;
    std::fs::create_dir_all(&args.dir).map_err(|e| io(args.dir.display(), &e))?;
    let stop = signals::stop_on_signal()?;
    let catalog = args.dir.join("catalog.sqlite");
    let mut farm = Local::start(
        &catalog,
        args.listen,
        (args.workers, &gpus, &args.own),
        settings,
        guarded,
        args.http.http,
        args.traces.url(),
    )
    .await?;
    let web = match args.no_web {
        true => None,
        false => pages(&args, &farm.url, open, settings, &stop).await?,
    };
    let told = json!({
        "coordinator": farm.url, "workers": args.workers, "http": farm.http, "web": web,
    });
    output.result(&told, || {
        let web = web.as_deref();
        let web = web.map_or(String::new(), |link| format!("\nin a browser: {link}"));
        format!(
            "coordinator at {} with {} worker(s); submit with `{} --coordinator {} job submit FILE`{web}",
            farm.url, args.workers, program(), farm.url
        )
    });
    let lost = tokio::select! {
        lost = farm.worker_lost() => Some(lost),
        () = stop.cancelled() => None,
    };
    stop.cancel();
    farm.stop().await?;
    lost.map_or(Ok(()), Err)
}

/// Serves the pages in the background, and returns their link; `None` if the program is built
/// without them.
#[cfg(feature = "web")]
async fn pages(
    args: &Up,
    url: &str,
    open: bool,
    settings: &Settings,
    stop: &CancellationToken,
) -> Result<Option<String>> {
    let access = match open {
        true => picofarm_tasks::Access::default(),
        false => settings.access()?,
    };
    let farm = super::web::Coordinator::new(url, access);
    let store = args.dir.display().to_string();
    let server = super::web::start_for_up(store, farm).await?;
    let link = server.link("/");
    tokio::spawn(server.serve(stop.clone()));
    Ok(Some(link))
}

#[cfg(not(feature = "web"))]
async fn pages(
    _: &Up,
    _: &str,
    _: bool,
    _: &Settings,
    _: &CancellationToken,
) -> Result<Option<String>> {
    Ok(None)
}

/// Returns the names of the GPUs, which workers open.
fn gpu_names(gpus: &Gpus) -> Result<Vec<String>> {
    #[cfg(feature = "networks")]
    let names = picofarm_model::device::names(gpus)
        .map_err(|e| crate::error::CliError::input(e.to_string()));
    #[cfg(not(feature = "networks"))]
    let names = match gpus == &Gpus::default() {
        true => Ok(Vec::new()),
        false => Err(crate::error::not_built("networks", "graphics processors")),
    };
    names
}
