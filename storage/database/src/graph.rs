//! Computes when stages may begin and when a job is over. Pure functions.

use picofarm_proto::messages::{JobState, StageState, TaskCounts};

/// A stored stage, with its tasks counted.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Node {
    /// Positions of the stages that it depends on, all smaller than its own.
    pub needs: Vec<u32>,
    /// Whether it begins even if tasks of those stages were given up.
    pub tolerate_dead: bool,
    /// The number of its tasks in each state.
    pub counts: TaskCounts,
}

/// Returns the state of each stage, and the job's final state if it has ended. A job has ended when
/// nothing is leased and no pending task can ever begin.
pub(crate) fn states(nodes: &[Node]) -> (Vec<StageState>, Option<JobState>) {
    let mut states: Vec<StageState> = Vec::with_capacity(nodes.len());
    for node in nodes {
        let open = node.counts.pending + node.counts.leased > 0;
        let met = node.needs.iter().all(|need| {
            let state = states.get(*need as usize).copied();
            match state {
                Some(StageState::Done) => true,
                Some(StageState::Failed) => node.tolerate_dead,
                Some(StageState::Blocked | StageState::Open) | None => false,
            }
        });
        states.push(match (open, met) {
            (true, true) => StageState::Open,
            (true, false) => StageState::Blocked,
            (false, _) if node.counts.dead > 0 => StageState::Failed,
            (false, _) => StageState::Done,
        });
    }
    let leased = nodes.iter().any(|node| node.counts.leased > 0);
    let over = !leased && !states.contains(&StageState::Open);
    let done = states.iter().all(|state| *state == StageState::Done);
    let end = over.then_some(match done {
        true => JobState::Done,
        false => JobState::Failed,
    });
    (states, end)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn node(needs: &[u32], pending: u64, done: u64, dead: u64) -> Node {
        Node {
            needs: needs.to_vec(),
            tolerate_dead: false,
            counts: TaskCounts {
                total: pending + done + dead,
                done,
                pending,
                dead,
                ..TaskCounts::default()
            },
        }
    }

    #[test]
    fn a_stage_opens_when_what_it_needs_is_done() {
        let (now, end) = states(&[node(&[], 3, 0, 0), node(&[0], 5, 0, 0)]);
        assert_eq!(now, [StageState::Open, StageState::Blocked]);
        assert_eq!(end, None);
        let (now, end) = states(&[node(&[], 0, 3, 0), node(&[0], 5, 0, 0)]);
        assert_eq!(now, [StageState::Done, StageState::Open]);
        assert_eq!(end, None);
        let (_, end) = states(&[node(&[], 0, 3, 0), node(&[0], 0, 5, 0)]);
        assert_eq!(end, Some(JobState::Done));
    }

    #[test]
    fn a_dead_task_ends_the_job_once_nothing_else_can_run() {
        let mut nodes = vec![node(&[], 0, 2, 1), node(&[0], 5, 0, 0), node(&[], 4, 0, 0)];
        let (now, end) = states(&nodes);
        assert_eq!(
            now,
            [StageState::Failed, StageState::Blocked, StageState::Open]
        );
        assert_eq!(end, None, "the third stage does not depend on it");
        nodes[2] = node(&[], 0, 4, 0);
        assert_eq!(states(&nodes).1, Some(JobState::Failed));
        nodes[1].tolerate_dead = true;
        let (now, end) = states(&nodes);
        assert_eq!(now[1], StageState::Open);
        assert_eq!(end, None);
    }

    #[test]
    fn a_stage_whose_results_exist_waits_for_nobody() {
        let (now, _) = states(&[node(&[], 3, 0, 0), node(&[0], 0, 5, 0), node(&[1], 1, 0, 0)]);
        assert_eq!(now[1..], [StageState::Done, StageState::Open]);
    }

    /// Generates a node without its dependencies.
    fn one() -> impl Strategy<Value = (Vec<prop::sample::Index>, Node)> {
        let needs = prop::collection::vec(any::<prop::sample::Index>(), 0..3);
        let counts = (0u64..3, 0u64..3, 0u64..2, 0u64..2);
        (needs, counts, any::<bool>()).prop_map(|(needs, counts, tolerate_dead)| {
            let (pending, done, dead, leased) = counts;
            let mut node = node(&[], pending, done, dead);
            node.counts.leased = leased;
            node.counts.total += leased;
            node.tolerate_dead = tolerate_dead;
            (needs, node)
        })
    }

    fn nodes() -> impl Strategy<Value = Vec<Node>> {
        prop::collection::vec(one(), 1..8).prop_map(|all| {
            let choose = |(i, (needs, mut node)): (usize, (Vec<prop::sample::Index>, Node))| {
                // A node depends on earlier nodes only; the first one has none.
                let needs = needs.iter().filter(|_| i > 0);
                node.needs = needs.map(|n| n.index(i) as u32).collect();
                node
            };
            all.into_iter().enumerate().map(choose).collect()
        })
    }

    proptest! {
        #[test]
        fn a_job_never_hangs(nodes in nodes()) {
            let (now, end) = states(&nodes);
            // Either something runs or may run, or the job is over.
            let runs = nodes.iter().any(|n| n.counts.leased > 0);
            prop_assert_eq!(end.is_none(), runs || now.contains(&StageState::Open));
            let all_done = nodes.iter().all(|n| n.counts.done == n.counts.total);
            prop_assert_eq!(end == Some(JobState::Done), all_done);
        }

        #[test]
        fn doing_what_may_run_brings_every_job_to_its_end(mut nodes in nodes()) {
            for _ in 0..=nodes.len() {
                let (now, end) = states(&nodes);
                if end.is_some() {
                    return Ok(());
                }
                for (node, state) in nodes.iter_mut().zip(now) {
                    let counts = &mut node.counts;
                    counts.done += counts.leased;
                    counts.leased = 0;
                    if state == StageState::Open {
                        counts.done += counts.pending;
                        counts.pending = 0;
                    }
                }
            }
            prop_assert!(states(&nodes).1.is_some());
        }
    }
}
