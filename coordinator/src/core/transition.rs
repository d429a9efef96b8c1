//! The transitions of a range: a pure function from a range and an event to the ranges that replace
//! it. Law: the pieces contain exactly the tasks of the range, each once (a task marked `Left` has
//! a range of its own).

use picofarm_catalog::{LeaseState, Mark, Range, RangeState, Run};
use picofarm_proto::ids::{Incarnation, RangeId, WorkerId};

/// An event of a range.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum RangeEvent {
    /// `count` tasks from `at` on go to a worker; the rest stays pending.
    Grant {
        /// The first granted task, which belongs to the range.
        at: u64,
        /// Number of granted tasks, at least 1 and at most those of the range from `at` on.
        count: u64,
        /// The worker.
        worker: WorkerId,
        /// The process of the worker.
        incarnation: Incarnation,
        /// The end of the lease, Unix milliseconds.
        until_ms: i64,
    },
    /// A task's output is committed. The last one ends the lease.
    Finish {
        /// The task.
        task: u64,
        /// Whether the output existed before.
        reused: bool,
    },
    /// A task failed and moves to a range of its own. The last one ends the lease.
    Leave {
        /// The task.
        task: u64,
        /// Time from which it may run again, Unix milliseconds; `None` if it is given up.
        retry_at_ms: Option<i64>,
        /// Workers lost with it so far.
        crashes: u32,
    },
    /// The lease ends and its unfinished tasks become pending again.
    Close {
        /// Whether the worker was lost. The rest is then halved, so that a poison task becomes
        /// isolated.
        halve: bool,
    },
    /// The holder loses the tasks from this one on, none of them begun.
    Trim {
        /// The first of these tasks.
        at: u64,
    },
    /// Outputs of pending tasks were found.
    Settle {
        /// The tasks, all in the range.
        run: Run,
    },
}

/// An event that the range's state does not allow.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{event} cannot happen to range {range} ({state})")]
pub struct Illegal {
    range: RangeId,
    state: &'static str,
    event: String,
}

/// Returns the ranges that replace `range` after `event`; `ids` generates the ids of new ones.
///
/// # Errors
/// Returns [`Illegal`] if the event is not possible in the range's state.
pub fn next(
    range: &Range,
    event: &RangeEvent,
    ids: &mut dyn FnMut() -> RangeId,
) -> Result<Vec<Range>, Illegal> {
    let illegal = || Illegal {
        range: range.id,
        state: match range.state {
            RangeState::Pending { .. } => "pending",
            RangeState::Leased(_) => "leased",
            RangeState::Done { .. } => "done",
            RangeState::Dead => "dead",
        },
        event: format!("{event:?}"),
    };
    match (&range.state, event) {
        (
            RangeState::Pending { .. },
            RangeEvent::Grant {
                at,
                count,
                worker,
                incarnation,
                until_ms,
            },
        ) if (range.lo..range.hi).contains(at) && (1..=range.hi - at).contains(count) => {
            let leased = RangeState::Leased(LeaseState {
                worker: *worker,
                incarnation: *incarnation,
                until_ms: *until_ms,
                marks: vec![Mark::Todo; usize::try_from(*count).expect("a lease is small")],
            });
            let end = at + count;
            let mut pieces = Vec::with_capacity(3);
            // Tasks that stay pending keep the range's id.
            for (lo, hi) in [(range.lo, *at), (end, range.hi)] {
                if lo < hi {
                    let state = range.state.clone();
                    let n = pieces.len();
                    pieces.push(piece(range, lo, hi, range.crashes, state, n, ids));
                }
            }
            let n = pieces.len();
            let mut granted = piece(range, *at, end, range.crashes, leased, n, ids);
            granted.epoch.0 += 1;
            pieces.push(granted);
            Ok(pieces)
        }
        (RangeState::Leased(lease), RangeEvent::Finish { task, reused }) => {
            let mark = if *reused { Mark::Reused } else { Mark::Done };
            let lease = marked(range, lease, *task, mark).ok_or_else(illegal)?;
            Ok(after_mark(range, lease, ids))
        }
        (
            RangeState::Leased(lease),
            RangeEvent::Leave {
                task,
                retry_at_ms,
                crashes,
            },
        ) => {
            let lease = marked(range, lease, *task, Mark::Left).ok_or_else(illegal)?;
            let single = Range {
                id: ids(),
                lo: *task,
                hi: task + 1,
                crashes: *crashes,
                state: match retry_at_ms {
                    Some(not_before_ms) => RangeState::Pending {
                        not_before_ms: *not_before_ms,
                    },
                    None => RangeState::Dead,
                },
                ..range.clone()
            };
            let mut pieces = after_mark(range, lease, ids);
            pieces.push(single);
            Ok(pieces)
        }
        (RangeState::Leased(lease), RangeEvent::Trim { at })
            if range.lo < *at && *at < range.hi =>
        {
            let n = usize::try_from(at - range.lo).expect("a lease is small");
            let (kept, lost) = lease.marks.split_at(n);
            if !kept.contains(&Mark::Todo) || lost.iter().any(|m| *m != Mark::Todo) {
                return Err(illegal());
            }
            let front = Range {
                hi: *at,
                state: RangeState::Leased(LeaseState {
                    marks: kept.to_vec(),
                    ..lease.clone()
                }),
                ..range.clone()
            };
            let state = RangeState::Pending { not_before_ms: 0 };
            let rest = piece(range, *at, range.hi, range.crashes, state, 1, ids);
            Ok(vec![front, rest])
        }
        (RangeState::Leased(lease), RangeEvent::Close { halve }) => {
            Ok(closed(range, lease, *halve, ids))
        }
        (RangeState::Pending { .. }, RangeEvent::Settle { run })
            if range.lo <= run.lo && run.lo < run.hi && run.hi <= range.hi =>
        {
            let mut pieces = Vec::with_capacity(3);
            for (lo, hi, state) in [
                (range.lo, run.lo, range.state.clone()),
                (run.lo, run.hi, RangeState::Done { reused: true }),
                (run.hi, range.hi, range.state.clone()),
            ] {
                if lo < hi {
                    let n = pieces.len();
                    pieces.push(piece(range, lo, hi, range.crashes, state, n, ids));
                }
            }
            Ok(pieces)
        }
        _ => Err(illegal()),
    }
}

