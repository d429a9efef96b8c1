//! Laws of the pure parts: no sequence of events loses or duplicates a task, and sizes stay in
//! bounds.

use picofarm_catalog::{Changes, Range, RangeState, Run};
use picofarm_proto::{
    ids::{Epoch, Incarnation, JobId, RangeId, StageRef, WorkerId},
    messages::FailureKind,
    spec::Limits,
};
use proptest::prelude::*;
use uuid::Uuid;

use super::{
    budget::{Attempt, Backoff, charge, fresh},
    held_ranges::HeldRanges,
    placement::lease_size,
    plan::expand,
    transition::RangeEvent,
};

fn counter() -> impl FnMut() -> RangeId {
    let mut n = 0u128;
    move || {
        n += 1;
        RangeId::from_uuid(Uuid::from_u128(n))
    }
}

fn stage_ref() -> StageRef {
    StageRef {
        job: JobId::from_uuid(Uuid::nil()),
        stage: 0,
    }
}

/// Returns a stage with these pending tasks.
fn running_tasks(total: u64, cut: &[bool], ids: &mut dyn FnMut() -> RangeId) -> HeldRanges {
    let existing: Vec<Run> = (0..total)
        .filter(|i| cut.get(*i as usize) == Some(&true))
        .map(|i| Run { lo: i, hi: i + 1 })
        .collect();
    let mut stage = HeldRanges::default();
    for range in expand(stage_ref(), total, &existing, ids) {
        if matches!(range.state, RangeState::Pending { .. }) {
            stage.receive(range, &mut Changes::default());
        }
    }
    stage
}

/// The expected state of each task.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Task {
    Pending,
    Leased,
    Done,
    Dead,
}

fn choose(range: &Range, pick: u64) -> u64 {
    range.lo + pick % range.len()
}

