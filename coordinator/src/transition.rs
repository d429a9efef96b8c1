//! What may happen to a range: a pure function from a range and an event to the ranges that take its place.
//! Law: the pieces hold exactly the tasks of the range, each once (a task marked `Left` has a range of its own).

use picofarm_catalog::{LeaseState, Mark, Range, RangeState, Run};
use picofarm_proto::ids::{Incarnation, RangeId, WorkerId};

/// Something that happens to a range.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum RangeEvent {
    /// `count` tasks from `at` on go to a worker; the rest stays pending.
    Grant {
        /// The first task granted, one of the range's.
        at: u64,
        /// Tasks granted, at least 1 and at most those of the range from `at` on.
        count: u64,
        /// To whom.
        worker: WorkerId,
        /// To which process.
        incarnation: Incarnation,
        /// Until when, Unix milliseconds.
        until_ms: i64,
    },
    /// A task's output is committed. The last one ends the lease.
    Finish {
        /// The task.
        task: u64,
        /// Its output was there already.
        reused: bool,
    },
    /// A task failed and leaves for a range of its own. The last one ends the lease.
    Leave {
        /// The task.
        task: u64,
        /// When it may be tried again, Unix milliseconds; `None` = given up.
        retry_at_ms: Option<i64>,
        /// Workers lost with it so far.
        crashes: u32,
    },
    /// The lease ends; what is not done becomes pending again.
    Close {
        /// The worker was lost: halve what is left, so that a poison task is cornered.
        halve: bool,
    },
    /// The holder loses the tasks from this one on, none of which it has begun.
    Trim {
        /// The first of them.
        at: u64,
    },
    /// The outputs of pending tasks turned up.
    Settle {
        /// The tasks, all of the range.
        run: Run,
    },
}

/// An event that cannot happen to a range in its state.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{event} cannot happen to range {range} ({state})")]
pub struct Illegal {
    range: RangeId,
    state: &'static str,
    event: String,
}

/// The ranges that take the place of `range` after `event`; `ids` makes the ids of new ones.
///
/// # Errors
/// [`Illegal`] when the event cannot happen in the range's state.
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
            // What stays pending keeps the range's id.
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

/// The lease with one task marked; `None` when the task is not this lease's to mark.
fn marked(range: &Range, lease: &LeaseState, task: u64, mark: Mark) -> Option<LeaseState> {
    let at = usize::try_from(task.checked_sub(range.lo)?).ok()?;
    let mut lease = lease.clone();
    let place = lease.marks.get_mut(at).filter(|m| **m == Mark::Todo)?;
    *place = mark;
    Some(lease)
}

/// A lease with nothing left to do ends by itself.
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

/// The runs of equal marks as ranges.
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

/// The first piece keeps the range's id; the epoch goes with all of them, so that it never falls for any id.
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
