//! A farm in memory with one job, whose texts try to break pages.

use std::sync::Mutex;

use async_trait::async_trait;
use picofarm_proto::{
    ids::JobId,
    messages::{
        AuditEntry, Event, EventKind, JobState, JobStatus, JobSummary, Reason, RunningTask,
        StageState, StageStatus, TaskCounts, TaskExplanation, TaskState,
    },
    spec::JobSpec,
};
use picofarm_web::{Events, Explained, Farm, JobFilter, Refusal, Refused, Workers};

/// A text that would be markup, a script and an attribute.
pub const EVIL: &str = "<script>alert(1)</script>\"'><img onerror=x>";
/// The job.
pub const JOB: &str = "0190b5d8-0000-7000-8000-000000000001";

const FILE: &str = r#"
name = "evil"
[[stage]]
kind = "render"
scenes = { kind = "primitive", count = 5, seed = 1, spots = 4 }
render = { resolution = 16, samples = 2 }
output = { store = "/stores/a", dataset = "rooms" }
"#;

#[derive(Default)]
pub struct Memory {
    /// What was asked for.
    pub acts: Mutex<Vec<String>>,
    /// Whether the user's rights do not suffice to act.
    pub viewer: Mutex<bool>,
    /// Whether the job was cancelled before.
    pub ended: Mutex<bool>,
    /// Whether no task runs.
    pub idle: Mutex<bool>,
    /// Whether the coordinator does not answer.
    pub away: Mutex<bool>,
    /// The store that the job names, if another.
    pub store: Mutex<Option<String>>,
}

fn refusal(kind: Refused, message: &str) -> Refusal {
    Refusal {
        kind,
        message: message.into(),
        hint: None,
    }
}

fn id() -> JobId {
    JOB.parse().unwrap()
}

const COUNTS: TaskCounts = TaskCounts {
    total: 5,
    done: 2,
    reused: 1,
    leased: 1,
    pending: 1,
    dead: 1,
};

impl Memory {
    fn act(&self, what: &str) -> Result<(), Refusal> {
        self.answers(id())?;
        if *self.viewer.lock().unwrap() {
            return Err(refusal(Refused::Denied, "viewers may not change jobs"));
        }
        if *self.ended.lock().unwrap() {
            return Err(refusal(Refused::NotNow, "the job has ended"));
        }
        self.acts.lock().unwrap().push(what.to_owned());
        Ok(())
    }

    fn answers(&self, job: JobId) -> Result<(), Refusal> {
        if *self.away.lock().unwrap() {
            return Err(refusal(Refused::Away, "no coordinator answers"));
        }
        match job == id() {
            true => Ok(()),
            false => Err(refusal(Refused::Missing, "there is no such job")),
        }
    }

    pub fn acts(&self) -> Vec<String> {
        self.acts.lock().unwrap().clone()
    }

    async fn status(&self) -> Result<JobStatus, Refusal> {
        let state = match *self.ended.lock().unwrap() {
            true => JobState::Cancelled,
            false => JobState::Active,
        };
        let mut tasks = COUNTS;
        if *self.idle.lock().unwrap() {
            (tasks.leased, tasks.pending) = (0, tasks.pending + tasks.leased);
        }
        Ok(JobStatus {
            id: id(),
            name: EVIL.into(),
            state,
            tasks: COUNTS,
            submitted_at_ms: 1_700_000_000_000,
            ended_at_ms: None,
            paused: self.paused(),
            user: EVIL.into(),
            stages: vec![StageStatus {
                name: EVIL.into(),
                kind: "render".into(),
                state: StageState::Open,
                needs: vec![EVIL.into()],
                tasks,
            }],
            spec: self.spec(id()).await?,
            mean_task_seconds: Some(2.0),
            running: vec![RunningTask {
                stage: 0,
                index: 2,
                worker: EVIL.into(),
                fraction: 0.5,
                seconds: 3.0,
                text: EVIL.into(),
                figures: Default::default(),
            }],
            workers: 1,
            unverified: 0,
        })
    }

