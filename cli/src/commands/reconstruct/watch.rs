//! Progress of a reconstruction: the current part, its loss, and its remaining time.

use std::{sync::Mutex, time::Instant};

use picofarm_reconstruct::Phase;
use tokio_util::sync::CancellationToken;

use crate::output::{Meter, Output, duration};

/// Time for which a part is observed before its end is forecast, in seconds.
const WATCHED_S: f64 = 1.0;

/// Shows progress. A cancelled token stops the work.
pub struct Watch {
    shown: Mutex<Shown>,
    stop: CancellationToken,
}

struct Shown {
    meter: Meter,
    part: String,
    began: Instant,
}

impl Watch {
    pub fn new(output: Output, stop: CancellationToken) -> Self {
        let shown = Shown {
            meter: Meter::new(output),
            part: String::new(),
            began: Instant::now(),
        };
        Self {
            shown: Mutex::new(shown),
            stop,
        }
    }

    /// Shows the progress of a part. Returns whether to continue.
    pub fn step(&self, part: &str, done: f32) -> bool {
        self.show(part, done, None)
    }

    pub fn finish(self) {
        if let Ok(shown) = self.shown.into_inner() {
            shown.meter.finish();
        }
    }

    fn show(&self, part: &str, done: f32, loss: Option<f64>) -> bool {
        // If another thread has the lock, its progress is at least as new.
        if let Ok(mut shown) = self.shown.try_lock() {
            // All captures count as one part.
            let head = |text: &str| text.split(' ').next().unwrap_or("").to_owned();
            if head(&shown.part) != head(part) {
                shown.began = Instant::now();
            }
            part.clone_into(&mut shown.part);
            let elapsed = shown.began.elapsed().as_secs_f64();
            let mut text = part.to_owned();
            if let Some(loss) = loss {
                text += &format!(", loss {loss:.4}");
            }
            let done = f64::from(done);
            if elapsed > WATCHED_S && done > 0.01 && done < 1.0 {
                text += &format!(", about {} left", duration(elapsed * (1.0 - done) / done));
            }
            shown.meter.update(done, text);
        }
        !self.stop.is_cancelled()
    }
}

impl picofarm_transient::Progress for Watch {
    fn at(&self, done: f32) -> bool {
        self.show("ground truth", done, None)
    }
}

impl picofarm_reconstruct::Progress for Watch {
    fn at(&self, phase: Phase, done: f32, loss: Option<f64>) -> bool {
        self.show(phase.name(), done, loss)
    }
}
