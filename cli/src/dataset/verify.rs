//! `picofarm dataset verify`: what is broken, and how it is repaired.

use std::{
    sync::Mutex,
    time::{Duration, Instant},
};

use picofarm_dataset::{Dataset, Problem, Snapshot, Verification, VerifyMode, VerifyOptions};
use picofarm_proto::show;
use serde_json::{Value, json};

use super::{failed, open, predictions, reconstructions};
use crate::{
    args::DatasetVerify,
    error::{CliError, Code, Result},
    output::{Meter, Output, bytes},
};

/// Problems and unfinished scenes that are shown to people.
const SHOWN: usize = 20;

pub async fn run(args: &DatasetVerify, output: Output) -> Result<()> {
    if let Some(there) = predictions::find(&args.dataset).await? {
        return predictions::verify(args, &there, output).await;
    }
    if let Some(there) = reconstructions::find(&args.dataset).await? {
        return reconstructions::verify(args, &there, output).await;
    }
    let dataset = open(&args.dataset).await?;
    let snapshot = match &args.snapshot {
        Some(name) => Some(dataset.snapshot(name).await.map_err(failed)?),
        None => None,
    };
    let how = How {
        fast: args.fast,
        complete: args.complete,
        snapshot: snapshot.as_ref(),
    };
    let report = look(&dataset, &how, output).await?;
    tell(&args.dataset, &how, &report, output)
}

/// What to look at.
pub struct How<'a> {
    pub fast: bool,
    pub complete: bool,
    pub snapshot: Option<&'a Snapshot>,
}

/// Verifies, showing how far it is.
pub async fn look(dataset: &Dataset, how: &How<'_>, output: Output) -> Result<Verification> {
    let late = Late::new("scenes checked", output);
    let watch = |done, of| late.at(done, of);
    let options = VerifyOptions {
        mode: mode(how.fast),
        complete: how.complete,
        snapshot: how.snapshot,
        watch: &watch,
    };
    let report = dataset.verify_with(&options).await.map_err(failed);
    late.finish();
    report
}

/// Progress of what mostly is over in a moment: nothing is shown before it has taken a while.
pub struct Late {
    since: Instant,
    what: &'static str,
    meter: Mutex<Option<Meter>>,
    output: Output,
}

impl Late {
    const AFTER: Duration = Duration::from_secs(2);

    pub fn new(what: &'static str, output: Output) -> Self {
        Self {
            since: Instant::now(),
            what,
            meter: Mutex::new(None),
            output,
        }
    }

    pub fn at(&self, done: u64, of: u64) {
        if self.since.elapsed() > Self::AFTER {
            let mut meter = self.meter.lock().expect("no panic while locked");
            let text = format!("{done} of {of} {}", self.what);
            meter
                .get_or_insert_with(|| Meter::new(self.output))
                .at(done as f64 / of.max(1) as f64, text);
        }
    }

    pub fn finish(self) {
        if let Some(meter) = self.meter.into_inner().expect("no panic while locked") {
            meter.finish();
        }
    }
}

pub fn mode(fast: bool) -> VerifyMode {
    match fast {
        true => VerifyMode::Fast,
        false => VerifyMode::Full,
    }
}

/// Prints what was found.
///
/// # Errors
/// Exit code 6 naming what is broken.
pub fn tell(place: &str, how: &How<'_>, report: &Verification, output: Output) -> Result<()> {
    let facts = json!({
        "dataset": place, "fast": how.fast, "snapshot": how.snapshot.map(|s| &s.name), "scenes": report.scenes,
        "objects": report.objects, "bytes": report.bytes, "problems": problems_json(&report.problems),
        "unpublished": report.unpublished, "unfinished": report.unfinished,
    });
    if report.is_sound() {
        output.result(&facts, || {
            let depth = match how.fast {
                true => "whole by manifests and sizes",
                false => "whole",
            };
            format!(
                "{} scenes, {} objects, {}: {depth}{}",
                report.scenes,
                report.objects,
                bytes(report.bytes),
                unfinished(report)
            )
        });
        return Ok(());
    }
    if output.json {
        output.result(&facts, String::new);
    }
    Err(broken(place, &report.problems))
}

/// What is broken, as an error.
pub fn broken(place: &str, problems: &[Problem]) -> CliError {
    broken_by(place, problems, Problem::hint)
}

/// The same where it is repaired otherwise.
pub fn broken_by(
    place: &str,
    problems: &[Problem],
    hint_of: fn(&Problem) -> &'static str,
) -> CliError {
    let mut shown = Vec::new();
    let mut last = "";
    for problem in problems.iter().take(SHOWN) {
        let scene = problem.scene.map(|s| format!("scene {s}: "));
        let hint = hint_of(problem);
        let how = match hint == last {
            true => String::new(),
            false => format!("\n    hint: {hint}"),
        };
        last = hint;
        let what = problem.to_string();
        shown.push(format!(
            "{}{}{how}",
            scene.unwrap_or_default(),
            show::line(&what)
        ));
    }
    let more = match problems.len().saturating_sub(shown.len()) {
        0 => String::new(),
        n => format!("\n  … and {n} more (--json lists all)"),
    };
    let error = CliError::new(
        Code::Damaged,
        format!(
            "{place}: {} problem(s)\n  {}{more}",
            problems.len(),
            shown.join("\n  ")
        ),
    );
    let repairable = |p: &Problem| hint_of(p).starts_with("dataset repair");
    match problems.iter().any(repairable) {
        true => error.hint(format!(
            "picofarm dataset repair {} makes the broken scenes again, and only those",
            show::argument(place)
        )),
        false => error,
    }
}

pub fn problems_json(problems: &[Problem]) -> Vec<Value> {
    problems_json_by(problems, Problem::hint)
}

/// The same where they are repaired otherwise.
pub fn problems_json_by(problems: &[Problem], hint: fn(&Problem) -> &'static str) -> Vec<Value> {
    problems
        .iter()
        .map(|p| {
            json!({
                "object": p.object, "scene": p.scene, "fault": p.fault.kind(), "what": p.fault.to_string(),
                "hint": hint(p),
            })
        })
        .collect()
}

fn unfinished(report: &Verification) -> String {
    if report.unfinished.is_empty() {
        return String::new();
    }
    let scenes = report.unfinished.iter().take(SHOWN);
    let mut scenes: Vec<String> = scenes.map(ToString::to_string).collect();
    if report.unfinished.len() > SHOWN {
        scenes.push("…".into());
    }
    format!(
        "\n{} scene(s) have objects, but no manifest: {}. They are being written, were left by killed workers, or lost \
         their manifests; --complete takes them for broken",
        report.unfinished.len(),
        scenes.join(", ")
    )
}

/// Verifies a data set in full, for other commands.
///
/// # Errors
/// Exit code 6 naming what is broken.
pub async fn check(place: &str) -> Result<Verification> {
    let report = open(place)
        .await?
        .verify(VerifyMode::Full)
        .await
        .map_err(failed)?;
    match report.is_sound() {
        true => Ok(report),
        false => Err(broken(place, &report.problems)),
    }
}
