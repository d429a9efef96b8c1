//! Warns about scenes without light. Their tasks log such warnings; if many do, one warning covers
//! the whole job.

use std::collections::BTreeSet;

use picofarm_proto::{
    messages::{
        EventKind, JobStatus,
        log::{DARK, marked},
    },
    show,
};

use crate::client::{Client, Page};

/// Lines of history that are searched.
const LINES: u32 = 10_000;

/// Returns a warning about a job's scenes without light, according to its latest history.
pub async fn warning(client: &mut Client, status: &JobStatus) -> Option<String> {
    let renders = |kind: &str| matches!(kind, "render");
    let rendered: u64 = status
        .stages
        .iter()
        .filter(|stage| renders(&stage.kind))
        .map(|stage| stage.tasks.done - stage.tasks.reused.min(stage.tasks.done))
        .sum();
    if rendered == 0 {
        return None;
    }
    let page = Page {
        job: Some(status.id),
        stage: None,
        task: None,
        after: 0,
        limit: LINES,
        newest: true,
        logs: true,
    };
    // The warning is optional. If the history cannot be read, other calls report it.
    let (events, _) = client.history(page).await.ok()?;
    let mut tasks = BTreeSet::new();
    let mut example = None;
    for event in &events {
        if event.kind == EventKind::Log
            && let Some((_, why)) = marked(&event.message, DARK)
        {
            tasks.insert((event.stage, event.task));
            example.get_or_insert((event.task.unwrap_or_default(), why));
        }
    }
    let (task, why) = example?;
    let all = match tasks.len() as u64 {
        all if all >= rendered => format!("all {rendered} scenes rendered are without light"),
        some => format!("{some} of {rendered} scenes rendered are without light"),
    };
    Some(format!(
        "warning: {all}, e.g. task {task}: {}",
        show::line(why)
    ))
}