proptest! {
    #[test]
    fn ranges_follow_a_table_of_tasks(
        total in 1..40u64,
        cut in prop::collection::vec(any::<bool>(), 40),
        ops in prop::collection::vec((0..6u8, any::<u64>(), any::<u64>(), any::<bool>()), 0..80),
    ) {
        let mut ids = counter();
        let mut table: Vec<Task> = (0..total)
            .map(|i| if cut[i as usize] { Task::Done } else { Task::Pending })
            .collect();
        let mut changes = Changes::default();
        let mut stage = running_tasks(total, &cut, &mut ids);
        for (op, a, b, flag) in ops {
            let leased: Vec<Range> = stage.leased().map(|(r, _)| r.clone()).collect();
            let lease = (!leased.is_empty()).then(|| leased[a as usize % leased.len()].clone());
            let (range, event) = match (op, lease) {
                (0, _) => {
                    // Some tasks run for another stage.
                    let lo = a % (2 * total);
                    let except = [Run { lo, hi: lo + b % 5 }];
                    let among = (lo..except[0].hi.min(total)).filter(|t| table[*t as usize] == Task::Pending);
                    let (plain, suspects) = stage.ready(i64::MAX, &except);
                    let among = among.count() as u64;
                    prop_assert_eq!(plain + suspects + among, stage.pending_tasks());
                    prop_assert_eq!(stage.front(i64::MAX, false, &except).is_some(), plain > 0);
                    prop_assert_eq!(stage.front(i64::MAX, true, &except).is_some(), plain + suspects > 0);
                    let Some((front, run)) = stage.front(i64::MAX, flag, &except) else { continue };
                    let front = front.clone();
                    prop_assert!(front.lo <= run.lo && run.lo < run.hi && run.hi <= front.hi);
                    prop_assert!(run.hi <= lo || except[0].hi <= run.lo);
                    let count = 1 + b % (run.hi - run.lo);
                    for t in run.lo..run.lo + count {
                        table[t as usize] = Task::Leased;
                    }
                    let event = RangeEvent::Grant {
                        at: run.lo,
                        count,
                        worker: WorkerId::from_uuid(Uuid::nil()),
                        incarnation: Incarnation::from_uuid(Uuid::nil()),
                        until_ms: 1,
                    };
                    (front, event)
                }
                (1, Some(range)) => {
                    let task = choose(&range, b);
                    (range, RangeEvent::Finish { task, reused: flag })
                }
                (2, Some(range)) => {
                    let task = choose(&range, b);
                    let retry_at_ms = flag.then_some(b as i64 % 1_000);
                    (range, RangeEvent::Leave { task, retry_at_ms, crashes: u32::from(flag) })
                }
                (3, Some(range)) => (range, RangeEvent::Close { halve: flag }),
                (5, Some(range)) => {
                    let at = range.lo + b % range.len();
                    (range, RangeEvent::Trim { at })
                }
                (4, _) => {
                    let task = a % total;
                    let Some(range) = stage.pending_at(task).cloned() else {
                        prop_assert_ne!(table[task as usize], Task::Pending);
                        continue;
                    };
                    let hi = (task + 1 + b % 3).min(range.hi);
                    (range, RangeEvent::Settle { run: Run { lo: task, hi } })
                }
                _ => continue,
            };
            let before = stage.lease(range.lease()).map(|(r, _)| r.clone());
            match stage.apply(&range, &event, &mut ids, &mut changes) {
                Ok(_) => match event {
                    RangeEvent::Grant { .. } => {}
                    RangeEvent::Finish { task, .. } => table[task as usize] = Task::Done,
                    RangeEvent::Settle { run } => {
                        for t in run.lo..run.hi {
                            table[t as usize] = Task::Done;
                        }
                    }
                    RangeEvent::Leave { task, retry_at_ms, .. } => {
                        table[task as usize] = if retry_at_ms.is_some() { Task::Pending } else { Task::Dead };
                    }
                    RangeEvent::Trim { at } => {
                        for t in at..range.hi {
                            table[t as usize] = Task::Pending;
                        }
                    }
                    RangeEvent::Close { .. } => {
                        let RangeState::Leased(lease) = &range.state else { unreachable!() };
                        for (i, mark) in lease.marks.iter().enumerate() {
                            if *mark == picofarm_catalog::Mark::Todo {
                                table[range.lo as usize + i] = Task::Pending;
                            }
                        }
                    }
                },
                // A refused event changes nothing.
                Err(_) => prop_assert_eq!(stage.lease(range.lease()).map(|(r, _)| r.clone()), before),
            }
            let of = |t: Task| table.iter().filter(|x| **x == t).count() as u64;
            prop_assert_eq!(stage.pending_tasks(), of(Task::Pending));
            prop_assert_eq!(stage.leased_tasks(), of(Task::Leased));
            prop_assert_eq!(stage.is_empty(), of(Task::Pending) + of(Task::Leased) == 0);
            for (i, task) in table.iter().enumerate() {
                prop_assert_eq!(stage.pending_at(i as u64).is_some(), *task == Task::Pending);
            }
            // The ranges that go back to the catalog contain exactly the done and dead tasks, each
            // once.
            let mut left = vec![None; total as usize];
            for range in changes.free.values() {
                for t in range.lo..range.hi {
                    prop_assert_eq!(left[t as usize], None);
                    left[t as usize] = Some(if range.state == RangeState::Dead { Task::Dead } else { Task::Done });
                }
            }
            for (t, left) in left.iter().enumerate() {
                let marked = matches!(table[t], Task::Done) && left.is_none();
                prop_assert!(marked || *left == Some(table[t]) || (left.is_none() && !matches!(table[t], Task::Dead)));
            }
            // Changed ranges are written in their current state.
            let now = stage.leased().map(|(r, _)| r).all(|r| changes.ranges.get(&r.id) == Some(r));
            prop_assert!(now);
        }
    }

    #[test]
    fn epochs_never_fall(grants in prop::collection::vec(any::<bool>(), 1..20)) {
        let mut ids = counter();
        let mut changes = Changes::default();
        let mut stage = running_tasks(4, &[], &mut ids);
        let mut last = Epoch(0);
        for halve in grants {
            let front = stage.front(i64::MAX, true, &[]).unwrap().0.clone();
            prop_assume!(front.lo == 0);
            let event = RangeEvent::Grant {
                at: 0,
                count: 1,
                worker: WorkerId::from_uuid(Uuid::nil()),
                incarnation: Incarnation::from_uuid(Uuid::nil()),
                until_ms: 1,
            };
            let leased = stage.apply(&front, &event, &mut ids, &mut changes).unwrap().unwrap();
            prop_assert!(leased.epoch > last);
            last = leased.epoch;
            stage.apply(&leased, &RangeEvent::Close { halve }, &mut ids, &mut changes).unwrap();
        }
    }

    #[test]
    fn a_plan_covers_every_task_once(total in 1..200u64, mut cuts in prop::collection::vec(0..250u64, 0..12)) {
        cuts.sort_unstable();
        cuts.dedup();
        let existing: Vec<Run> = cuts.chunks_exact(2).map(|c| Run { lo: c[0], hi: c[1] }).collect();
        let ranges = expand(stage_ref(), total, &existing, &mut counter());
        let mut at = 0;
        for range in &ranges {
            prop_assert_eq!(range.lo, at);
            at = range.hi;
            let exists = existing.iter().any(|r| r.lo <= range.lo && range.lo < r.hi);
            prop_assert_eq!(range.state == RangeState::Done { reused: true }, exists);
        }
        prop_assert_eq!(at, total);
    }

    #[test]
    fn a_lease_is_never_empty_and_leaves_work_for_others(
        mean in prop::option::of(0.0..1e4f64), in_range in 1..100_000u64, more in 0..100_000u64, workers in 0..2_000u64,
    ) {
        let pending = in_range + more;
        let n = lease_size(mean, pending, in_range, workers);
        prop_assert!((1..=in_range).contains(&n));
        if mean.is_none() {
            prop_assert_eq!(n, 1);
        }
        prop_assert!(n <= pending.div_ceil(2 * workers.max(1)));
    }

    #[test]
    fn budgets_are_separate_and_those_of_stores_free(kinds in prop::collection::vec((0..5u8, any::<bool>(), any::<bool>()), 0..30)) {
        let limits = Limits { max_failures: 3, max_crashes: 2, max_interruptions: 5, ..Limits::default() };
        let backoff = Backoff::default();
        let (mut record, mut failures, mut crashes, mut interruptions) = (None, 0, 0, 0);
        for (kind, counts, at_once) in kinds {
            let kind = [FailureKind::User, FailureKind::Crash, FailureKind::Interrupted, FailureKind::Store, FailureKind::Damaged][usize::from(kind)];
            failures += u32::from(kind == FailureKind::User && counts);
            crashes += u32::from(kind == FailureKind::Crash && counts);
            interruptions += u32::from(kind == FailureKind::Interrupted && counts);
            let attempt = Attempt { kind, message: "x", ms: 7_000, counts, at_once };
            let verdict = charge(record.as_ref(), fresh(stage_ref(), 0), attempt, &limits, &backoff, 100);
            let dead = failures >= 3 || crashes >= 2 || interruptions >= 5;
            prop_assert_eq!(verdict.retry_at_ms.is_none(), dead);
            let soon = kind == FailureKind::Interrupted && at_once && interruptions <= 1;
            prop_assert!(verdict.retry_at_ms.is_none_or(|at| (at > 100) != soon));
            if let Some(e) = &verdict.exception {
                prop_assert_eq!((e.failures, e.crashes, e.interruptions), (failures, crashes, interruptions));
                prop_assert_eq!(e.dead && interruptions >= 5, e.last_error.contains("interrupted 5 times"));
            }
            record = verdict.exception;
            if dead {
                break;
            }
        }
    }
}

#[test]
fn known_task_times_give_about_a_minute_of_work() {
    assert_eq!(lease_size(Some(9.0), 100_000, 100_000, 10), 5);
    assert_eq!(lease_size(Some(400.0), 100_000, 100_000, 10), 1);
    assert_eq!(lease_size(Some(0.01), 100_000, 100_000, 10), 1024);
    assert_eq!(lease_size(Some(0.01), 40, 40, 10), 2);
}

#[test]
fn backoff_doubles_up_to_its_limit() {
    let backoff = Backoff {
        first_ms: 1_000,
        most_ms: 5_000,
    };
    assert_eq!(
        [1, 2, 3, 4, 60].map(|n| backoff.after(n)),
        [1_000, 2_000, 4_000, 5_000, 5_000]
    );
}
