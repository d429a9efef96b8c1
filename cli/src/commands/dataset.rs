//! `picofarm dataset …`: shows, checks and converts data sets.

pub mod export;
pub mod gc;
pub mod import;
mod late;
mod predictions;
mod problems;
pub mod reconstructions;
pub mod repair;
pub mod reprocess;
pub mod show;
pub mod snapshot;
pub mod split;
pub mod verify;

use std::path::{Path, PathBuf};

use picofarm_dataset::{Dataset, Summary};
use picofarm_figures::{
    inferno,
    scene::{View, flight, sheet},
};
use picofarm_store::{StorageError, open_store};
use picofarm_tasks::TaskError;
use serde_json::json;

use crate::{
    args::Dataset as Command,
    error::{CliError, Code, Result, io},
    output::{
        Output, bytes,
        files::{save, write_atomically},
    },
    settings::Settings,
    signals,
};

pub async fn run(command: Command, settings: &Settings, output: Output) -> Result<()> {
    match command {
        Command::Info { dataset } => {
            if let Some(there) = predictions::find(&dataset).await? {
                return predictions::info(&dataset, &there, output).await;
            }
            if let Some(there) = reconstructions::find(&dataset).await? {
                return reconstructions::info(&dataset, &there, output).await;
            }
            let info = open(&dataset).await?.info().await.map_err(failed)?;
            output.result(&info_json(&dataset, &info), || describe(&dataset, &info));
            Ok(())
        }
        Command::Show(args) => show::run(&args, output).await,
        Command::Verify(args) => verify::run(&args, output).await,
        Command::Repair(args) => repair::run(args, settings, output).await,
        Command::Snapshot(command) => snapshot::run(command, output).await,
        Command::Gc(args) => gc::run(&args, output).await,
        Command::Reprocess(args) => reprocess::run(*args, output).await,
        Command::Export(args) => export::run(args, output).await,
        Command::Import(args) => import::run(*args, output).await,
        Command::Split(args) => split::run(args, output).await,
        Command::Report(args) => reconstructions::report(&args, output).await,
        Command::Picture { dataset, out, rows } => {
            std::fs::create_dir_all(&out).map_err(|e| io(out.display(), &e))?;
            if let Some(there) = reconstructions::find(&dataset).await? {
                let sheet = out.join(SHEET);
                reconstructions::draw(&dataset, &there, rows, &sheet).await?;
                output.result(&json!({"contact_sheet": sheet}), || {
                    sheet.display().to_string()
                });
                return Ok(());
            }
            let present = open(&dataset)
                .await?
                .scenes_present()
                .await
                .map_err(failed)?;
            let scenes = &present[..present.len().min(rows.max(1))];
            let drawn = draw(&dataset, scenes, &out).await?;
            output.result(
                &json!({"contact_sheet": drawn.sheet, "light_in_flight": drawn.flight}),
                || format!("{}\n{}", drawn.sheet.display(), drawn.flight.display()),
            );
            Ok(())
        }
    }
}

fn info_json(place: &str, info: &Summary) -> serde_json::Value {
    json!({
        "dataset": place, "spec": info.spec, "scenes": info.scenes, "bytes": info.bytes,
        "noise": info.noise, "rays": info.rays, "max_sigma": info.max_sigma, "rms_sigma": info.rms_sigma, "overflow": info.overflow,
    })
}

fn describe(place: &str, info: &Summary) -> String {
    let s = &info.spec;
    let end = s.gate.start_m + f64::from(s.gate.bins) * s.gate.bin_width_m;
    let coding = match info.rms_sigma {
        Some((lo, hi)) => format!(
            ", coding error {lo:.3} to {hi:.3} sigma rms, {:.3} at most",
            info.max_sigma
        ),
        None => String::new(),
    };
    let each = info
        .bytes
        .checked_div(info.scenes)
        .map(|b| format!(", {} a scene", bytes(b)));
    format!(
        "{place}: {} of {} scenes, {}{}\n\
         {}x{} pixels x {} bins of {} m from {} to {end:.5} m of path, {} spots\n\
         {}{coding}, {} saturated bins kept exactly\n",
        info.scenes,
        s.scenes,
        bytes(info.bytes),
        each.unwrap_or_default(),
        s.width,
        s.height,
        s.gate.bins,
        s.gate.bin_width_m,
        s.gate.start_m,
        s.spots,
        s.profile,
        info.overflow,
    ) + &further(info)
}

/// Describes the properties that only some data sets have.
fn further(info: &Summary) -> String {
    let mut text = String::new();
    let sizes = info.spec.subsets.sizes();
    let mut alone: Vec<String> = sizes.iter().map(|n| format!("{n} of them")).collect();
    if info.spec.per_spot {
        alone.push("each alone".into());
    }
    if !alone.is_empty() {
        text += &format!("transients also of the spots: {}\n", alone.join(", "));
    }
    if let Some(nm) = info.spec.wavelengths_nm.nm() {
        text += &format!("wavelength {nm} nm\n");
    }
    if let Some(noise) = info.noise {
        text += &format!(
            "Monte Carlo error {:.1} %, median over pixels, then over scenes\n",
            100.0 * noise
        );
    }
    if let Some(rays) = info.rays {
        text += &format!("{:.1} million rays a scene\n", rays / 1e6);
    }
    text
}

