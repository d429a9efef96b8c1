//! Poisson counts of small rates from tables.
//!
//! The sum of independent Poisson counts is a Poisson count of the summed rates. So a rate is split
//! into a multiple of 64, a multiple of 4 below 64, a multiple of 1/16 below 4, and a rest below
//! 1/16. The first three have tables (the alias method; A. J. Walker, "An efficient method for
//! generating discrete random variables with general distributions", ACM TOMS 3, 1977; tables as M.
//! D. Vose, "A linear algorithm for generating random numbers with a given distribution", IEEE TSE
//! 17, 1991), and the count of the rest is almost always 0. Most bins need no exponential, no
//! logarithm and no loop.

use std::sync::LazyLock;

/// Rates below this value are covered by tables.
pub(crate) const TABLED: f64 = 1024.0;
/// Steps of the fine, the coarse and the wide tables: 1/16, 4 and 64 photons.
const PARTS: usize = 16;
const COARSE: usize = 4;
const WIDE: usize = 64;
/// Columns of a table: enough for all counts with a probability of 10⁻¹⁶ or more.
const FINE_COLUMNS: usize = 32;
const COARSE_COLUMNS: usize = 128;
const WIDE_COLUMNS: usize = 1024;

/// Counts of one rate, one column each. The upper bits of a column are the probability that it
/// keeps its own count, and the lower bits are the index of its alternative column.
#[derive(Debug, Clone)]
struct Table<const COLUMNS: usize> {
    first: u64,
    columns: [u64; COLUMNS],
}

impl<const COLUMNS: usize> Table<COLUMNS> {
    fn new(rate: f64) -> Self {
        let (first, chances) = chances::<COLUMNS>(rate);
        let mut columns = [0; COLUMNS];
        // Each column has room for the average probability. The excess of larger ones fills the
        // columns with room left.
        let mut share = chances.map(|p| p * COLUMNS as f64);
        let (mut small, mut large): (Vec<usize>, Vec<usize>) =
            (0..COLUMNS).partition(|k| share[*k] < 1.0);
        while let Some(low) = small.pop() {
            // A column left over by rounding is a whole one, to within 2⁻⁴⁰.
            let Some(high) = large.last().copied() else {
                columns[low] = Self::pack(1.0, low);
                continue;
            };
            columns[low] = Self::pack(share[low], high);
            share[high] -= 1.0 - share[low];
            if share[high] < 1.0 {
                large.pop();
                small.push(high);
            }
        }
        for k in large {
            columns[k] = Self::pack(1.0, k);
        }
        Self { first, columns }
    }

    /// Returns the count for 64 uniform bits.
    #[inline(always)]
    fn count(&self, bits: u64) -> u64 {
        let column = (bits >> (64 - COLUMNS.ilog2())) as usize;
        let rest = bits << COLUMNS.ilog2();
        let entry = self.columns[column];
        // Branchless, because the branch would be unpredictable.
        let keeps = u64::from(rest < entry).wrapping_neg();
        let other = entry & Self::OTHER;
        self.first + (other ^ ((other ^ column as u64) & keeps))
    }

    /// The bits of the index of another column.
    const OTHER: u64 = COLUMNS as u64 - 1;

    fn pack(share: f64, other: usize) -> u64 {
        // The cast saturates.
        ((share * 18_446_744_073_709_551_616.0) as u64 & !Self::OTHER) | other as u64
    }
}

/// Returns the first count and the probabilities of `COLUMNS` consecutive counts from there, which
/// include the most likely ones. Their sum is 1.
fn chances<const COLUMNS: usize>(rate: f64) -> (u64, [f64; COLUMNS]) {
    let mut chances = [0.0; COLUMNS];
    if rate <= 0.0 {
        chances[0] = 1.0;
        return (0, chances);
    }
    // Computed from the most likely count outwards, so that products underflow only for negligible
    // probabilities.
    let mode = rate as usize;
    let first = mode.saturating_sub(COLUMNS * 2 / 5);
    chances[mode - first] = 1.0;
    for k in mode + 1..first + COLUMNS {
        chances[k - first] = chances[k - 1 - first] * rate / k as f64;
    }
    for k in (first..mode).rev() {
        chances[k - first] = chances[k + 1 - first] * (k + 1) as f64 / rate;
    }
    let total: f64 = chances.iter().sum();
    (first as u64, chances.map(|p| p / total))
}

