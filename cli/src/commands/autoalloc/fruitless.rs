//! Finds allocations that end before their worker has connected, for example because a token is
//! wrong or a library is missing. Without a pause, such a pool would submit for ever.

use std::collections::BTreeMap;

use super::decide::{Allocation, STARTS_WITHIN_S};

/// The allocations of the last round, and whether the worker of each was ever connected.
#[derive(Debug, Default)]
pub struct Fruitless(BTreeMap<String, bool>);

/// News of the allocations since the last round.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct News {
    /// Whether a worker connected that was not connected before.
    pub connected: bool,
    /// Allocations that ended without a worker.
    pub ended: Vec<String>,
}

impl Fruitless {
    /// Compares the allocations with those of the last round. `connected` returns whether the
    /// worker of an allocation is connected.
    pub fn look(
        &mut self,
        allocations: &[Allocation],
        connected: impl Fn(&Allocation) -> bool,
    ) -> News {
        let mut news = News::default();
        let mut now = BTreeMap::new();
        for allocation in allocations {
            let before = self.0.remove(&allocation.id).unwrap_or(false);
            // A worker at another coordinator is not visible here.
            let old = allocation.running_s.is_some_and(|s| s >= STARTS_WITHIN_S);
            let works = connected(allocation);
            news.connected |= works && !before;
            now.insert(allocation.id.clone(), before || works || old);
        }
        let gone = std::mem::replace(&mut self.0, now);
        let ended = gone.into_iter().filter(|(_, worked)| !worked);
        news.ended = ended.map(|(id, _)| id).collect();
        news
    }

    /// Adds an allocation that was just submitted. It may end before the next round.
    pub fn submitted(&mut self, id: &str) {
        self.0.insert(id.to_owned(), false);
    }

    /// Forgets an allocation that this program has cancelled.
    pub fn cancelled(&mut self, id: &str) {
        self.0.remove(id);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_allocations_that_end_without_a_worker_of_their_own_are_fruitless() {
        let all = |ids: &[(&str, Option<f64>)]| -> Vec<Allocation> {
            let allocation = |(id, running_s): &(&str, Option<f64>)| Allocation {
                id: (*id).to_owned(),
                running_s: *running_s,
                reason: String::new(),
            };
            ids.iter().map(allocation).collect()
        };
        let mut fruitless = Fruitless::default();
        let waits = all(&[("1", None), ("2", None), ("3", None), ("4", None)]);
        assert_eq!(fruitless.look(&waits, |_| false), News::default());
        let runs = all(&[
            ("1", Some(3.0)),
            ("2", Some(3.0)),
            ("3", None),
            ("4", Some(500.0)),
        ]);
        let news = fruitless.look(&runs, |a| a.id == "1");
        assert_eq!((news.connected, news.ended.len()), (true, 0));
        fruitless.cancelled("3");
        // Its worker ended as it should, that of 2 never connected, and that of 4 is elsewhere.
        let news = fruitless.look(&[], |_| false);
        assert_eq!((news.connected, news.ended), (false, vec!["2".to_owned()]));
        fruitless.submitted("5");
        assert_eq!(fruitless.look(&[], |_| false).ended, ["5"]);
        assert_eq!(fruitless.look(&[], |_| false), News::default());
    }
}