/// Returns the lease with one task marked; `None` if this lease may not mark the task.
fn marked(range: &Range, lease: &LeaseState, task: u64, mark: Mark) -> Option<LeaseState> {
    let at = usize::try_from(task.checked_sub(range.lo)?).ok()?;
    let mut lease = lease.clone();
    let place = lease.marks.get_mut(at).filter(|m| **m == Mark::Todo)?;
    *place = mark;
    Some(lease)
}

/// Ends a lease without unfinished tasks.
fn after_mark(range: &Range, lease: LeaseState, ids: &mut dyn FnMut() -> RangeId) -> Vec<Range> {
    if lease.marks.contains(&Mark::Todo) {
        vec![Range {
            state: RangeState::Leased(lease),
            ..range.clone()
        }]
    } else {
        closed(range, &lease, false, ids)
    }
}

/// Returns the runs of equal marks as ranges.
fn closed(
    range: &Range,
    lease: &LeaseState,
    halve: bool,
    ids: &mut dyn FnMut() -> RangeId,
) -> Vec<Range> {
    let mut pieces = Vec::new();
    let mut lo = range.lo;
    for run in lease.marks.chunk_by(|a, b| a == b) {
        let hi = lo + run.len() as u64;
        let mut push = |lo, hi, crashes, state| {
            let n = pieces.len();
            pieces.push(piece(range, lo, hi, crashes, state, n, ids));
        };
        match run[0] {
            Mark::Todo => {
                let crashes = range.crashes + u32::from(halve);
                let state = RangeState::Pending { not_before_ms: 0 };
                let mid = lo + (hi - lo) / 2;
                if halve && mid > lo {
                    push(lo, mid, crashes, state.clone());
                    push(mid, hi, crashes, state);
                } else {
                    push(lo, hi, crashes, state);
                }
            }
            Mark::Done => push(lo, hi, 0, RangeState::Done { reused: false }),
            Mark::Reused => push(lo, hi, 0, RangeState::Done { reused: true }),
            Mark::Left => {}
        }
        lo = hi;
    }
    pieces
}

/// Creates a piece of a range. The first piece keeps the range's id. All pieces keep the epoch, so
/// that it never decreases for any id.
fn piece(
    range: &Range,
    lo: u64,
    hi: u64,
    crashes: u32,
    state: RangeState,
    earlier: usize,
    ids: &mut dyn FnMut() -> RangeId,
) -> Range {
    Range {
        id: if earlier == 0 { range.id } else { ids() },
        stage: range.stage,
        lo,
        hi,
        epoch: range.epoch,
        crashes,
        state,
    }
}
