//! Why a job's tasks do not run.

use picofarm_catalog::{Exception, Holdups};
use picofarm_proto::messages::{
    Event, EventKind, JobState, RunningTask, StageState, StageStatus, TaskCounts,
};

use super::{NOW, able, event, facts, failed, id};
use crate::{
    core::{Candidate, NotEligible, PoolFit},
    explain::{facts::JobFacts, job},
};

/// Returns the first reason's code and words.
pub(super) fn first(facts: &JobFacts) -> (String, String) {
    let reasons = job(facts);
    (reasons[0].code.clone(), reasons[0].words.clone())
}

#[test]
fn a_job_that_no_worker_can_hold_says_what_it_needs_and_what_the_largest_has() {
    let small = |name: &str, gib: u64| Candidate {
        may_run: Err("a task takes too much".into()),
        lacks_memory: Some((41 << 30, gib << 30)),
        ..able(name)
    };
    let facts = JobFacts {
        candidates: vec![small("a", 4), small("b", 8), small("c", 2)],
        ..facts()
    };
    let (code, words) = first(&facts);
    assert_eq!(code, "unable");
    assert!(
        words.ends_with(
            "each needs about 41.0 GiB of memory; the largest worker has 8.0 GiB for tasks (b)"
        ),
        "{words}"
    );
}

#[test]
fn a_waiting_job_says_what_it_waits_for() {
    let none = JobFacts {
        candidates: vec![],
        ..facts()
    };
    let (code, words) = first(&none);
    assert_eq!(code, "no_workers");
    assert!(
        words.contains("10 tasks") && words.contains("picofarm worker"),
        "{words}"
    );

    let pool = |refused: Option<&str>| JobFacts {
        pools: vec![PoolFit {
            name: "gpu".into(),
            refused: refused.map(str::to_owned),
            cores: 8,
            lasts_ms: Some(60_000),
        }],
        ..none.clone()
    };
    let (code, words) = first(&pool(None));
    assert_eq!(code, "no_workers");
    assert!(words.contains("pool gpu starts workers"), "{words}");
    let (_, words) = first(&pool(Some("the stage needs 9 cores")));
    assert!(
        words.contains("picofarm worker")
            && words.contains("pool gpu starts none: the stage needs 9 cores"),
        "{words}"
    );

    let elsewhere = JobFacts {
        elsewhere: 3,
        ..none
    };
    let (code, words) = first(&elsewhere);
    assert_eq!(code, "elsewhere");
    assert!(
        words.contains("3 workers are connected to other coordinators"),
        "{words}"
    );

    let refused = |name: &str| Candidate {
        may_run: Err("the job needs renderer \"2\", the worker has \"1\"".into()),
        ..able(name)
    };
    let unable = JobFacts {
        candidates: vec![refused("old-1"), refused("old-2")],
        ..facts()
    };
    let (code, words) = first(&unable);
    assert_eq!(code, "unable");
    assert_eq!(
        words.matches("needs renderer").count(),
        1,
        "each reason once: {words}"
    );

    let (code, words) = first(&facts());
    assert_eq!(code, "busy");
    assert!(
        words.contains("the one worker that may run them is busy"),
        "{words}"
    );

    let behind = JobFacts {
        ahead: vec![id(3), id(4)],
        ..facts()
    };
    let (code, words) = first(&behind);
    assert_eq!(code, "behind");
    assert!(
        words.contains(&id(3).to_string()) && words.contains("1 job"),
        "{words}"
    );

    let starting = JobFacts {
        candidates: vec![Candidate {
            idle: true,
            ..able("a")
        }],
        ..behind
    };
    assert_eq!(first(&starting).0, "starting");
}

#[test]
fn stages_of_one_matrix_that_others_wait_for_are_told_together() {
    let stage = |name: &str, state, done, needs: &[&str]| StageStatus {
        name: name.into(),
        kind: "train".into(),
        state,
        needs: needs.iter().map(|need| (*need).to_owned()).collect(),
        tasks: TaskCounts {
            total: 1,
            done,
            pending: 1 - done,
            ..TaskCounts::default()
        },
    };
    let needs = ["split", "tof[1]", "tof[2]", "tof[3]"];
    let facts = JobFacts {
        stages: vec![
            stage("split", StageState::Done, 1, &[]),
            stage("tof[1]", StageState::Done, 1, &[]),
            stage("tof[2]", StageState::Open, 0, &[]),
            stage("tof[3]", StageState::Open, 0, &[]),
            stage("evaluate", StageState::Blocked, 0, &needs),
        ],
        ..facts()
    };
    let reasons = job(&facts);
    let blocked = reasons.iter().find(|r| r.code == "blocked").unwrap();
    let words = "1 task of stage \"evaluate\" after \"tof[…]\" (1 of 3 done)";
    assert_eq!(blocked.words, words);
}

