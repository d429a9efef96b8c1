//! `picofarm doctor`: checks whether this machine can render and store.

mod farm;

use picofarm_proto::messages::{Check, Verdict};
use picofarm_store::PROBE_WITHIN;
use picofarm_tasks::examine::{disk, memory, store};

use crate::{
    args::Doctor,
    client::Client,
    commands::assets,
    error::{CliError, Code, Result},
    output::{Output, table},
    settings::Settings,
};

pub async fn run(args: Doctor, settings: &Settings, output: Output) -> Result<()> {
    if args.farm {
        return farm::run(&args, settings, output).await;
    }
    let place = args.store.as_deref().unwrap_or(".");
    let checks = [
        processor(),
        memory(),
        store(place, PROBE_WITHIN).await,
        disk(Some(place)),
        furniture(settings),
        gpus(),
        coordinator(settings).await,
    ];
    output.result(&checks, || {
        let rows: Vec<_> = checks
            .iter()
            .map(|c| vec![c.verdict.word().into(), c.what.clone(), c.detail.clone()])
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
        what: "processor".into(),
        verdict: Verdict::Ok,
        detail: format!("{} cores, {}", picofarm_tasks::cores(), vector_kernel()),
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
        what: "graphics processors".into(),
        verdict,
        detail,
    }
}

#[cfg(not(feature = "networks"))]
fn gpus() -> Check {
    Check {
        what: "graphics processors".into(),
        verdict: Verdict::Note,
        detail: "none: built without networks, which alone are computed there".into(),
    }
}

fn furniture(settings: &Settings) -> Check {
    match assets::resolve("sweethome3d", &settings.assets) {
        Ok(fingerprint) => Check {
            what: "furniture".into(),
            verdict: Verdict::Ok,
            detail: fingerprint,
        },
        Err(_) => Check {
            what: "furniture".into(),
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
        what: "coordinator".into(),
        verdict,
        detail,
    }
}
