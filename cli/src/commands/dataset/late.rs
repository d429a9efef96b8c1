//! Progress display for operations that usually end within a moment.

use std::{
    sync::Mutex,
    time::{Duration, Instant},
};

use crate::output::{Meter, Output};

/// Progress of an operation that usually ends within a moment: nothing is shown until it has taken
/// a while.
pub struct Late {
    since: Instant,
    what: &'static str,
    meter: Mutex<Option<Meter>>,
    output: Output,
}

impl Late {
    const AFTER: Duration = Duration::from_secs(2);

    pub fn new(what: &'static str, output: Output) -> Self {
        Self {
            since: Instant::now(),
            what,
            meter: Mutex::new(None),
            output,
        }
    }

    pub fn update(&self, done: u64, of: u64) {
        if self.since.elapsed() > Self::AFTER {
            let mut meter = self.meter.lock().expect("no panic while locked");
            let text = format!("{done} of {of} {}", self.what);
            meter
                .get_or_insert_with(|| Meter::new(self.output))
                .update(done as f64 / of.max(1) as f64, text);
        }
    }

    pub fn finish(self) {
        if let Some(meter) = self.meter.into_inner().expect("no panic while locked") {
            meter.finish();
        }
    }
}