#[test]
fn tasks_under_way_for_another_job_are_told_from_those_that_wait_for_a_worker() {
    let some = JobFacts {
        shared: 4,
        ..facts()
    };
    let reasons = job(&some);
    let found: Vec<(&str, u64)> = reasons.iter().map(|r| (&*r.code, r.tasks)).collect();
    assert_eq!(found, [("shared", 4), ("busy", 6)]);
    assert!(reasons[0].words.starts_with("4 tasks under way"));

    // Other jobs may run more shared tasks than wait here.
    let all = JobFacts {
        shared: 40,
        ..facts()
    };
    let reasons = job(&all);
    assert_eq!((reasons.len(), reasons[0].tasks), (1, 10));
}

#[test]
fn a_task_that_failed_says_when_it_goes_on_and_what_went_wrong() {
    let facts = JobFacts {
        holdups: Holdups {
            waiting: 1,
            next_ms: Some(NOW + 12_500),
            failed: vec![failed(4, false)],
            ..Holdups::default()
        },
        ..facts()
    };
    let reasons = job(&facts);
    assert_eq!(reasons[0].code, "after_failure");
    assert_eq!(reasons[0].until_ms, Some(NOW + 12_500));
    let words = &reasons[0].words;
    assert!(
        words.contains("another 12 s") && words.contains("task 4: no light"),
        "{words}"
    );
}

#[test]
fn every_state_of_a_job_has_an_answer() {
    let counts = TaskCounts {
        total: 10,
        done: 8,
        dead: 2,
        ..TaskCounts::default()
    };
    let ended = JobFacts {
        state: JobState::Failed,
        counts,
        holdups: Holdups {
            failed: vec![failed(4, true)],
            ..Holdups::default()
        },
        ..facts()
    };
    let (code, words) = first(&ended);
    assert_eq!(code, "dead");
    assert!(
        words.contains("job retry") && words.contains("no light"),
        "{words}"
    );
    let cancelled = JobFacts {
        state: JobState::Cancelled,
        counts: TaskCounts { dead: 0, ..counts },
        ..ended.clone()
    };
    let (code, words) = first(&cancelled);
    assert_eq!(code, "cancelled");
    assert!(words.contains("2 tasks not done"), "{words}");
    let done = JobFacts {
        state: JobState::Done,
        counts: TaskCounts {
            done: 10,
            dead: 0,
            ..counts
        },
        ..ended
    };
    assert_eq!(first(&done).0, "ended");
    let ending = JobFacts {
        holdups: Holdups::default(),
        ..facts()
    };
    assert_eq!(first(&ending).0, "ending");
}

#[test]
fn a_silent_worker_is_not_called_busy() {
    let silent = Candidate {
        silent_ms: Some(42_000),
        ..able("rack-1")
    };
    let (code, words) = first(&JobFacts {
        candidates: vec![silent.clone()],
        ..facts()
    });
    assert_eq!(code, "silent");
    assert!(
        words.contains("rack-1 for 42 s") && words.contains("frozen"),
        "{words}"
    );
    // The tasks wait for another worker that works.
    let (code, _) = first(&JobFacts {
        candidates: vec![silent, able("rack-2")],
        ..facts()
    });
    assert_eq!(code, "busy");
}

#[test]
fn a_lease_of_many_tasks_is_one_that_runs() {
    let running = RunningTask {
        stage: 0,
        index: 3,
        worker: "rack-1".into(),
        fraction: 0.25,
        seconds: 1.0,
        text: "waits for the store: No space left on device".into(),
        figures: std::collections::BTreeMap::new(),
    };
    let leased = JobFacts {
        counts: TaskCounts {
            total: 14,
            leased: 14,
            ..TaskCounts::default()
        },
        holdups: Holdups::default(),
        running: vec![running],
        ..facts()
    };
    let (code, words) = first(&leased);
    assert_eq!(code, "leased");
    assert_eq!(
        words,
        "14 tasks under lease at workers, of which 1 runs: task 3 on rack-1 (25 %, waits for the store: No space left on \
         device)"
    );
}

