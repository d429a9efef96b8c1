//! The commit protocol, checked exhaustively.
mod houses;
mod model;
mod reach;
mod rules;
mod state;
mod workers;

use std::collections::BTreeSet;
use std::time::Instant;

use stateright::{Checker, HasDiscoveries, Model};

use model::*;
use rules::{Bounds, Rules};

const ONE_TASK: Bounds = Bounds {
    tasks: 1,
    epochs: 2,
    worker_kills: 1,
    house_kills: 1,
    house_stops: 1,
    collections: 1,
};

#[test]
fn probe() {
    let t = Instant::now();
    let checker = Protocol { rules: Rules::ALL, bounds: ONE_TASK }
        .checker()
        .target_state_count(30_000_000)
        .timeout(std::time::Duration::from_secs(100))
        .finish_when(HasDiscoveries::AllFailures)
        .spawn_bfs()
        .join();
    println!("{} unique, {} total, depth {}, {:?}, done {}", checker.unique_state_count(), checker.state_count(), checker.max_depth(), t.elapsed(), checker.is_done());
    for (name, path) in checker.discoveries() {
        println!("{name}: {:?}", path.into_actions());
    }
}
