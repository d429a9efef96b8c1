//! The rounds of a render and their lengths.

/// The maximum number of passes of [`Budget::Error`].
pub(crate) const MAX_PASSES: u32 = 1 << 16;

/// Passes of the first round of [`Budget::Error`], the fewest that give an error estimate. With 4
/// passes, large images of many spots ended at 6.8 to 8.6 % with a target of 10 %.
pub(crate) const FIRST_PASSES: u32 = 2;

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

/// Passes of light paths if no other passes are made.
pub(crate) const TWO_PASSES: u32 = 64;