#[test]
fn what_was_given_back_says_why() {
    let given_back = Event {
        kind: EventKind::Released,
        worker: "rack-1".into(),
        task: Some(5),
        ..event(
            EventKind::Released,
            "rack-1",
            "cannot write /tmp/x: No space left on device",
        )
    };
    let (code, words) = first(&JobFacts {
        holdups: Holdups {
            waiting: 2,
            next_ms: Some(NOW + 5_000),
            ..Holdups::default()
        },
        setback: Some(given_back),
        ..facts()
    });
    assert_eq!(code, "after_failure");
    assert!(
        words.contains("No space left on device") && words.contains("rack-1"),
        "{words}"
    );
}

#[test]
fn a_job_that_its_deadline_stopped_says_which_and_how_to_go_on() {
    let (code, words) = first(&JobFacts {
        state: JobState::Cancelled,
        deadline: Some("2026-12-01T18:00:00Z".into()),
        ..facts()
    });
    assert_eq!(code, "deadline");
    assert!(
        words.contains("limits.deadline = \"2026-12-01T18:00:00Z\"")
            && words.contains("set a later limits.deadline")
            && !words.contains("--again"),
        "{words}"
    );
}

#[test]
fn tasks_that_no_worker_has_the_time_for_say_how_long_they_need() {
    let short = |name: &str| Candidate {
        may_run: Err("a task is taken to need 75 min, and the worker ends in 59 min".into()),
        lacks_time: Some(75 * 60_000),
        ..able(name)
    };
    let (code, words) = first(&JobFacts {
        candidates: vec![short("a"), short("b")],
        ..facts()
    });
    assert_eq!(code, "time");
    assert!(
        words.contains("no connected worker has 75 min left for 10 tasks"),
        "{words}"
    );
    // Another worker has enough time and is busy.
    let (code, _) = first(&JobFacts {
        candidates: vec![short("a"), able("b")],
        ..facts()
    });
    assert_eq!(code, "busy");
}

#[test]
fn where_workers_come_and_give_their_leases_back_it_is_said() {
    let back = event(EventKind::Released, "node-7", "the worker is shutting down");
    let loops = JobFacts {
        candidates: vec![],
        setback: Some(back),
        holdups: Holdups {
            ready: 10,
            failed: vec![Exception {
                interruptions: 4,
                ..failed(4, false)
            }],
            ..Holdups::default()
        },
        ..facts()
    };
    let (code, words) = first(&loops);
    assert_eq!(code, "no_workers");
    assert!(
        words.contains("node-7, gave a lease back 5 s ago: the worker is shutting down")
            && words.contains("task 4 was interrupted 4 times"),
        "{words}"
    );
    // An old interruption is no reason any more.
    let later = JobFacts {
        now_ms: NOW + 3_600_000,
        ..loops
    };
    assert!(!first(&later).1.contains("node-7"));
}

#[test]
fn tasks_under_suspicion_wait_for_an_empty_hand() {
    let asks = Candidate {
        idle: true,
        gets: false,
        ..able("a")
    };
    let (code, words) = first(&JobFacts {
        candidates: vec![asks],
        suspects: 10,
        ..facts()
    });
    assert_eq!(code, "suspects");
    assert!(words.contains("nothing else in hand"), "{words}");
}

#[test]
fn a_store_that_is_away_is_known_by_its_kind_and_not_by_words() {
    let barred = |why: NotEligible| JobFacts {
        candidates: vec![Candidate {
            may_run: Err(why),
            ..able("a")
        }],
        ..facts()
    };
    let away = barred(NotEligible::Store("/lab is full; next try in 3 s".into()));
    let (code, words) = first(&away);
    assert_eq!(code, "store");
    assert!(words.contains("/lab is full"), "{words}");
    let named = barred("waits for store keepers, as its name says".into());
    assert_eq!(first(&named).0, "unable");
}
