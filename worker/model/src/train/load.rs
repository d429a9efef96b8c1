//! Loads examples ahead of the network: threads read and prepare the next examples while it learns,
//! as far ahead as memory allows.
//!
//! Each thread takes the next visit in order and works on it alone. The network receives examples
//! in that order, so the result does not depend on the number of threads.

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

/// The greatest number of batches of examples that wait for the network.
const AHEAD: usize = 2;

/// The resources for preparing examples.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Loading {
    /// The number of threads that read and prepare scenes.
    pub threads: usize,
    /// The bytes that scenes in preparation and waiting examples may take. At least one scene is
    /// always in preparation.
    pub room: usize,
}

impl Default for Loading {
    /// Uses the threads of the current pool, and 1 GiB.
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
    /// The number of visits in an epoch.
    each: u64,
    /// The number of finished visits.
    first: u64,
    /// The range of each step's batches that this process visits.
    share: Range<usize>,
    /// The orders of the most recently used epochs.
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

    /// Returns the number of visits in a step, and how many of them this process makes.
    fn of_step(&self) -> (u64, u64) {
        let batch = self.plan.batch as u64;
        (
            batch * self.plan.accumulate as u64,
            batch * self.share.len() as u64,
        )
    }

    /// Returns the number of remaining visits.
    pub(super) fn len(&self) -> u64 {
        let (all, ours) = self.of_step();
        (self.plan.epochs * self.each - self.first) / all * ours
    }

    /// Returns a visit: the scene's index, the visit's parameters, and its number among all visits
    /// of the training.
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

/// The inputs from which examples are made.
pub(super) struct Making<'a> {
    pub(super) plan: &'a Plan,
    pub(super) scenes: &'a dyn Scenes,
    /// Returns a visit by its position: the scene, the visit's parameters, and the visit's number
    /// if scenes look different at each visit.
    pub(super) visit: &'a (dyn Fn(u64) -> (usize, Visit, Option<u64>) + Sync),
    /// The number of visits.
    pub(super) count: u64,
    pub(super) loading: Loading,
}

impl Making<'_> {
    /// Prepares examples while `use_them` runs. The preparation ends when `use_them` returns.
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
            // However `use_them` ends, the threads end too.
            let _over = Closing(&exchange);
            use_them(&ready)
        })
    }

    /// Runs a thread's work. The thread has its own pool of one thread, so a scene is decoded by
    /// the thread that started it. In a larger pool, a thread that waits for a part would start
    /// another scene in the middle of this one.
    fn serve(&self, exchange: &Exchange) {
        let broken = Broken(exchange);
        let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build();
        match pool {
            Ok(pool) => pool.install(|| self.work(exchange)),
            // If the pool cannot be created, the process's own pool decodes.
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

    /// Makes the example of one visit; sets `bytes` to the memory that making it took.
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

/// The queue of examples between the threads that make them and the network.
#[derive(Default)]
struct Exchange {
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Default)]
struct State {
    /// The next visit that no thread has started.
    next: u64,
    /// The number of visits that the network has received.
    taken: u64,
    in_hand: usize,
    /// The finished examples, and their bytes.
    made: BTreeMap<u64, Result<Batch, ModelError>>,
    waiting: usize,
    /// Buffers of examples that have joined their batch. They are reused because clearing new
    /// memory takes as long as writing an example.
    spare: Vec<Batch>,
    /// The greatest number of bytes that making an example took; 0 before the first is made.
    largest: usize,
    closed: bool,
    broken: bool,
}

impl State {
    /// Returns whether another scene may be started.
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

    /// Returns the next visit for which to make an example, or `None` if there is none or the
    /// network has stopped.
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

    /// Returns an empty example that reuses an earlier buffer if there is one.
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

/// A guard that ends the threads when it is dropped.
struct Closing<'a>(&'a Exchange);

impl Drop for Closing<'_> {
    fn drop(&mut self) {
        self.0.lock().closed = true;
        self.0.changed.notify_all();
    }
}

/// A guard that reports a thread's panic to the network. Without it, the network would wait for
/// ever for the examples of that thread.
struct Broken<'a>(&'a Exchange);

impl Drop for Broken<'_> {
    fn drop(&mut self) {
        if thread::panicking() {
            self.0.lock().broken = true;
            self.0.changed.notify_all();
        }
    }
}

/// The network's end of the queue of examples.
pub(super) struct Ready<'a> {
    exchange: &'a Exchange,
    batch: u64,
    count: u64,
    /// The limit in bytes, as in [`Loading::room`].
    room: usize,
}

impl Ready<'_> {
    /// Returns whether all visits have been received.
    pub(super) fn is_over(&self) -> bool {
        self.exchange.lock().taken == self.count
    }

    /// Returns the next batch. The last batch is smaller if fewer visits remain.
    ///
    /// # Errors
    /// The error of an example that could not be made.
    ///
    /// # Panics
    /// If a thread that makes examples has panicked, or if no visits remain.
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
            // Limits the spare buffers to the number of examples in preparation and to the
            // available memory.
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
