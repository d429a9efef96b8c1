//! The possible orders of the entries in visibility masks.

/// An order of the masks' entries.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) enum Masks {
    /// The order in the file.
    #[default]
    AsTheyStand,
    /// Rows and columns swapped.
    Transposed,
    /// Columns, rows or both reversed.
    Turned([bool; 2]),
    /// Spots reversed.
    LastSpotFirst,
    /// Rows and columns of the square grid of spots swapped.
    SpotsTransposed,
}

impl Masks {
    /// Returns the index of the entry of a spot and a pixel (row, column), in masks of shape
    /// (spots, rows, columns).
    pub fn place(
        self,
        spot: usize,
        (row, column): (usize, usize),
        (spots, h, w): (usize, usize, usize),
    ) -> usize {
        let (spot, row, column) = match self {
            Self::AsTheyStand => (spot, row, column),
            // Only if both sides are equal.
            Self::Transposed => (spot, column, row),
            Self::Turned([x, y]) => (spot, flipped(row, h, y), flipped(column, w, x)),
            Self::LastSpotFirst => (spots - 1 - spot, row, column),
            Self::SpotsTransposed => {
                let side = spots.isqrt();
                (spot % side * side + spot / side, row, column)
            }
        };
        (spot * h + row) * w + column
    }

    /// Returns the other possible orders of masks of this shape.
    pub(super) fn others(spots: usize, h: usize, w: usize) -> Vec<(Self, &'static str)> {
        let mut all = vec![
            (Self::Turned([true, false]), "columns from right to left"),
            (Self::Turned([false, true]), "rows from bottom to top"),
            (
                Self::Turned([true, true]),
                "rows and columns from their other ends",
            ),
        ];
        if h == w {
            all.push((Self::Transposed, "rows and columns exchanged"));
        }
        if spots > 1 {
            all.push((Self::LastSpotFirst, "the last spot first"));
        }
        if spots > 1 && spots.isqrt().pow(2) == spots {
            all.push((Self::SpotsTransposed, "the spots' grid by columns"));
        }
        all
    }
}

/// Returns the position counted from the other end if `flip` is set.
pub(super) fn flipped(at: usize, size: usize, flip: bool) -> usize {
    if flip { size - 1 - at } else { at }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_order_is_a_permutation() {
        for (spots, h, w) in [(4, 3, 3), (9, 2, 5), (1, 1, 1)] {
            for (masks, words) in Masks::others(spots, h, w) {
                let mut seen = vec![false; spots * h * w];
                for spot in 0..spots {
                    for at in 0..h * w {
                        seen[masks.place(spot, (at / w, at % w), (spots, h, w))] = true;
                    }
                }
                assert!(seen.into_iter().all(|s| s), "{words}");
            }
        }
    }
}