    fn paused(&self) -> bool {
        self.acts().last().is_some_and(|act| act == "pause")
    }
}

fn event(sequence: u64, kind: EventKind, task: u64, message: &str) -> Event {
    Event {
        sequence,
        at_ms: 1_700_000_000_000,
        job: id(),
        stage: Some(0),
        kind,
        task: Some(task),
        lo: None,
        hi: None,
        worker: EVIL.into(),
        message: message.into(),
        seconds: 1.0,
    }
}

#[async_trait]
impl Farm for Memory {
    fn url(&self) -> String {
        "http://127.0.0.1:7420".into()
    }

    async fn jobs(&self, _: &JobFilter) -> Result<(Vec<JobSummary>, Option<String>), Refusal> {
        self.answers(id())?;
        let job = JobSummary {
            id: id(),
            number: 12,
            name: EVIL.into(),
            user: EVIL.into(),
            project: EVIL.into(),
            state: JobState::Active,
            paused: self.paused(),
            tasks: COUNTS,
            submitted_at_ms: 1_700_000_000_000,
            ended_at_ms: None,
            left_s: None,
        };
        Ok((vec![job], Some(EVIL.into())))
    }

    async fn spec(&self, _: JobId) -> Result<JobSpec, Refusal> {
        let store = self.store.lock().unwrap().clone();
        let file = FILE.replace("/stores/a", store.as_deref().unwrap_or("/stores/a"));
        Ok(toml::from_str(&file).unwrap())
    }

    async fn events(&self, ask: Events) -> Result<Vec<Event>, Refusal> {
        self.answers(ask.job.unwrap_or(id()))?;
        let all = [
            event(1, EventKind::Committed, 0, ""),
            event(2, EventKind::Failed, 3, &format!("{EVIL} 17")),
            event(3, EventKind::Failed, 3, &format!("{EVIL} 18")),
            event(4, EventKind::Dead, 3, "gave up"),
            event(
                5,
                EventKind::Log,
                3,
                &format!("{EVIL}\r\nevent: message\ndata: {EVIL}"),
            ),
        ];
        Ok(all.into_iter().filter(|e| e.sequence > ask.after).collect())
    }

    async fn explain(&self, job: JobId, task: Option<(u32, u64)>) -> Result<Explained, Refusal> {
        self.answers(job)?;
        if task.is_some_and(|(stage, task)| stage > 0 || task >= COUNTS.total) {
            return Err(refusal(Refused::Missing, "there is no such task"));
        }
        let reason = Reason {
            code: "busy".into(),
            tasks: 1,
            words: EVIL.into(),
            until_ms: None,
        };
        let explained = task.map(|(_, index)| TaskExplanation {
            index,
            state: TaskState::Dead,
            words: EVIL.into(),
            failures: 2,
            max_failures: 2,
            crashes: 0,
            max_crashes: 2,
            interruptions: 0,
            max_interruptions: 9,
            last_error: EVIL.into(),
            reruns: vec![EVIL.into()],
            output: None,
            events: Vec::new(),
        });
        Ok(Explained {
            job: self.status().await?,
            reasons: vec![reason],
            task: explained,
            may_change: !*self.viewer.lock().unwrap(),
        })
    }

    async fn workers(&self) -> Result<Workers, Refusal> {
        self.answers(id())?;
        Ok(Workers {
            coordinator: EVIL.into(),
            ..Workers::default()
        })
    }

    async fn audit(&self, _: Option<u64>, _: u32) -> Result<Vec<AuditEntry>, Refusal> {
        Err(Refusal {
            message: EVIL.into(),
            hint: Some(EVIL.into()),
            kind: Refused::Denied,
        })
    }

    async fn cancel(&self, _: JobId) -> Result<(), Refusal> {
        self.act("cancel")
    }

    async fn pause(&self, _: JobId, paused: bool) -> Result<(), Refusal> {
        self.act(if paused { "pause" } else { "resume" })
    }

    async fn retry(&self, _: JobId) -> Result<(), Refusal> {
        self.act("retry")
    }
}
