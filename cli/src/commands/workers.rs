//! `picofarm workers`: lists and drains workers.

use picofarm_proto::show;

use crate::{
    args,
    client::{Client, Workers},
    error::Result,
    output::{Output, describe::clock, table},
    settings::Settings,
};

/// Lists the connected workers, or drains one.
///
/// # Errors
/// Fails if the coordinator cannot be reached, or refuses.
pub async fn run(what: Option<args::Workers>, settings: &Settings, output: Output) -> Result<()> {
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
