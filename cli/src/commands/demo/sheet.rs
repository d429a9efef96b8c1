//! The demo's pictures, redrawn each time a room is finished.

use std::{path::PathBuf, time::Duration};

use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;

use crate::commands::dataset;

/// Interval at which the store is searched for finished rooms.
const PERIOD: Duration = Duration::from_secs(1);
/// Number of rooms on a sheet.
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

    /// Stops drawing. When this returns, no picture is being written.
    pub async fn stop(self) {
        self.stop.cancel();
        // A panic in a drawing is ignored here, because the final drawing of every demo would
        // report it.
        self.task.await.ok();
    }
}

/// The caller draws the final picture after it has verified the rooms. A failure here would recur
/// there.
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
