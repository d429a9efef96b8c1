//! Describes the progress of a job in one line: the current stage, its tasks, and its remaining
//! time. Stages differ greatly in speed (an hour per training, a thousand small scenes a minute),
//! so there is no forecast for a stage that has not begun.

use std::{collections::HashMap, time::Instant};

use picofarm_proto::messages::{JobState, JobStatus, StageState, StageStatus};

use crate::output::duration;

/// Time for which a stage is observed before its end is forecast, in seconds.
const WATCHED_S: f64 = 2.0;

/// The pace of stages since the start of observation.
#[derive(Default)]
pub struct Pace {
    /// For each stage: when it was first seen, and the number of tasks done then.
    began: HashMap<usize, (Instant, f64)>,
}

impl Pace {
    /// Returns the finished fraction of the job in [0, 1], where each stage counts equally, and a
    /// line about it.
    pub fn describe(&mut self, s: &JobStatus, now: Instant) -> (f64, String) {
        let several = s.stages.len() > 1;
        let done: Vec<f64> = (0..s.stages.len()).map(|at| done(s, at)).collect();
        let shares = s.stages.iter().zip(&done);
        let shares: f64 = shares.map(|(stage, done)| done / total(stage)).sum();
        let mut fraction = shares / s.stages.len().max(1) as f64;
        if s.state == JobState::Active {
            // The fraction is 1 only when the job has ended.
            fraction = fraction.min(0.999);
        }
        let mut text = Vec::new();
        let left = |at: &usize| total(&s.stages[*at]) - done[*at];
        let open = (0..s.stages.len()).filter(|at| s.stages[*at].state == StageState::Open);
        let open: Vec<usize> = open.collect();
        // A stage with a running task precedes one that waits for a worker.
        let runs = |at: &usize| s.running.iter().any(|r| r.stage as usize == *at);
        let now_at = open
            .iter()
            .copied()
            .max_by(|a, b| runs(a).cmp(&runs(b)).then(left(a).total_cmp(&left(b))));
        match now_at {
            Some(at) if several => {
                let stage = &s.stages[at];
                let others = match open.len() {
                    1 => String::new(),
                    n => format!(" and {} more", n - 1),
                };
                text.push(format!(
                    "stage {} of {} ({}){others}: {}/{}",
                    at + 1,
                    s.stages.len(),
                    stage.name,
                    stage.tasks.done,
                    stage.tasks.total
                ));
            }
            _ => text.push(format!("{}/{} {}", s.tasks.done, s.tasks.total, what(s))),
        }
        if let Some(left) = now_at.and_then(|at| self.left(at, s, done[at], now)) {
            let of = if several { " of this stage" } else { "" };
            text.push(format!("about {} left{of}", duration(left)));
        }
        for (count, what) in [(s.tasks.reused, "reused"), (s.tasks.dead, "dead")] {
            if count > 0 {
                text.push(format!("{count} {what}"));
            }
        }
        let end = if s.workers == 1 { "" } else { "s" };
        text.push(format!("{} worker{end}", s.workers));
        if let [only] = &s.running[..]
            && !only.text.is_empty()
        {
            // A task's message belongs to its own stage.
            let other = s.stages.get(only.stage as usize);
            let other = other.filter(|_| now_at != Some(only.stage as usize));
            text.push(match other {
                Some(stage) => format!("{}: {}", stage.name, only.text),
                None => only.text.clone(),
            });
        }
        (fraction, text.join(", "))
    }

    /// Returns the remaining seconds of a stage at its pace, if known.
    fn left(&mut self, at: usize, s: &JobStatus, done: f64, now: Instant) -> Option<f64> {
        let (since, first) = *self.began.entry(at).or_insert((now, done));
        let elapsed = now.duration_since(since).as_secs_f64();
        let left = total(&s.stages[at]) - done;
        let gained = done - first;
        (elapsed >= WATCHED_S && gained > 1e-6 && left > 0.0).then(|| left * elapsed / gained)
    }
}

/// Returns the number of finished tasks of a stage, plus the fractions of running ones.
fn done(s: &JobStatus, at: usize) -> f64 {
    let of = s.running.iter().filter(|r| r.stage as usize == at);
    let running: f64 = of.map(|r| f64::from(r.fraction)).sum();
    let tasks = &s.stages[at].tasks;
    ((tasks.done + tasks.dead) as f64 + running).min(total(&s.stages[at]))
}

fn total(stage: &StageStatus) -> f64 {
    stage.tasks.total.max(1) as f64
}

