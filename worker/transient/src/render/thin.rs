//! The fraction of a pass to make.

use crate::render::region::Region;

/// The fraction of a pass to make.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Thin<'a> {
    /// One light path in this many is traced.
    pub of: u32,
    /// The regions that camera paths are restricted to; an empty list means the whole image.
    pub regions: &'a [Region],
}

impl Thin<'_> {
    pub const WHOLE: Thin<'static> = Thin {
        of: 1,
        regions: &[],
    };

    pub fn share(&self) -> f64 {
        1.0 / f64::from(self.of)
    }

    pub fn holds(&self, (row, col): (u32, u32)) -> bool {
        let within = |r: &Region| {
            (r.row..r.row + r.rows).contains(&row) && (r.col..r.col + r.cols).contains(&col)
        };
        self.regions.is_empty() || self.regions.iter().any(within)
    }
}
