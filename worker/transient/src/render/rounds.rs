//! The rounds of a render and their lengths.

/// The maximum number of passes of `Budget::Error`.
pub(crate) const MAX_PASSES: u32 = 1 << 16;

/// The work of a round.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Round {
    /// The number of passes.
    pub passes: u32,
    /// Whether the two-bounce part is sampled as well. Otherwise it stays unchanged.
    pub two: bool,
    /// Whether more rounds may follow.
    pub more: bool,
}

impl Round {
    /// Returns the only round of a render.
    pub fn only(passes: u32) -> Self {
        Self {
            passes,
            two: true,
            more: false,
        }
    }
}

/// New passes over a tile.
#[derive(Debug, Clone, Copy)]
pub(crate) struct TilePasses {
    /// Index of the tile.
    pub tile: usize,
    /// Weight of the new two-bounce part; 0 if there is none.
    pub two_weight: f64,
    /// Whether more rounds may follow.
    pub more: bool,
}
