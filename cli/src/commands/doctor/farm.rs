//! `picofarm doctor --farm`: asks every worker to check its machine.

use std::{path::Path, time::Duration};

use picofarm_proto::{
    messages::{Check, ExaminedWorker, Verdict},
    show,
};
use picofarm_tasks::absolute;
use serde::Serialize;

use crate::{
    args::Doctor,
    client::{Client, Examination},
    error::{CliError, Code, Result},
    output::{Output, table},
    settings::Settings,
};

/// Largest difference of clocks without a remark. Leases use no wall clock, but logs, deadlines and
/// end times of workers do.
const CLOCK_MS: u64 = 2_000;

#[derive(Serialize)]
struct Row<'a> {
    #[serde(flatten)]
    worker: &'a ExaminedWorker,
    verdict: Verdict,
}

/// Examines all workers of a coordinator.
///
/// # Errors
/// Fails if the coordinator does not answer, if no worker is connected, or if a worker fails a
/// check or does not answer.
pub async fn run(args: &Doctor, settings: &Settings, output: Output) -> Result<()> {
    let ask = Examination {
        store: place(args.store.as_deref())?,
        scenes: place(args.scenes.as_deref())?,
        within: Duration::from_secs_f64(args.within_s),
    };
    let mut client = Client::connect(&settings.coordinator, &settings.access()?).await?;
    let (mut workers, elsewhere) = client.examine(&ask).await?;
    for worker in &mut workers {
        worker.checks.extend(clock(worker));
    }
    let rows: Vec<Row> = workers
        .iter()
        .map(|worker| Row {
            verdict: verdict(worker),
            worker,
        })
        .collect();
    output.result(
        &serde_json::json!({"workers": rows, "elsewhere": elsewhere}),
        || describe(&rows),
    );
    if elsewhere > 0 {
        output.warn(format!(
            "{elsewhere} workers are connected to other coordinators, which were not asked; name each in --coordinator"
        ));
    }
    if ask.store.is_empty() {
        output.warn("no store was checked; name it with --store");
    }
    finish(&rows)
}

/// Returns a location as it is meant on each worker: a URL, or the path as seen from here.
fn place(text: Option<&str>) -> Result<String> {
    match text {
        None => Ok(String::new()),
        Some(url) if url.contains("://") => Ok(url.to_owned()),
        Some(path) => {
            let path = absolute(Path::new("."), path).map_err(CliError::input)?;
            Ok(path.display().to_string())
        }
    }
}

/// Compares a worker's clock with the coordinator's.
fn clock(worker: &ExaminedWorker) -> Option<Check> {
    if !worker.answered {
        return None;
    }
    let (off, ahead) = (worker.ahead_ms.unsigned_abs(), worker.ahead_ms > 0);
    let seconds = off as f64 / 1000.0;
    let detail = match ahead {
        _ if off <= CLOCK_MS => format!("within {seconds:.1} s of the coordinator's"),
        true => format!("{seconds:.1} s ahead of the coordinator's; synchronise it (NTP)"),
        false => format!("{seconds:.1} s behind the coordinator's; synchronise it (NTP)"),
    };
    let verdict = match off {
        0..=CLOCK_MS => Verdict::Ok,
        _ => Verdict::Note,
    };
    Some(Check::new("clock", verdict, detail))
}

/// Returns the worst verdict of a worker.
fn verdict(worker: &ExaminedWorker) -> Verdict {
    let any = |verdict| worker.checks.iter().any(|check| check.verdict == verdict);
    if !worker.answered || any(Verdict::Bad) {
        Verdict::Bad
    } else if any(Verdict::Note) {
        Verdict::Note
    } else {
        Verdict::Ok
    }
}

/// Formats one row for each worker: its verdict, its name, and what is remarkable; of a worker
/// without remarks, all checks.
fn describe(rows: &[Row]) -> String {
    let lines = rows.iter().map(|row| {
        let worker = row.worker;
        let remarks = worker.checks.iter().filter(|c| c.verdict != Verdict::Ok);
        let remarks: Vec<String> = remarks
            .map(|c| format!("{}: {}", c.what, c.detail))
            .collect();
        let fine: Vec<&str> = worker.checks.iter().map(|c| &*c.what).collect();
        let text = match (worker.answered, remarks.is_empty()) {
            (false, _) => {
                "did not answer in time: frozen, overloaded, or of a version without examinations"
                    .to_owned()
            }
            (true, true) => fine.join(", "),
            (true, false) => remarks.join("; "),
        };
        let (name, text) = (show::line(&worker.name), show::line(&text));
        vec![row.verdict.word().into(), name.into(), text.into()]
    });
    let lines: Vec<Vec<String>> = lines.collect();
    match lines.is_empty() {
        true => "no worker is connected\n".into(),
        false => table(&lines),
    }
}

fn finish(rows: &[Row]) -> Result<()> {
    if rows.is_empty() {
        return Err(
            CliError::new(Code::Resource, "no worker is connected to this coordinator")
                .hint("start one with `picofarm worker`"),
        );
    }
    let bad = rows.iter().filter(|row| row.verdict == Verdict::Bad);
    let bad: Vec<String> = bad
        .map(|row| show::line(&row.worker.name).into_owned())
        .collect();
    match bad.is_empty() {
        true => Ok(()),
        false => Err(CliError::new(
            Code::Resource,
            format!(
                "{} of {} workers failed a check or did not answer: {}",
                bad.len(),
                rows.len(),
                bad.join(", ")
            ),
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn worker(name: &str, answered: bool, ahead_ms: i64, verdict: Verdict) -> ExaminedWorker {
        ExaminedWorker {
            id: String::new(),
            name: name.into(),
            answered,
            ahead_ms,
            checks: match answered {
                true => vec![Check::new("store", verdict, "/data: no space")],
                false => Vec::new(),
            },
        }
    }

    fn rows(workers: &mut [ExaminedWorker]) -> Vec<Row<'_>> {
        for worker in workers.iter_mut() {
            worker.checks.extend(clock(worker));
        }
        let rows = workers.iter().map(|worker| Row {
            verdict: verdict(worker),
            worker,
        });
        rows.collect()
    }

    #[test]
    fn each_worker_has_a_row_and_bad_or_silent_ones_are_named() {
        let mut workers = [
            worker("a", true, 3, Verdict::Ok),
            worker("b", true, -9_000, Verdict::Ok),
            worker("c", true, 0, Verdict::Bad),
            worker("d", false, 0, Verdict::Ok),
        ];
        let rows = rows(&mut workers);
        let text = describe(&rows);
        let lines: Vec<&str> = text.lines().collect();
        for (line, parts) in lines.iter().zip([
            ["ok", "a", "store, clock"],
            ["note", "b", "9.0 s behind"],
            ["BAD", "c", "/data: no space"],
            ["BAD", "d", "did not answer"],
        ]) {
            assert!(parts.iter().all(|part| line.contains(part)), "{line}");
        }
        let failed = finish(&rows).unwrap_err();
        assert_eq!(
            failed.message,
            "2 of 4 workers failed a check or did not answer: c, d"
        );
        assert!(finish(&rows[..2]).is_ok());
        assert!(finish(&[]).is_err());
    }
}