fn what(s: &JobStatus) -> &'static str {
    match s.stages.iter().all(|stage| stage.kind == "render") {
        true => "scenes",
        false => "tasks",
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use picofarm_proto::{
        ids::JobId,
        messages::{RunningTask, TaskCounts},
        spec::{JobSpec, Limits},
    };

    use super::*;

    fn counts(done: u64, total: u64) -> TaskCounts {
        TaskCounts {
            total,
            done,
            pending: total - done,
            ..TaskCounts::default()
        }
    }

    fn status(stages: &[(&str, &str, u64, u64)]) -> JobStatus {
        let state = |done, total, open: &mut bool| match (done == total, *open) {
            (true, _) => StageState::Done,
            (false, true) => {
                *open = false;
                StageState::Open
            }
            (false, false) => StageState::Blocked,
        };
        let mut open = true;
        let stages: Vec<StageStatus> = stages
            .iter()
            .map(|&(name, kind, done, total)| StageStatus {
                name: name.into(),
                kind: kind.into(),
                state: state(done, total, &mut open),
                needs: Vec::new(),
                tasks: counts(done, total),
            })
            .collect();
        let mut tasks = TaskCounts::default();
        stages.iter().for_each(|stage| tasks += stage.tasks);
        JobStatus {
            id: JobId::from_uuid(uuid::Uuid::from_u128(1)),
            name: "learning".into(),
            state: JobState::Active,
            tasks,
            submitted_at_ms: 0,
            ended_at_ms: None,
            paused: false,
            user: String::new(),
            stages,
            spec: JobSpec {
                name: "learning".into(),
                priority: 0,
                limits: Limits::default(),
                nonce: String::new(),
                project: String::new(),
                after: Vec::new(),
                stages: Vec::new(),
            },
            mean_task_seconds: None,
            running: Vec::new(),
            workers: 1,
            unverified: 0,
        }
    }

    #[test]
    fn a_training_that_has_not_begun_is_not_forecast_by_the_pace_of_its_scenes() {
        let mut pace = Pace::default();
        let start = Instant::now();
        let at = |render, train| {
            status(&[
                ("render", "render", render, 120),
                ("split", "split", train, 1),
                ("tof", "train", 0, 1),
            ])
        };
        pace.describe(&at(0, 0), start);
        let (fraction, text) = pace.describe(&at(119, 0), start + Duration::from_secs(119));
        assert!(fraction < 0.34, "{fraction}");
        assert_eq!(
            text,
            "stage 1 of 3 (render): 119/120, about 1.0 s left of this stage, 1 worker"
        );
        let (fraction, text) = pace.describe(&at(120, 1), start + Duration::from_secs(121));
        assert!((0.6..0.7).contains(&fraction), "{fraction}");
        assert_eq!(text, "stage 3 of 3 (tof): 0/1, 1 worker");
    }

    #[test]
    fn a_task_that_tells_how_far_it_is_is_forecast() {
        let mut pace = Pace::default();
        let start = Instant::now();
        let at = |fraction| {
            let mut s = status(&[("train", "train", 0, 1)]);
            s.running.push(RunningTask {
                stage: 0,
                index: 0,
                worker: "w".into(),
                fraction,
                seconds: 1.0,
                text: "epoch 2 of 10".into(),
                figures: std::collections::BTreeMap::new(),
            });
            s
        };
        pace.describe(&at(0.0), start);
        let (fraction, text) = pace.describe(&at(0.25), start + Duration::from_secs(60));
        assert!((fraction - 0.25).abs() < 1e-6);
        assert_eq!(
            text,
            "0/1 tasks, about 3 min 00 s left, 1 worker, epoch 2 of 10"
        );
        // The stage makes no progress, so there is no forecast.
        let mut still = Pace::default();
        still.describe(&at(0.25), start);
        let (_, text) = still.describe(&at(0.25), start + Duration::from_secs(60));
        assert_eq!(text, "0/1 tasks, 1 worker, epoch 2 of 10");
    }

    #[test]
    fn what_a_task_says_is_shown_with_its_own_stage() {
        let mut s = status(&[("mirrors", "train", 0, 1), ("shadow", "train", 0, 1)]);
        for stage in &mut s.stages {
            stage.state = StageState::Open;
        }
        s.running.push(RunningTask {
            stage: 0,
            index: 0,
            worker: "w".into(),
            fraction: 0.5,
            seconds: 1.0,
            text: "epoch 1 of 2, loss 0.3".into(),
            figures: std::collections::BTreeMap::new(),
        });
        let (_, text) = Pace::default().describe(&s, Instant::now());
        assert_eq!(
            text,
            "stage 1 of 2 (mirrors) and 1 more: 0/1, 1 worker, epoch 1 of 2, loss 0.3"
        );
    }

    #[test]
    fn it_is_whole_only_when_the_job_has_ended() {
        let now = Instant::now();
        let mut s = status(&[("render", "render", 8, 8)]);
        assert!(Pace::default().describe(&s, now).0 < 1.0);
        s.state = JobState::Done;
        let (fraction, text) = Pace::default().describe(&s, now);
        assert_eq!((fraction, &*text), (1.0, "8/8 scenes, 1 worker"));
    }
}
