//! Reports progress and asks whether to stop.

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use crate::api::Progress;

/// Reports the progress of the render to the caller and asks whether to stop.
pub(crate) struct Watch<'a> {
    pub progress: &'a dyn Progress,
    pub stopped: AtomicBool,
    pub tiles: AtomicUsize,
    pub from: f32,
    pub to: f32,
}

impl<'a> Watch<'a> {
    /// Returns a watch over the round that advances the render from fraction `from` to `to`.
    pub fn new(progress: &'a dyn Progress, from: f32, to: f32) -> Self {
        Self {
            progress,
            stopped: AtomicBool::new(false),
            tiles: AtomicUsize::new(0),
            from,
            to,
        }
    }

    /// Returns false to stop.
    pub fn go_on(&self) -> bool {
        self.ask(1, 0.0)
    }

    /// Returns whether any call has returned that the render must stop.
    pub fn stopped(&self) -> bool {
        self.stopped.load(Ordering::Relaxed)
    }

    /// Returns false to stop. It is called often, because a tile of many passes takes long.
    pub fn ask(&self, count: usize, share: f32) -> bool {
        let done = self.tiles.load(Ordering::Relaxed);
        let at = self.from + (self.to - self.from) * (done as f32 + share) / count as f32;
        if !self.progress.at(at.min(1.0)) {
            self.stopped.store(true, Ordering::Relaxed);
        }
        !self.stopped.load(Ordering::Relaxed)
    }
}
