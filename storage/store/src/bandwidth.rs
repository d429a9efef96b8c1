//! Bandwidth limits of a process for all its object stores together.

use std::sync::OnceLock;

/// Limits in bytes per second; `None` is unlimited.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Bandwidth {
    /// Limit of uploads to stores.
    pub upload: Option<f64>,
    /// Limit of downloads from stores.
    pub download: Option<f64>,
}

static BANDWIDTH: OnceLock<Bandwidth> = OnceLock::new();

/// Sets the limits of this process for stores opened from now on. The limits apply on average,
/// because a request that has started runs at full speed. Local folders have no limit. Only the
/// first call has an effect.
pub fn limit_bandwidth(bandwidth: Bandwidth) {
    BANDWIDTH.get_or_init(|| bandwidth);
}

/// Returns the limits that were set.
#[cfg(feature = "clouds")]
pub(super) fn bandwidth() -> Bandwidth {
    BANDWIDTH.get().copied().unwrap_or_default()
}
