//! `picofarm doctor`: is this machine fit to render and store?

use serde::Serialize;

use crate::{
    args::Doctor,
    assets,
    client::Client,
    error::{CliError, Code, Result},
    output::{Output, table},
    roles,
    settings::Settings,
};

#[derive(Serialize)]
#[serde(rename_all = "snake_case")]
enum Verdict {
    Ok,
    /// Works without it.
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
        store(&args.store).await,
        furniture(settings),
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
        detail: format!("{} cores, {}", roles::cores(), vector_kernel()),
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

/// A store must give exactly one winner when several writers create the same object.
async fn store(place: &str) -> Check {
    let probed = match picofarm_dataset::open_store(place) {
        Ok((store, prefix)) => picofarm_dataset::probe(&*store, &prefix).await,
        Err(e) => Err(e),
    };
    Check {
        what: "store",
        verdict: if probed.is_ok() {
            Verdict::Ok
        } else {
            Verdict::Bad
        },
        detail: match probed {
            Ok(()) => format!("{place} is writable and creates each object exactly once"),
            Err(e) => e.to_string(),
        },
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