/// All tables: 160 KiB. Bins below 64 photons use 32 KiB of them.
struct Tables {
    fine: Vec<Table<FINE_COLUMNS>>,
    coarse: Vec<Table<COARSE_COLUMNS>>,
    wide: Vec<Table<WIDE_COLUMNS>>,
}

static TABLES: LazyLock<Tables> = LazyLock::new(|| Tables {
    fine: (0..COARSE * PARTS)
        .map(|i| Table::new(i as f64 / PARTS as f64))
        .collect(),
    coarse: (0..WIDE / COARSE)
        .map(|i| Table::new((i * COARSE) as f64))
        .collect(),
    wide: (0..TABLED as usize / WIDE)
        .map(|i| Table::new((i * WIDE) as f64))
        .collect(),
});

/// A rate below [`TABLED`], split into parts.
pub(crate) struct SplitRate {
    wide: usize,
    coarse: usize,
    fine: usize,
    /// The part that no table covers: at least 0, below 1/16.
    pub rest: f64,
}

impl SplitRate {
    /// Splits a rate of at least 0 and below [`TABLED`].
    #[inline(always)]
    pub fn new(rate: f64) -> Self {
        let parts = (rate * PARTS as f64) as usize;
        let whole = parts / PARTS;
        Self {
            wide: whole / WIDE,
            coarse: whole % WIDE / COARSE,
            fine: parts % (COARSE * PARTS),
            // Exact: both have the same exponent, or the second is 0.
            rest: rate - parts as f64 * (1.0 / PARTS as f64),
        }
    }

    /// Draws a count of the part that tables cover. `bits` returns 64 uniform bits at each call.
    #[inline(always)]
    pub fn count(&self, mut bits: impl FnMut() -> u64) -> u64 {
        let tables = &*TABLES;
        let mut count = 0;
        if self.wide > 0 {
            count += tables.wide[self.wide].count(bits());
        }
        if self.coarse > 0 {
            count += tables.coarse[self.coarse].count(bits());
        }
        if self.fine > 0 {
            count += tables.fine[self.fine].count(bits());
        }
        count
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns the probability of each count that a table yields, from its columns.
    fn given<const COLUMNS: usize>(table: &Table<COLUMNS>) -> Vec<f64> {
        let mut chances = vec![0.0; table.first as usize + COLUMNS];
        for (k, entry) in table.columns.iter().enumerate() {
            let keeps = *entry as f64 / 18_446_744_073_709_551_616.0;
            let first = table.first as usize;
            chances[first + k] += keeps / COLUMNS as f64;
            chances[first + (entry & Table::<COLUMNS>::OTHER) as usize] +=
                (1.0 - keeps) / COLUMNS as f64;
        }
        chances
    }

    fn is_poisson<const COLUMNS: usize>(table: &Table<COLUMNS>, rate: f64) {
        let chances = given(table);
        let mut sum = 0.0;
        for (k, chance) in chances.iter().enumerate() {
            let count = k as f64;
            let exact = match rate > 0.0 {
                true => libm::exp(count * libm::log(rate) - rate - libm::lgamma(count + 1.0)),
                false => f64::from(k == 0),
            };
            sum += exact;
            assert!(
                (chance - exact).abs() < 1e-15 * (1.0 + rate),
                "rate {rate}, count {k}: {chance} for {exact}"
            );
        }
        assert!((sum - 1.0).abs() < 1e-11, "rate {rate}: {sum} in the table");
    }

    #[test]
    fn every_table_holds_the_exact_probabilities() {
        for (i, table) in TABLES.fine.iter().enumerate() {
            is_poisson(table, i as f64 / 16.0);
        }
        for (i, table) in TABLES.coarse.iter().enumerate() {
            is_poisson(table, i as f64 * 4.0);
        }
        for (i, table) in TABLES.wide.iter().enumerate() {
            is_poisson(table, i as f64 * 64.0);
        }
    }

    #[test]
    fn a_rate_is_the_sum_of_its_parts() {
        for rate in [
            0.0,
            1e-300,
            0.06249,
            0.0625,
            3.999_999,
            4.0,
            17.3,
            63.99,
            64.0,
            777.7,
            TABLED - 1e-12,
        ] {
            let cut = SplitRate::new(rate);
            assert!((0.0..0.0625).contains(&cut.rest), "{rate}");
            let tabled = (cut.wide * 64 + cut.coarse * 4) as f64 + cut.fine as f64 / 16.0;
            let sum = tabled + cut.rest;
            assert_eq!(sum, rate);
        }
    }
}
