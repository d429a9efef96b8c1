//! The demo's pictures, drawn again each time a room is finished.

use std::{path::PathBuf, time::Duration};

use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;

use crate::dataset;

/// How often the store is asked for finished rooms.
const PERIOD: Duration = Duration::from_secs(1);
/// Rooms on a sheet.
pub const ROOMS: usize = 16;

/// A contact sheet that grows with the data set.
pub struct GrowingSheet {
    stop: CancellationToken,
    task: JoinHandle<()>,
}

impl GrowingSheet {
    /// Draws the first `total` scenes of the data set at `place` into `dir` as they are finished.
    pub fn start(place: String, total: u64, dir: PathBuf) -> Self {
        let stop = CancellationToken::new();
        let task = tokio::spawn(grow(place, total, dir, stop.clone()));
        Self { stop, task }
    }

    /// Ends it. When this returns, no picture is being written.
    pub async fn stop(self) {
        self.stop.cancel();
        // A drawing that panicked is reported by the last drawing, which every demo makes.
        self.task.await.ok();
    }
}

/// The last picture is the caller's, who has verified the rooms. A failure here is met again there.
async fn grow(place: String, total: u64, dir: PathBuf, stop: CancellationToken) {
    let mut drawn = 0;
    loop {
        tokio::select! {
            () = stop.cancelled() => return,
            () = tokio::time::sleep(PERIOD) => {}
        }
        let Ok(dataset) = dataset::open(&place).await else {
            continue;
        };
        let Ok(mut finished) = dataset.scenes_present().await else {
            continue;
        };
        finished.retain(|&scene| scene < total);
        finished.truncate(ROOMS);
        if finished.len() > drawn && dataset::draw(&place, &finished, &dir).await.is_ok() {
            drawn = finished.len();
        }
    }
}