/// Splits a data set's location into the store and the folder in it.
fn store_and_folder(place: &str) -> Result<(String, String)> {
    let trimmed = place.trim_end_matches('/');
    let parts = match trimmed.rsplit_once('/') {
        Some(("", folder)) => Some(("/", folder)),
        Some((store, folder)) if !store.ends_with('/') => Some((store, folder)),
        Some(_) => None,
        None => Some((".", trimmed)),
    };
    match parts {
        Some((store, folder)) if !folder.is_empty() && folder != "." && folder != ".." => {
            Ok((store.to_owned(), folder.to_owned()))
        }
        _ => Err(CliError::input(format!(
            "{place:?}: expected the place of a data set: STORE/DATASET"
        ))),
    }
}

/// Converts the failure of a task into the error of a command that runs it on this machine.
pub fn task_failed(error: TaskError) -> CliError {
    let (code, hint) = match &error {
        TaskError::User(_) | TaskError::Damaged(_) => (Code::Input, None),
        TaskError::Crash(_) => (Code::Failed, None),
        TaskError::Interrupted(_) | TaskError::Store(_) => (
            Code::Resource,
            Some("run the same command again; finished work is kept"),
        ),
        TaskError::Stopped => {
            let hint = "run the same command again to go on; finished work is kept";
            return signals::interrupted(hint);
        }
    };
    let failed = CliError::new(code, error);
    match hint {
        Some(hint) => failed.hint(hint),
        None => failed,
    }
}

pub async fn open(place: &str) -> Result<Dataset> {
    let (store, prefix) = open_store(place).map_err(failed)?;
    Dataset::open(store, prefix).await.map_err(failed)
}

pub fn failed(error: StorageError) -> CliError {
    let code = match &error {
        StorageError::Damaged { .. }
        | StorageError::Conflict { .. }
        | StorageError::Diverged { .. } => Code::Damaged,
        StorageError::Store { .. } | StorageError::Io { .. } | StorageError::UnsafeStore { .. } => {
            Code::Resource
        }
        _ => Code::Input,
    };
    let damaged = matches!(error, StorageError::Damaged { .. });
    let rootless = matches!(error, StorageError::NoDataset { .. });
    let failed = CliError::new(code, error);
    if damaged {
        return failed.hint(
            "picofarm dataset verify names all that is broken and how it is repaired, mostly by dataset repair",
        );
    }
    if rootless {
        return failed.hint("if its zarr.json was lost, dataset repair writes it again");
    }
    failed
}

/// Locations of the pictures.
pub struct Drawn {
    pub sheet: PathBuf,
    pub flight: PathBuf,
}

/// File name of a contact sheet.
pub const SHEET: &str = "contact-sheet.png";

/// Draws the contact sheet of `scenes` and the first scene's light in flight into `dir`.
///
/// # Errors
/// Fails if there are no scenes, a scene cannot be read, or the folder cannot be written.
pub async fn draw(place: &str, scenes: &[u64], dir: &Path) -> Result<Drawn> {
    let Some(&first) = scenes.first() else {
        return Err(CliError::input(format!(
            "{place}: no finished scene to draw"
        )));
    };
    let dataset = open(place).await?;
    let drawn = Drawn {
        sheet: dir.join(SHEET),
        flight: dir.join("light-in-flight.gif"),
    };
    let handle = tokio::runtime::Handle::current();
    let (scenes, sheet_path, flight_path) =
        (scenes.to_vec(), drawn.sheet.clone(), drawn.flight.clone());
    tokio::task::spawn_blocking(move || {
        let read = |scene| handle.block_on(view(&dataset, scene)).map_err(failed);
        save(&sheet(&scenes, read)?, &sheet_path)?;
        write_atomically(&flight_path, &flight(&read(first)?, inferno, 1))
    })
    .await
    .map_err(|e| CliError::new(Code::Failed, format!("drawing broke: {e}")))??;
    Ok(drawn)
}

/// Reads what pictures of a scene need.
pub(super) async fn view(dataset: &Dataset, scene: u64) -> Result<View, StorageError> {
    use picofarm_dataset::Quantity as Q;
    let spec = *dataset.spec();
    let intrinsics = dataset.read_intrinsics(scene).await?;
    let spots = dataset.read_spots(scene).await?;
    let film = |s: picofarm_dataset::Spot| {
        let [x, y, z] = s.position;
        (z > 0.0).then(|| {
            [
                intrinsics.fx * x / z + intrinsics.cx,
                intrinsics.fy * y / z + intrinsics.cy,
            ]
        })
    };
    Ok(View {
        scene,
        width: spec.width as usize,
        height: spec.height as usize,
        bins: spec.gate.bins as usize,
        gate_start_m: spec.gate.start_m,
        bin_width_m: spec.gate.bin_width_m,
        transient: dataset.read_transient(scene).await?,
        depth: dataset.read::<f32>(scene, Q::Depth).await?,
        rgb: dataset.read::<u8>(scene, Q::Rgb).await?,
        specular: dataset.read::<u8>(scene, Q::Specular).await?,
        visibility: dataset.read_visibility(scene).await?,
        spots: spots.into_iter().map(|s| s.and_then(film)).collect(),
    })
}
