//! Examples ahead of the network: threads read and prepare what comes next while it learns, as far ahead as memory allows.
//!
//! Each thread takes the next visit in order and works on it alone; the network gets examples in that order. So what comes
//! out does not depend on the number of threads.

use std::{
    collections::BTreeMap,
    ops::Range,
    sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError},
    thread,
};

use super::{Plan, order, position::Position};
use crate::{
    ModelError,
    input::{Batch, Visit, example, example_of},
    scene::Scenes,
};

/// Batches of examples that wait for the network, at most.
const AHEAD: usize = 2;

/// How examples are made ready for the network.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Loading {
    /// Threads that read and prepare scenes.
    pub threads: usize,
    /// Bytes of scenes in hand and of examples that wait; one scene is always in hand.
    pub room: usize,
}

impl Default for Loading {
    /// The threads of the pool in which it is called, and 1 GiB.
    fn default() -> Self {
        Self {
            threads: rayon::current_num_threads(),
            room: 1 << 30,
        }
    }
}

/// The visits of a training from a position on, in order.
pub(super) struct Course<'a> {
    plan: &'a Plan,
    scenes: usize,
    /// Visits of an epoch.
    each: u64,
    /// Visits done.
    first: u64,
    /// Which batches of each step are visited here.
    share: Range<usize>,
    /// The orders of the epochs asked for last.
    orders: Mutex<BTreeMap<u64, Arc<Vec<usize>>>>,
}

impl<'a> Course<'a> {
    pub(super) fn new(
        plan: &'a Plan,
        scenes: usize,
        from: &Position,
        share: &Range<usize>,
    ) -> Self {
        let each = plan.batches(scenes) * plan.batch as u64;
        Self {
            plan,
            scenes,
            each,
            first: from.epoch * each + from.batches * plan.batch as u64,
            share: share.clone(),
            orders: Mutex::default(),
        }
    }

    /// Visits of a step, and those of them that are made here.
    fn of_step(&self) -> (u64, u64) {
        let batch = self.plan.batch as u64;
        (
            batch * self.plan.accumulate as u64,
            batch * self.share.len() as u64,
        )
    }

    /// How many are left.
    pub(super) fn len(&self) -> u64 {
        let (all, ours) = self.of_step();
        (self.plan.epochs * self.each - self.first) / all * ours
    }

    /// One of them: the scene's index, how it is visited, and its number among all visits of the training.
    pub(super) fn visit(&self, which: u64) -> (usize, Visit, Option<u64>) {
        let (all, ours) = self.of_step();
        let before = self.share.start as u64 * self.plan.batch as u64;
        let which = which / ours * all + before + which % ours;
        let (plan, which) = (self.plan, self.first + which);
        let (epoch, at) = (which / self.each, which % self.each);
        let mut orders = self.orders.lock().unwrap_or_else(PoisonError::into_inner);
        let order = orders
            .entry(epoch)
            .or_insert_with(|| Arc::new(order::epoch(plan.seed, epoch, self.scenes)));
        let scene = order[at as usize];
        while orders.len() > 2 {
            orders.pop_first();
        }
        let visit = order::visit(plan.seed, epoch, at, &plan.question, plan.augment);
        (scene, visit, Some(which))
    }
}

/// What examples are made of.
pub(super) struct Making<'a> {
    pub(super) plan: &'a Plan,
    pub(super) scenes: &'a dyn Scenes,
    /// The visits, in order: which scene, how, and the number of a visit where scenes look different at each.
    pub(super) visit: &'a (dyn Fn(u64) -> (usize, Visit, Option<u64>) + Sync),
    /// How many visits.
    pub(super) count: u64,
    pub(super) loading: Loading,
}

impl Making<'_> {
    /// Makes examples ready while `use_them` runs, and ends with it.
    pub(super) fn ahead<R>(&self, use_them: impl FnOnce(&Ready<'_>) -> R) -> R {
        let exchange = Exchange::default();
        thread::scope(|scope| {
            for _ in 0..self.loading.threads.max(1) {
                scope.spawn(|| self.serve(&exchange));
            }
            let ready = Ready {
                exchange: &exchange,
                batch: self.plan.batch as u64,
                count: self.count,
                room: self.loading.room,
            };
            // However it ends, the threads do.
            let _over = Closing(&exchange);
            use_them(&ready)
        })
    }

    /// A thread's work. Its own pool has one thread, so that a scene is decoded where it was taken up: in a pool of more,
    /// whoever waits for a part would begin with another scene in the middle of this one.
    fn serve(&self, exchange: &Exchange) {
        let broken = Broken(exchange);
        let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build();
        match pool {
            Ok(pool) => pool.install(|| self.work(exchange)),
            // Without one, the process's own pool decodes.
            Err(_) => self.work(exchange),
        }
        drop(broken);
    }

    fn work(&self, exchange: &Exchange) {
        while let Some(which) = exchange.take(self) {
            let mut bytes = 0;
            let made = self.example(which, exchange.spare(), &mut bytes);
            exchange.put(which, made, bytes);
        }
    }

    /// The example of a visit alone; `bytes` becomes what it took to make it.
    fn example(&self, which: u64, mut made: Batch, bytes: &mut usize) -> Result<Batch, ModelError> {
        let (index, visit, number) = (self.visit)(which);
        let scene = match number {
            Some(number) => self.scenes.visited(index, number),
            None => self.scenes.load(index),
        };
        let scene = scene.map_err(|source| ModelError::Scene {
            scene: index,
            source,
        })?;
        let question = &self.plan.question;
        let scene = match Arc::try_unwrap(scene) {
            Ok(mut alone) => {
                example_of(&mut made, question, &mut alone, visit)?;
                Arc::new(alone)
            }
            Err(shared) => {
                example(&mut made, question, &shared, visit)?;
                shared
            }
        };
        *bytes = scene.bytes() + made.bytes();
        self.scenes.take_back(scene);
        Ok(made)
    }
}

