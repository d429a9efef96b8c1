//! The commit protocol of tasks, leases, instances (coordinators over one database) and the
//! collector of orphaned objects, checked exhaustively within bounds: every interleaving of two
//! coordinators, two workers and a collector over one database and one object store.
//!
//! * `rules.rs`: the checks of the protocol, their places in the product, and the bounds.
//! * `state.rs`: the state. `instances.rs`, `workers.rs`: the steps of each process. `model.rs`:
//!   the actions and the laws.
//! * `reach.rs`: the job's end can be reached from every state.
//!
//! Faults are modelled as follows. *Stopped* processes take no step for any length of time while
//! leases and instance rows expire around them. Nothing in the model keeps a process from
//! continuing with old knowledge. *Killed* processes lose their knowledge and restart under a new
//! name. *Messages* stay in the network forever once sent: they may arrive late, out of order,
//! repeatedly, at either instance, or never, which models loss. An instance decides from its memory
//! and writes in one transaction. Because no other process sees its memory, the decision and the
//! write are one step even if time passes between them. The model has no time: anything that a
//! clock ends may end at any moment.
//!
//! Faults of coordinators affect process 0 only, and the first lease goes to worker 0, because the
//! others are symmetric.

mod instances;
mod model;
mod reach;
mod rules;
mod state;
mod workers;

use stateright::{Checker, HasDiscoveries, Model};

use model::{DEAD_EPOCH, FENCED, LAWS, LEASED_AGAIN, ONCE, Protocol, ROBBED, THERE};
use rules::{Bounds, Rules};

/// One task, with a worker's kill, a stopped coordinator and a run of the collector together.
const STOPPED_INSTANCE: Bounds = Bounds {
    tasks: 1,
    epochs: 2,
    worker_kills: 1,
    instance_kills: 0,
    instance_stops: 1,
    collections: 1,
};

/// The coordinator is killed instead of stopped.
const KILLED_INSTANCE: Bounds = Bounds {
    instance_kills: 1,
    instance_stops: 0,
    ..STOPPED_INSTANCE
};

/// Three epochs without kills. Workers and the collector may be stopped, and the collector runs
/// twice.
const THREE_EPOCHS: Bounds = Bounds {
    epochs: 3,
    worker_kills: 0,
    instance_stops: 0,
    collections: 2,
    ..STOPPED_INSTANCE
};

/// A range of two tasks, so that a lease may end half done. Processes are only stopped.
const TWO_TASKS: Bounds = Bounds {
    tasks: 2,
    worker_kills: 0,
    instance_stops: 0,
    ..STOPPED_INSTANCE
};

/// Asserts that every law is true, and that each `sometimes` of the model happens.
fn assert_holds(bounds: Bounds) {
    let checker = Protocol {
        rules: Rules::ALL,
        bounds,
    }
    .checker()
    .spawn_bfs()
    .join();
    println!(
        "{} states, {} steps, {} deep",
        checker.unique_state_count(),
        checker.state_count(),
        checker.max_depth()
    );
    for (law, _) in LAWS {
        checker.assert_no_discovery(law);
    }
    for possible in [model::ENDS_LATE, model::COLLECTED, model::ZOMBIE] {
        checker.assert_any_discovery(possible);
    }
}

/// Asserts that each of these laws breaks, and prints a shortest trace for each.
fn assert_breaks(rules: Rules, laws: &[&'static str]) {
    let checker = Protocol {
        rules,
        bounds: STOPPED_INSTANCE,
    }
    .checker()
    .finish_when(HasDiscoveries::AllOf(laws.iter().copied().collect()))
    .spawn_bfs()
    .join();
    println!("{} states", checker.unique_state_count());
    for law in laws {
        println!("broken: {law}");
        for action in checker.assert_any_discovery(law).into_actions() {
            println!("    {action:?}");
        }
    }
}

/// Asserts that only this law breaks in the whole state space.
fn assert_breaks_only(rules: Rules, law: &'static str) {
    assert_breaks(rules, &[law]);
    let bounds = STOPPED_INSTANCE;
    let checker = Protocol { rules, bounds }.checker().spawn_bfs().join();
    for (other, _) in LAWS.into_iter().filter(|(other, _)| *other != law) {
        checker.assert_no_discovery(other);
    }
}

#[test]
fn laws_hold_when_a_coordinator_is_stopped_past_its_lease() {
    assert_holds(STOPPED_INSTANCE);
}

#[test]
fn laws_hold_when_a_coordinator_is_killed() {
    assert_holds(KILLED_INSTANCE);
}

#[test]
fn laws_hold_over_three_epochs_and_two_collections() {
    assert_holds(THREE_EPOCHS);
}

#[test]
fn laws_hold_for_a_lease_of_two_tasks() {
    assert_holds(TWO_TASKS);
}

#[test]
fn the_job_can_end_from_every_state() {
    for bounds in [STOPPED_INSTANCE, KILLED_INSTANCE] {
        let model = Protocol {
            rules: Rules::ALL,
            bounds,
        };
        let (stranded, states) = reach::stranded(&model, |state| model.ended(state));
        println!("{states} states");
        assert!(
            stranded.is_empty(),
            "{} of {states}, first {:#?}",
            stranded.len(),
            stranded[0]
        );
    }
}

#[test]
fn without_the_fence_a_instance_that_was_given_up_writes() {
    let rules = Rules {
        instance_is_fenced: false,
        ..Rules::ALL
    };
    assert_breaks(rules, &[FENCED]);
}

#[test]
fn without_the_owner_check_two_instances_commit_one_task() {
    let rules = Rules {
        writes_check_owner: false,
        ..Rules::ALL
    };
    assert_breaks(rules, &[ONCE, DEAD_EPOCH, LEASED_AGAIN]);
}

#[test]
fn without_the_lease_check_a_zombie_commits() {
    let rules = Rules {
        commit_checks_lease: false,
        ..Rules::ALL
    };
    assert_breaks(rules, &[DEAD_EPOCH]);
}

#[test]
fn a_lease_adopted_without_its_epoch_lets_a_zombie_commit() {
    let rules = Rules {
        lease_adoption_is_conditional: false,
        ..Rules::ALL
    };
    assert_breaks(rules, &[DEAD_EPOCH]);
}

#[test]
fn a_report_before_the_upload_commits_nothing_real() {
    let rules = Rules {
        store_precedes_report: false,
        ..Rules::ALL
    };
    assert_breaks(rules, &[THERE]);
}

#[test]
fn a_manifest_reused_without_its_objects_commits_nothing_real() {
    let rules = Rules {
        reuse_checks_objects: false,
        ..Rules::ALL
    };
    assert_breaks(rules, &[THERE]);
}

#[test]
fn a_collector_that_does_not_hold_the_range_deletes_what_is_committed() {
    let rules = Rules {
        collector_holds_range: false,
        ..Rules::ALL
    };
    assert_breaks(rules, &[THERE]);
}

#[test]
fn a_collector_whose_hold_runs_out_deletes_what_is_committed() {
    let rules = Rules {
        hold_outlasts_lease: false,
        ..Rules::ALL
    };
    assert_breaks(rules, &[THERE]);
}

#[test]
fn a_takeover_before_the_expiry_robs_a_living_instance_but_loses_nothing() {
    let rules = Rules {
        takeover_waits_for_expiry: false,
        ..Rules::ALL
    };
    assert_breaks_only(rules, ROBBED);
}
