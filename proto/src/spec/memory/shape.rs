//! The size of scenes, and the base memory of every task.

/// The program with its threads, its furniture data, and a scene of some ten thousand triangles.
pub(super) const PROGRAM: f64 = 70e6;
/// Memory of a store's requests and of coding small arrays, in addition to histograms, including
/// memory that the allocator keeps for reuse.
pub(super) const STORE: f64 = 60e6;
/// Base memory of every task.
pub(in crate::spec) const BASE: f64 = PROGRAM + STORE;
/// Bytes of a histogram's bin in memory.
pub(super) const BIN: f64 = 4.0;
/// Bytes of a pixel for the ground truth, the view of its centre, and error sums.
const TRUTH: f64 = 260.0;

/// Planes of evidence of a spot, a byte each.
pub const EVIDENCE_PLANES: u32 = 45;

/// The size of scenes that a task reads or makes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Shape {
    /// Rows of pixels.
    pub height: u32,
    /// Columns of pixels.
    pub width: u32,
    /// Bins of a histogram.
    pub bins: u32,
    /// Laser spots.
    pub spots: u32,
}

impl Shape {
    pub(in crate::spec) fn pixels(&self) -> f64 {
        f64::from(self.height) * f64::from(self.width)
    }

    /// Returns the bytes of one histogram of every pixel.
    pub(in crate::spec) fn histogram(&self) -> f64 {
        BIN * self.pixels() * f64::from(self.bins)
    }

    /// Returns the bytes of the evidence of all pairs of pixel and spot.
    pub(in crate::spec) fn evidence(&self) -> f64 {
        f64::from(EVIDENCE_PLANES) * self.pixels() * f64::from(self.spots)
    }

    /// Returns the bytes stored for all pixels in addition to histograms.
    pub(in crate::spec) fn truth(&self) -> f64 {
        self.pixels() * (TRUTH + f64::from(self.spots))
    }

    /// Returns the bytes of two scenes as networks use them: the histogram as read, and as stored.
    pub(in crate::spec) fn two(&self) -> f64 {
        self.truth() + 2.0 * self.histogram()
    }
}

/// Formats bytes: "41.3 GiB".
pub fn gib(bytes: u64) -> String {
    let gib = bytes as f64 / (1u64 << 30) as f64;
    match gib {
        0.0..0.1 => format!("{:.0} MiB", gib * 1024.0),
        _ => format!("{gib:.1} GiB"),
    }
}
