//! Decides how many allocations a pool needs. Pure: the same situation gives the same decision, so
//! that a restarted program continues where it stopped.

use std::fmt::Write;

use picofarm_proto::show;
use serde::Serialize;

use crate::{
    client::{Demand, StageDemand},
    output::duration,
};

/// A running allocation whose worker has not connected for this long no longer counts as starting:
/// its worker is at another coordinator, or has failed.
pub const STARTS_WITHIN_S: f64 = 120.0;
/// Stages named in a reason.
const NAMED: usize = 3;

/// The limits of a pool.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bounds {
    /// Most allocations that wait or run.
    pub max_workers: u32,
    /// Most allocations that wait.
    pub backlog: u32,
    /// Seconds of waiting work that justify one more worker.
    pub work_s: f64,
}

/// An allocation in the batch system.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Allocation {
    /// Its id.
    pub id: String,
    /// Seconds since its start; `None` while it waits.
    pub running_s: Option<f64>,
    /// Why it waits, in the batch system's words; may be empty.
    pub reason: String,
}

/// What to do, and why.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct Decision {
    /// Workers that the waiting tasks need beyond those that are connected.
    pub wanted: u32,
    /// Allocations that wait.
    pub pending: u32,
    /// Allocations that run and whose workers are about to connect.
    pub starting: u32,
    /// Allocations that run.
    pub running: u32,
    /// Waiting tasks that no worker of the pool can run.
    pub unable: u64,
    /// Allocations to submit.
    pub submit: u32,
    /// Ids of waiting allocations to cancel.
    pub cancel: Vec<String>,
    /// The reason, in words.
    pub reason: String,
}

/// Returns the workers that a stage's waiting tasks need beyond the connected ones.
fn wanted(stage: &StageDemand, bounds: &Bounds) -> u32 {
    if !stage.refused.is_empty() {
        return 0;
    }
    let workers = match stage.task_seconds {
        // The cast saturates.
        Some(s) if s.is_finite() => (stage.tasks as f64 * s / bounds.work_s).ceil() as u64,
        _ => stage.tasks,
    };
    let workers = workers.clamp(1, stage.tasks.max(1)).min(stage.tasks);
    let workers = u32::try_from(workers).unwrap_or(u32::MAX);
    // Idle workers that are about to join count against the limit as well.
    workers
        .min(stage.room.unwrap_or(u32::MAX))
        .saturating_sub(stage.idle)
}

/// Decides what a pool does now. `is_worker` checks whether a worker's name is that of an
/// allocation's worker. Allocations are in the order of their submission.
pub fn decide(
    demand: &Demand,
    allocations: &[Allocation],
    bounds: &Bounds,
    is_worker: impl Fn(&str, &Allocation) -> bool,
) -> Decision {
    let wanted = demand
        .stages
        .iter()
        .fold(0_u32, |sum, s| sum.saturating_add(wanted(s, bounds)));
    let waits = |a: &&Allocation| a.running_s.is_none();
    let starts = |a: &&Allocation| {
        let young = a.running_s.is_some_and(|s| s < STARTS_WITHIN_S);
        young && !demand.workers.iter().any(|w| is_worker(&w.name, a))
    };
    let pending: Vec<&Allocation> = allocations.iter().filter(waits).collect();
    let starting = allocations.iter().filter(starts).count() as u32;
    let count = pending.len() as u32;
    let running = allocations.len() as u32 - count;
    let coming = count + starting;
    let all = allocations.len() as u32;

    let submit = wanted
        .saturating_sub(coming)
        .min(bounds.max_workers.saturating_sub(all))
        .min(bounds.backlog.saturating_sub(count));
    let surplus = match demand.unknown {
        // There may be more tasks than is known.
        true => 0,
        false => coming.saturating_sub(wanted),
    };
    let beyond = all.saturating_sub(bounds.max_workers);
    let cancelled = surplus.max(beyond).min(count) as usize;
    // The newest ones, because the others have waited longer.
    let cancel: Vec<String> = pending[pending.len() - cancelled..]
        .iter()
        .map(|a| a.id.clone())
        .collect();
    let mut decision = Decision {
        wanted,
        pending: count,
        starting,
        running,
        unable: {
            let refused = demand.stages.iter().filter(|s| !s.refused.is_empty());
            refused.map(|s| s.tasks).sum()
        },
        submit,
        cancel,
        reason: String::new(),
    };
    decision.reason = reason(&decision, demand, &pending, bounds);
    decision
}

/// Describes the tasks that wait: "12 of stage render of job X, about 5.3 s each".
fn waiting(stage: &StageDemand) -> String {
    let mut text = stage.tasks.to_string();
    match &*stage.stage {
        "" => text += " of a job that this token may not see",
        name => {
            let _ = write!(text, " of stage {} of job {}", show::line(name), stage.job);
        }
    }
    if let Some(seconds) = stage.task_seconds {
        let _ = write!(text, ", about {} each", duration(seconds));
    }
    text
}

