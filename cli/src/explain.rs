//! `picofarm job explain` and `picofarm workers`.

use picofarm_proto::show;

use crate::{
    args,
    client::{Client, Explained, Workers},
    describe::{clock, counts, describe_event, state},
    error::Result,
    output::{Output, bytes, duration, table},
    settings::Settings,
};

/// Formats the explanation of a job's state as text.
pub fn describe(explained: &Explained) -> String {
    let status = &explained.job;
    let mut text = format!(
        "job {} \"{}\": {}\n  {}\n",
        status.id,
        show::line(&status.name),
        state(status),
        counts(status)
    );
    for reason in &explained.reasons {
        text += &format!("  - {}\n", show::line(&reason.words));
    }
    let Some(task) = &explained.task else {
        return text;
    };
    text += &format!("task {}: {}\n", task.index, show::line(&task.words));
    if task.failures + task.crashes + task.interruptions > 0 {
        text += &format!(
            "  {} of {} failures, {} of {} lost workers and {} of {} interruptions before it is given up; the last: {}\n",
            task.failures,
            task.max_failures,
            task.crashes,
            task.max_crashes,
            task.interruptions,
            task.max_interruptions,
            show::line(&task.last_error)
        );
    }
    for why in &task.reruns {
        text += &format!("  run again because {}\n", show::line(why));
    }
    if let Some(output) = &task.output {
        text += &format!(
            "  output: manifest {}, {} in {}\n",
            show::line(&output.manifest_sha256),
            bytes(output.bytes),
            duration(output.seconds)
        );
        if let Some(made) = &output.made {
            text += &format!(
                "  committed {} by {} under job {}\n",
                clock(made.at_ms),
                show::line(&made.worker),
                made.job
            );
        }
    }
    if !task.events.is_empty() {
        text += "  history:\n";
    }
    for event in &task.events {
        text += &format!("    {}", describe_event(event));
    }
    text
}

/// `picofarm workers`.
///
/// # Errors
/// Fails if the coordinator cannot be reached, or refuses.
pub async fn workers(
    what: Option<args::Workers>,
    settings: &Settings,
    output: Output,
) -> Result<()> {
    let mut client = Client::connect(&settings.coordinator, &settings.access()?).await?;
    if let Some(args::Workers::Drain { worker }) = what {
        let said = client.drain(&worker).await?;
        output.result(&serde_json::json!({"worker": worker, "sent": said}), || {
            format!("{said} asked to finish the task in hand and to end")
        });
        return Ok(());
    }
    let workers = client.workers().await?;
    output.result(&workers, || describe_workers(&workers));
    Ok(())
}

fn describe_workers(all: &Workers) -> String {
    let mut text = format!(
        "coordinator ({}): {} connected\n",
        show::line(&all.coordinator),
        all.workers.len()
    );
    if !all.workers.is_empty() {
        let header =
            ["worker", "version", "cores", "leases", "tasks", "since", ""].map(String::from);
        let rows = all.workers.iter().map(|w| {
            let note = match w.quarantined {
                true if w.note.is_empty() => "on probation: its range crashed others",
                _ => &*w.note,
            };
            vec![
                w.name.clone(),
                w.version.clone(),
                w.cores.to_string(),
                w.leases.to_string(),
                w.tasks.to_string(),
                clock(w.since_ms),
                note.to_owned(),
            ]
        });
        text += &table(
            &std::iter::once(header.to_vec())
                .chain(rows)
                .collect::<Vec<_>>(),
        );
    }
    if all.coordinators > 1 {
        text += &format!(
            "{} more at the other {} coordinator(s) of this catalog; ask them with --coordinator\n",
            all.elsewhere,
            all.coordinators - 1
        );
    }
    text
}
