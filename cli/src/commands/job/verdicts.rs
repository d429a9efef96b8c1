//! Verdicts on results, from the logs of tasks. They are shown when a followed job ends.

use std::collections::BTreeMap;

use picofarm_proto::{
    messages::{
        Event, EventKind, JobStatus,
        log::{VERDICT, marked},
    },
    show,
};

use crate::client::{Client, Page};

/// Number of history lines to search.
const LINES: u32 = 10_000;
/// Maximum number of lines per stage that are shown individually. More are summarised by their
/// number.
const EACH: usize = 4;
/// Kinds of stages with verdicts.
const KINDS: [&str; 6] = [
    "calibrate",
    "demultiplex",
    "evaluate",
    "import",
    "infer",
    "reconstruct",
];

/// A line, and whether it is a warning.
pub type Line = (bool, String);

/// Returns the lines about a job, according to its latest history.
pub async fn lines(client: &mut Client, status: &JobStatus) -> Vec<Line> {
    if !status.stages.iter().any(|s| KINDS.contains(&&*s.kind)) {
        return Vec::new();
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
    // The lines are optional. If the history cannot be read, other calls report it.
    let Ok((events, _)) = client.history(page).await else {
        return Vec::new();
    };
    verdict_lines(status, &events)
}

/// Returns the lines of a history. A stage with few lines has each shown; otherwise the number of
/// doubtful results is shown, with an example.
fn verdict_lines(status: &JobStatus, events: &[Event]) -> Vec<Line> {
    // By stage, then by task and text, because a task that ran twice logs the same line twice.
    let mut stages: BTreeMap<u32, BTreeMap<(u64, &str), bool>> = BTreeMap::new();
    for event in events.iter().filter(|e| e.kind == EventKind::Log) {
        let Some((warns, text)) = marked(&event.message, VERDICT) else {
            continue;
        };
        let lines = stages.entry(event.stage.unwrap_or_default()).or_default();
        lines.insert((event.task.unwrap_or_default(), text), warns);
    }
    let mut out = Vec::new();
    for (at, lines) in &stages {
        if lines.len() <= EACH {
            let each = lines.iter();
            out.extend(each.map(|((_, text), bad)| (*bad, show::line(text).into_owned())));
            continue;
        }
        let name = status.stages.get(*at as usize).map_or("", |s| &*s.name);
        let bad: Vec<_> = lines.iter().filter(|(_, bad)| **bad).collect();
        let example = bad.first().map_or_else(
            || format!("none of {} results is doubtful", lines.len()),
            |((task, text), _)| {
                let all = lines.len();
                format!(
                    "{} of {all} results are doubtful, e.g. task {task}: {text}",
                    bad.len()
                )
            },
        );
        let line = format!("{name}: {example}");
        out.push((!bad.is_empty(), show::line(&line).into_owned()));
    }
    out
}

#[cfg(test)]
mod tests {
    use picofarm_proto::{
        ids::JobId,
        messages::{JobState, StageState, StageStatus, TaskCounts},
        spec::{JobSpec, Limits},
    };

    use super::*;

    fn event(task: u64, message: &str) -> Event {
        Event {
            sequence: task,
            at_ms: 0,
            job: JobId::from_uuid(uuid::Uuid::nil()),
            stage: Some(0),
            kind: EventKind::Log,
            task: Some(task),
            lo: None,
            hi: None,
            worker: String::new(),
            message: message.into(),
            seconds: 0.0,
        }
    }

    fn status() -> JobStatus {
        JobStatus {
            id: JobId::from_uuid(uuid::Uuid::nil()),
            name: "j".into(),
            state: JobState::Done,
            tasks: TaskCounts::default(),
            submitted_at_ms: 0,
            ended_at_ms: None,
            paused: false,
            user: String::new(),
            stages: vec![StageStatus {
                name: "rooms3d".into(),
                kind: "reconstruct".into(),
                state: StageState::Done,
                needs: Vec::new(),
                tasks: TaskCounts::default(),
            }],
            spec: JobSpec {
                name: "j".into(),
                priority: 0,
                limits: Limits::default(),
                nonce: String::new(),
                project: String::new(),
                after: Vec::new(),
                stages: Vec::new(),
            },
            mean_task_seconds: None,
            running: Vec::new(),
            workers: 0,
            unverified: 0,
        }
    }

    #[test]
    fn few_verdicts_are_shown_and_many_are_counted() {
        let bad = "warn: verdict: scene 3: do not trust it";
        let few = [
            event(2, "info: verdict: scene 2: times agree"),
            event(3, bad),
            event(3, bad),
            event(4, "info: something else"),
        ];
        let shown = verdict_lines(&status(), &few);
        let expected = [
            (false, "scene 2: times agree".to_owned()),
            (true, "scene 3: do not trust it".to_owned()),
        ];
        assert_eq!(shown, expected);
        let good = |task| event(task, &format!("info: verdict: scene {task}: fine"));
        let many: Vec<Event> = (10..70).map(good).chain([event(3, bad)]).collect();
        let [(doubtful, line)] = &verdict_lines(&status(), &many)[..] else {
            panic!("one line");
        };
        assert!(*doubtful);
        assert_eq!(
            line,
            "rooms3d: 1 of 61 results are doubtful, e.g. task 3: scene 3: do not trust it"
        );
    }
}
