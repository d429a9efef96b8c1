//! The fraction of a pass to make.

use crate::film::region::Region;

/// The fraction of a pass to make.
#[derive(Debug, Clone, Copy)]
pub(crate) struct PassFraction<'a> {
    /// One light path in this many is traced.
    pub one_in: u32,
    /// The regions that camera paths are restricted to; an empty list means the whole image.
    pub regions: &'a [Region],
}

impl PassFraction<'_> {
    pub const WHOLE: PassFraction<'static> = PassFraction {
        one_in: 1,
        regions: &[],
    };

    pub fn share(&self) -> f64 {
        1.0 / f64::from(self.one_in)
    }

    pub fn holds(&self, (row, col): (u32, u32)) -> bool {
        let within = |r: &Region| {
            (r.row..r.row + r.rows).contains(&row) && (r.col..r.col + r.cols).contains(&col)
        };
        self.regions.is_empty() || self.regions.iter().any(within)
    }
}
