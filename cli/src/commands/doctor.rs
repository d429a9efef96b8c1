//! `picofarm doctor`: checks whether this machine can render and store.

use picofarm_store::{PROBE_WITHIN, Writable, check_writable};
use serde::Serialize;

use crate::{
    args::Doctor,
    client::Client,
    commands::assets,
    error::{CliError, Code, Result},
    output::{Output, bytes, table},
    settings::Settings,
};

#[derive(Serialize)]
#[serde(rename_all = "snake_case")]
enum Verdict {
    Ok,
    /// Picofarm works without it.
    Note,
    Bad,
}

#[derive(Serialize)]
struct Check {
    what: &'static str,
    verdict: Verdict,
    detail: String,
}

pub async fn run(args: Doctor, settings: &Settings, output: Output) -> Result<()> {
    let checks = [
        processor(),
        memory(),
        store(&args.store).await,
        disk(&args.store),
        furniture(settings),
        gpus(),
        coordinator(settings).await,
    ];
    output.result(&checks, || {
        let rows: Vec<_> = checks
            .iter()
            .map(|c| {
                let verdict = match c.verdict {
                    Verdict::Ok => "ok",
                    Verdict::Note => "note",
                    Verdict::Bad => "BAD",
                };
                vec![verdict.to_owned(), c.what.to_owned(), c.detail.clone()]
            })
            .collect();
        table(&rows)
    });
    match checks.iter().find(|c| matches!(c.verdict, Verdict::Bad)) {
        Some(c) => Err(CliError::new(
            Code::Resource,
            format!("{}: {}", c.what, c.detail),
        )),
        None => Ok(()),
    }
}

fn processor() -> Check {
    Check {
        what: "processor",
        verdict: Verdict::Ok,
        detail: format!("{} cores, {}", picofarm_tasks::cores(), vector_kernel()),
    }
}

/// Reports the memory that tasks may use, and the source of this limit.
fn memory() -> Check {
    let found = picofarm_tasks::Memory::here();
    Check {
        what: "memory",
        verdict: match found {
            Some(_) => Verdict::Ok,
            None => Verdict::Note,
        },
        detail: found.map_or_else(
            || "not known here; give workers --memory-gib".into(),
            |found| found.to_string(),
        ),
    }
}

#[cfg(target_arch = "x86_64")]
fn vector_kernel() -> &'static str {
    if std::arch::is_x86_feature_detected!("avx2") {
        "AVX2 ray kernel"
    } else {
        "portable ray kernel (no AVX2: same results, slower)"
    }
}

#[cfg(not(target_arch = "x86_64"))]
fn vector_kernel() -> &'static str {
    "portable ray kernel (same results, slower)"
}

/// Reports the GPUs for networks. Each is opened and tested.
#[cfg(feature = "networks")]
fn gpus() -> Check {
    use picofarm_model::device;
    let tried: Vec<_> = device::gpus()
        .iter()
        .filter(|gpu| !gpu.is_software())
        .map(device::Gpu::open)
        .collect();
    let (verdict, detail) = match &*tried {
        _ if device::RUNTIMES.is_empty() => (
            Verdict::Note,
            "none: built without --features wgpu or cuda; networks are computed on the CPU".into(),
        ),
        [] => (
            Verdict::Note,
            "none: no driver lists one; networks are computed on the CPU".into(),
        ),
        tried => {
            let each = tried.iter().map(|opened| match opened {
                Ok(gpu) => gpu.to_string(),
                Err(error) => error.to_string(),
            });
            let verdict = match tried.iter().all(Result::is_ok) {
                true => Verdict::Ok,
                false => Verdict::Bad,
            };
            (verdict, each.collect::<Vec<_>>().join("; "))
        }
    };
    Check {
        what: "graphics processors",
        verdict,
        detail,
    }
}

#[cfg(not(feature = "networks"))]
fn gpus() -> Check {
    Check {
        what: "graphics processors",
        verdict: Verdict::Note,
        detail: "none: built without networks, which alone are computed there".into(),
    }
}

/// Checks a store: exactly one writer must win when several create the same object.
async fn store(place: &str) -> Check {
    let (verdict, detail) = match check_writable(place, PROBE_WITHIN).await {
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
    Check {
        what: "store",
        verdict,
        detail,
    }
}

/// Free disk space below which results will soon not fit, in bytes.
const LITTLE: u64 = 10 << 30;
/// Free disk space below which almost nothing fits, in bytes.
const NONE: u64 = 256 << 20;

/// Reports the free space for results and temporary files.
fn disk(place: &str) -> Check {
    let ground = picofarm_store::local_ground(place).ok().flatten();
    let places = ground.into_iter().chain([std::env::temp_dir()]);
    let (mut least, mut details) = (u64::MAX, Vec::new());
    for folder in places {
        match rustix::fs::statvfs(&folder) {
            Ok(about) => {
                let free = about.f_bavail.saturating_mul(about.f_frsize);
                least = least.min(free);
                details.push(format!("{} free in {}", bytes(free), folder.display()));
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
    Check {
        what: "disk",
        verdict,
        detail: format!("{}{advice}", details.join(", ")),
    }
}

fn furniture(settings: &Settings) -> Check {
    match assets::resolve("sweethome3d", &settings.assets) {
        Ok(fingerprint) => Check {
            what: "furniture",
            verdict: Verdict::Ok,
            detail: fingerprint,
        },
        Err(_) => Check {
            what: "furniture",
            verdict: Verdict::Note,
            detail: "parametric only; `picofarm assets install` fetches real models".into(),
        },
    }
}

async fn coordinator(settings: &Settings) -> Check {
    let url = &settings.coordinator;
    let ask = async {
        let mut client = Client::connect(url, &settings.access()?).await?;
        client.server().await
    };
    let answer = ask.await;
    let (verdict, detail) = match answer {
        Ok((version, protocol, workers)) => (
            Verdict::Ok,
            format!("{url}: version {version}, protocol {protocol}, {workers} worker(s)"),
        ),
        Err(e) => (Verdict::Note, e.message),
    };
    Check {
        what: "coordinator",
        verdict,
        detail,
    }
}
