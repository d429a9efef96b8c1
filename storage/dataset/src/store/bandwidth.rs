//! Limits on what a process sends to object stores and fetches from them, all its stores together.

use std::sync::OnceLock;

/// Bytes a second each way; `None`: as fast as the line is.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Bandwidth {
    /// To stores.
    pub upload: Option<f64>,
    /// From stores.
    pub download: Option<f64>,
}

static BANDWIDTH: OnceLock<Bandwidth> = OnceLock::new();

/// Sets the limits of this process for stores opened from now on; they hold on average, since a request that may start
/// runs as fast as the line is. Local folders have no limit. The first call counts.
pub fn limit_bandwidth(bandwidth: Bandwidth) {
    BANDWIDTH.get_or_init(|| bandwidth);
}

/// What was set.
#[cfg(feature = "clouds")]
pub(super) fn bandwidth() -> Bandwidth {
    BANDWIDTH.get().copied().unwrap_or_default()
}