/// Examples between the threads that make them and the network.
#[derive(Default)]
struct Exchange {
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Default)]
struct State {
    /// The next visit that nobody has taken up.
    next: u64,
    /// Visits that the network has got.
    taken: u64,
    in_hand: usize,
    /// Examples that are made, and their bytes.
    made: BTreeMap<u64, Result<Batch, ModelError>>,
    waiting: usize,
    /// Room of examples that have joined their batch: fresh memory takes as long as what is written there.
    spare: Vec<Batch>,
    /// The most bytes that it took to make one; 0 = none is made yet.
    largest: usize,
    closed: bool,
    broken: bool,
}

impl State {
    /// Whether another scene may be taken up.
    fn may_begin(&self, making: &Making<'_>) -> bool {
        let idle = self.in_hand == 0 && self.made.is_empty();
        let loading = making.loading;
        let most = AHEAD as u64 * making.plan.batch as u64 + loading.threads as u64;
        let needed = self
            .waiting
            .saturating_add((self.in_hand + 1).saturating_mul(self.largest));
        let known = self.largest > 0 && needed <= loading.room;
        idle || (known && self.next < self.taken + most)
    }
}

impl Exchange {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn wait<'a>(&self, state: MutexGuard<'a, State>) -> MutexGuard<'a, State> {
        let woken = self.changed.wait(state);
        woken.unwrap_or_else(PoisonError::into_inner)
    }

    /// The next visit to make an example of; `None` where there is none, or nobody wants one any more.
    fn take(&self, making: &Making<'_>) -> Option<u64> {
        let mut state = self.lock();
        loop {
            if state.closed || state.broken || state.next >= making.count {
                return None;
            }
            if state.may_begin(making) {
                state.next += 1;
                state.in_hand += 1;
                return Some(state.next - 1);
            }
            state = self.wait(state);
        }
    }

    /// An empty example, with the room of one before if there is any.
    fn spare(&self) -> Batch {
        self.lock().spare.pop().unwrap_or_default()
    }

    fn put(&self, which: u64, made: Result<Batch, ModelError>, bytes: usize) {
        let mut state = self.lock();
        state.in_hand -= 1;
        state.largest = state.largest.max(bytes).max(1);
        state.waiting += made.as_ref().map_or(0, Batch::bytes);
        state.made.insert(which, made);
        drop(state);
        self.changed.notify_all();
    }
}

/// Nobody wants examples any more.
struct Closing<'a>(&'a Exchange);

impl Drop for Closing<'_> {
    fn drop(&mut self) {
        self.0.lock().closed = true;
        self.0.changed.notify_all();
    }
}

/// Tells the network where a thread panicked; it would wait for ever for what that thread had in hand.
struct Broken<'a>(&'a Exchange);

impl Drop for Broken<'_> {
    fn drop(&mut self) {
        if thread::panicking() {
            self.0.lock().broken = true;
            self.0.changed.notify_all();
        }
    }
}

/// Where the network gets its examples.
pub(super) struct Ready<'a> {
    exchange: &'a Exchange,
    batch: u64,
    count: u64,
    /// Bytes, as in [`Loading::room`].
    room: usize,
}

impl Ready<'_> {
    /// Whether all visits have been asked for.
    pub(super) fn is_over(&self) -> bool {
        self.exchange.lock().taken == self.count
    }

    /// The next batch; a smaller one at the very end, if visits are left over.
    ///
    /// # Errors
    /// What kept one of its examples from being made.
    ///
    /// # Panics
    /// Where a thread that makes examples did, and where there are no more.
    pub(super) fn next(&self) -> Result<Batch, ModelError> {
        let begun = self.exchange.lock().taken;
        let size = self.batch.min(self.count - begun);
        assert!(size > 0, "a batch is asked for each step and no more");
        let mut batch = Batch::default();
        for which in begun..begun + size {
            let example = self.example(which)?;
            let empty = batch.join(example, size as usize)?;
            let mut state = self.exchange.lock();
            let held = state.in_hand + state.spare.len() + 1;
            let held = held.saturating_mul(state.largest);
            // No more than are made at once, and no more than there is room for.
            if state.spare.len() <= state.in_hand && state.waiting.saturating_add(held) <= self.room
            {
                state.spare.push(empty);
            }
        }
        Ok(batch)
    }

    fn example(&self, which: u64) -> Result<Batch, ModelError> {
        let mut state = self.exchange.lock();
        let made = loop {
            if let Some(made) = state.made.remove(&which) {
                break made;
            }
            assert!(!state.broken, "a thread that prepares scenes panicked");
            state = self.exchange.wait(state);
        };
        state.taken += 1;
        state.waiting -= made.as_ref().map_or(0, Batch::bytes);
        drop(state);
        self.exchange.changed.notify_all();
        made
    }
}