/// Explains a decision.
fn reason(d: &Decision, demand: &Demand, pending: &[&Allocation], bounds: &Bounds) -> String {
    let (able, refused): (Vec<_>, Vec<_>) =
        demand.stages.iter().partition(|s| s.refused.is_empty());
    let mut text = if able.is_empty() {
        "no task waits for this pool".to_owned()
    } else {
        let shown: Vec<String> = able.iter().take(NAMED).map(|s| waiting(s)).collect();
        let more = match able.len().saturating_sub(NAMED) {
            0 => String::new(),
            more => format!("; {more} more stages"),
        };
        let wants = match d.wanted {
            0 => "the connected workers suffice".to_owned(),
            1 => "1 more worker would help".to_owned(),
            n => format!("{n} more workers would help"),
        };
        format!("tasks wait ({}{more}); {wants}", shown.join("; "))
    };
    let _ = write!(
        text,
        "; {} of at most {} allocations: {} wait, {} run",
        d.pending + d.running,
        bounds.max_workers,
        d.pending,
        d.running
    );
    if d.starting > 0 {
        let _ = write!(text, " ({} not connected yet)", d.starting);
    }
    let mut whys: Vec<&str> = pending.iter().map(|a| &*a.reason).collect();
    whys.retain(|why| !why.is_empty() && *why != "None");
    whys.sort_unstable();
    whys.dedup();
    if !whys.is_empty() {
        let _ = write!(text, "; the queue says {}", show::line(&whys.join(", ")));
    }
    let coming = d.pending + d.starting;
    if d.submit == 0 && d.wanted > coming {
        let limit = match d.pending + d.running >= bounds.max_workers {
            true => "--max-workers",
            false => "--backlog",
        };
        let _ = write!(text, "; {limit} is reached");
    }
    let mut seen = Vec::new();
    for stage in refused {
        if seen.len() < NAMED && !seen.contains(&&stage.refused) {
            seen.push(&stage.refused);
            let _ = write!(
                text,
                "; not for this pool: {}: {}",
                waiting(stage),
                show::line(&stage.refused)
            );
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::client::PoolWorker;

    const BOUNDS: Bounds = Bounds {
        max_workers: 8,
        backlog: 5,
        work_s: 60.0,
    };

    fn stage(tasks: u64, task_seconds: Option<f64>) -> StageDemand {
        StageDemand {
            job: "j".into(),
            stage: "render".into(),
            tasks,
            task_seconds,
            ..StageDemand::default()
        }
    }

    fn demand(stages: Vec<StageDemand>) -> Demand {
        Demand {
            stages,
            ..Demand::default()
        }
    }

    fn allocation(id: usize, running_s: Option<f64>) -> Allocation {
        Allocation {
            id: id.to_string(),
            running_s,
            reason: String::new(),
        }
    }

    fn named(name: &str, allocation: &Allocation) -> bool {
        name == allocation.id
    }

    fn decided(demand: &Demand, allocations: &[Allocation]) -> Decision {
        decide(demand, allocations, &BOUNDS, named)
    }

    prop_compose! {
        fn any_stage()(
            tasks in 0_u64..50,
            seconds in proptest::option::of(0.01_f64..1e4),
            idle in 0_u32..5,
            room in proptest::option::of(0_u32..10),
            refused in proptest::bool::weighted(0.2),
        ) -> StageDemand {
            StageDemand {
                idle,
                room,
                refused: if refused { "too long".into() } else { String::new() },
                ..stage(tasks, seconds)
            }
        }
    }

    prop_compose! {
        /// A situation: demand, and allocations of which some have connected workers.
        fn any_situation()(
            stages in proptest::collection::vec(any_stage(), 0..4),
            states in proptest::collection::vec(
                (proptest::option::of(0.0_f64..400.0), any::<bool>()), 0..12),
            unknown in proptest::bool::weighted(0.2),
        ) -> (Demand, Vec<Allocation>) {
            let mut demand = Demand { unknown, ..demand(stages) };
            let mut allocations = Vec::new();
            for (id, (running, connected)) in states.into_iter().enumerate() {
                if running.is_some() && connected {
                    demand.workers.push(PoolWorker { name: id.to_string(), tasks: 1 });
                }
                allocations.push(allocation(id, running));
            }
            (demand, allocations)
        }
    }

    /// Returns the allocations after a decision was carried out.
    fn after(decision: &Decision, allocations: &[Allocation]) -> Vec<Allocation> {
        let mut all: Vec<Allocation> = allocations.to_vec();
        all.retain(|a| !decision.cancel.contains(&a.id));
        for n in 0..decision.submit as usize {
            all.push(allocation(1000 + all.len() + n, None));
        }
        all
    }

    proptest! {
        #[test]
        fn no_decision_exceeds_the_bounds_or_both_submits_and_cancels(
            (demand, before) in any_situation()
        ) {
            let decision = decided(&demand, &before);
            let all = after(&decision, &before);
            let waiting = |all: &[Allocation]| all.iter().filter(|a| a.running_s.is_none()).count();
            prop_assert!(decision.submit == 0 || all.len() <= 8);
            prop_assert!(decision.submit == 0 || waiting(&all) <= 5);
            prop_assert!(decision.submit == 0 || decision.cancel.is_empty());
            // Waiting allocations beyond the bound go.
            prop_assert!(all.len() <= 8 || waiting(&all) == 0);
        }

        #[test]
        fn only_waiting_allocations_are_cancelled_and_the_newest_first(
            (demand, before) in any_situation()
        ) {
            let decision = decided(&demand, &before);
            let waiting: Vec<_> = before.iter().filter(|a| a.running_s.is_none()).collect();
            let kept = waiting.len() - decision.cancel.len();
            let newest: Vec<_> = waiting[kept..].iter().map(|a| a.id.clone()).collect();
            prop_assert_eq!(decision.cancel, newest);
        }

        #[test]
        fn a_decision_that_was_carried_out_needs_no_other(
            (demand, before) in any_situation()
        ) {
            // A restarted program sees the same situation, so it neither doubles nor undoes.
            let all = after(&decided(&demand, &before), &before);
            let again = decided(&demand, &all);
            prop_assert_eq!((again.submit, again.cancel), (0, vec![]));
        }

        #[test]
        fn waiting_allocations_that_cover_the_demand_are_enough(
            (demand, before) in any_situation()
        ) {
            let decision = decided(&demand, &before);
            if decision.pending + decision.starting >= decision.wanted {
                prop_assert_eq!(decision.submit, 0);
            }
        }

        #[test]
        fn without_demand_every_waiting_allocation_goes(
            (mut demand, before) in any_situation()
        ) {
            demand.stages.clear();
            demand.unknown = false;
            let decision = decided(&demand, &before);
            prop_assert_eq!((decision.submit, decision.wanted), (0, 0));
            prop_assert_eq!(decision.cancel.len() as u32, decision.pending);
        }

        #[test]
        fn a_stage_never_gets_more_workers_than_tasks_or_room(s in any_stage()) {
            let n = wanted(&s, &BOUNDS);
            prop_assert!(u64::from(n) <= s.tasks);
            prop_assert!(n <= s.room.unwrap_or(u32::MAX));
            if s.tasks > u64::from(s.idle) && s.room.is_none() && s.idle == 0 && s.refused.is_empty() {
                prop_assert!(n >= 1);
            }
        }
    }

    #[test]
    fn short_tasks_share_workers_and_long_or_unknown_ones_get_one_each() {
        let submits = |seconds| decided(&demand(vec![stage(4, seconds)]), &[]).submit;
        assert_eq!(submits(Some(1.0)), 1);
        assert_eq!(submits(Some(30.0)), 2);
        assert_eq!(submits(Some(1e4)), 4);
        assert_eq!(submits(None), 4);
        assert_eq!(decided(&demand(vec![stage(40, None)]), &[]).submit, 5);
    }

    #[test]
    fn a_worker_that_starts_counts_until_it_connects_or_is_overdue() {
        let mut one = demand(vec![stage(1, None)]);
        let young = [allocation(1, Some(3.0))];
        assert_eq!(decided(&one, &young).submit, 0);
        assert_eq!(decided(&one, &[allocation(1, Some(1e3))]).submit, 1);
        one.workers.push(PoolWorker {
            name: "1".into(),
            tasks: 1,
        });
        assert_eq!(decided(&one, &young).submit, 1);
    }

    #[test]
    fn a_reason_names_tasks_limits_and_the_words_of_the_queue() {
        let mut waits = allocation(1, None);
        waits.reason = "QOSMaxJobsPerUserLimit".into();
        let mut long = stage(2, Some(9e3));
        long.refused = "a task is taken to need 2 h".into();
        let all = demand(vec![stage(40, Some(300.0)), long]);
        let running: Vec<_> = (2..9).map(|id| allocation(id, Some(500.0))).collect();
        let said = decided(&all, &[&[waits][..], &running].concat()).reason;
        for words in [
            "40 of stage render of job j, about 5 min 00 s each",
            "40 more workers would help",
            "8 of at most 8 allocations: 1 wait, 7 run",
            "the queue says QOSMaxJobsPerUserLimit",
            "--max-workers is reached",
            "not for this pool: 2 of stage render of job j, about 2 h 30 min each: a task is taken to need 2 h",
        ] {
            assert!(said.contains(words), "{words:?} in {said:?}");
        }
    }
}
