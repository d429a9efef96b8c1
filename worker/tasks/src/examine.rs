//! Checks whether this machine can run tasks and store their results. `picofarm doctor` runs the
//! checks on its own machine, and with `--farm` on those of all workers.

use std::{io::Read, path::Path, time::Duration};

use picofarm_proto::{
    messages::{Check, Examine, Verdict},
    show::size,
};
use picofarm_session::Memory;
use picofarm_store::{Writable, check_writable, local_ground};

use crate::task::Context;

/// Time limit for a worker's probe of a store, less than a coordinator waits for the answer.
const PROBE: Duration = Duration::from_secs(20);
/// Free disk space below which results will soon not fit, in bytes.
const LITTLE: u64 = 10 << 30;
/// Free disk space below which almost nothing fits, in bytes.
const NONE: u64 = 256 << 20;

/// Runs the checks of a worker.
pub(crate) fn worker(context: &Context, what: &Examine) -> Vec<Check> {
    let named = |place: &str| (!place.is_empty()).then(|| place.to_owned());
    let (store_at, scenes_at) = (named(&what.store), named(&what.scenes));
    let mut checks = Vec::new();
    if let Some(place) = &store_at {
        checks.push(context.stores.runtime().block_on(store(place, PROBE)));
    }
    checks.extend(scenes_at.map(|place| scenes(Path::new(&place))));
    checks.extend([memory(), disk(store_at.as_deref()), furniture(context)]);
    #[cfg(feature = "networks")]
    checks.extend([gpus(context), python(context)]);
    checks
}

/// Reports the memory that tasks may use, the source of this limit, and the free memory.
pub fn memory() -> Check {
    let Some(found) = Memory::here() else {
        let what = "not known here; give workers --memory-gib";
        return Check::new("memory", Verdict::Note, what);
    };
    let (verdict, free) = match free_memory() {
        Some(free) if free < found.for_tasks_mib() << 20 => {
            (Verdict::Note, format!("; only {} free now", size(free)))
        }
        Some(free) => (Verdict::Ok, format!("; {} free now", size(free))),
        None => (Verdict::Ok, String::new()),
    };
    Check::new("memory", verdict, format!("{found}{free}"))
}

/// Returns the memory that programs can get without swapping, in bytes, if the system reports it.
fn free_memory() -> Option<u64> {
    let text = std::fs::read_to_string("/proc/meminfo").ok()?;
    let line = text.lines().find_map(|l| l.strip_prefix("MemAvailable:"))?;
    let kib: u64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(kib << 10)
}

/// Checks a store: exactly one writer must win when several create the same object. Nothing is
/// left behind.
pub async fn store(place: &str, within: Duration) -> Check {
    let (verdict, detail) = match check_writable(place, within).await {
        Ok(Writable::There) => (
            Verdict::Ok,
            format!("{place} is writable and creates each object exactly once"),
        ),
        Ok(Writable::New(ground)) => (
            Verdict::Note,
            format!(
                "{place} does not exist; is it spelled right? The first task would make it in {}, which is writable",
                ground.display()
            ),
        ),
        Err(e) => (Verdict::Bad, e.to_string()),
    };
    Check::new("store", verdict, detail)
}

/// Reads a scene file, or the names in a folder with scenes.
fn scenes(place: &Path) -> Check {
    let read = match place.is_dir() {
        true => std::fs::read_dir(place).map(|names| format!("{} entries", names.count())),
        false => std::fs::File::open(place)
            .and_then(|mut file| file.read(&mut [0; 4096]))
            .map(|_| "readable".to_owned()),
    };
    match read {
        Ok(found) => Check::new(
            "scenes",
            Verdict::Ok,
            format!("{}: {found}", place.display()),
        ),
        Err(e) => Check::new("scenes", Verdict::Bad, format!("{}: {e}", place.display())),
    }
}

/// Reports the free space for results and temporary files.
pub fn disk(store: Option<&str>) -> Check {
    let ground = store.and_then(|place| local_ground(place).ok().flatten());
    let places = ground.into_iter().chain([std::env::temp_dir()]);
    let (mut least, mut details) = (u64::MAX, Vec::new());
    for folder in places {
        match rustix::fs::statvfs(&folder) {
            Ok(about) => {
                let free = about.f_bavail.saturating_mul(about.f_frsize);
                least = least.min(free);
                details.push(format!("{} free in {}", size(free), folder.display()));
            }
            Err(e) => {
                least = 0;
                details.push(format!("{}: {e}", folder.display()));
            }
        }
    }
    let (verdict, advice) = match least {
        0..NONE => (Verdict::Bad, "; free some space"),
        NONE..LITTLE => (Verdict::Note, "; little for a data set"),
        _ => (Verdict::Ok, ""),
    };
    Check::new("disk", verdict, format!("{}{advice}", details.join(", ")))
}

/// Reports the furniture that the worker found when it started.
fn furniture(context: &Context) -> Check {
    let found: Vec<&str> = context.libraries.iter().map(|l| l.fingerprint()).collect();
    match found.is_empty() {
        true => Check::new("furniture", Verdict::Note, "none found"),
        false => Check::new("furniture", Verdict::Ok, found.join(", ")),
    }
}

#[cfg(feature = "networks")]
fn gpus(context: &Context) -> Check {
    let names: Vec<String> = context.gpus.iter().map(ToString::to_string).collect();
    match names.is_empty() {
        true => Check::new("gpus", Verdict::Ok, "none in use"),
        false => Check::new("gpus", Verdict::Ok, names.join(", ")),
    }
}

/// Starts the interpreter again, which may have been removed since the worker started.
#[cfg(feature = "networks")]
fn python(context: &Context) -> Check {
    let Some(known) = &context.python else {
        return Check::new("python", Verdict::Ok, "runs no Python code of jobs");
    };
    match crate::interpreter::Interpreter::find(known.path()) {
        Ok(found) => {
            let torch = match context.torch.is_some() {
                true => ", with PyTorch",
                false => "",
            };
            let detail = format!("{} {}{torch}", known.path().display(), found.version());
            Check::new("python", Verdict::Ok, detail)
        }
        Err(why) => Check::new("python", Verdict::Bad, why),
    }
}
