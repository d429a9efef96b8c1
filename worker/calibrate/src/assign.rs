//! The assignment problem: which row belongs to which column at the least total cost.

/// Returns the column of each row of a square matrix of finite costs such that the sum of costs is
/// least: the Hungarian method with potentials, O(n³). Of equal sums the first in order of columns
/// is taken.
///
/// # Examples
/// ```
/// use picofarm_calibrate::assign;
///
/// let costs = [vec![4.0, 1.0], vec![2.0, 3.0]];
/// assert_eq!(assign(&costs), [1, 0]);
/// ```
///
/// # Panics
/// If the matrix is not square.
pub fn assign(costs: &[Vec<f64>]) -> Vec<usize> {
    let n = costs.len();
    assert!(costs.iter().all(|row| row.len() == n), "a square matrix");
    // Rows and columns count from 1; 0 is the free column.
    let (mut row_price, mut price) = (vec![0.0; n + 1], vec![0.0; n + 1]);
    let (mut row_of, mut from) = (vec![0; n + 1], vec![0; n + 1]);
    for row in 1..=n {
        row_of[0] = row;
        let mut column = 0;
        let (mut least, mut done) = (vec![f64::INFINITY; n + 1], vec![false; n + 1]);
        while row_of[column] != 0 {
            done[column] = true;
            let own = row_of[column];
            let (mut step, mut next) = (f64::INFINITY, 0);
            for j in 1..=n {
                if done[j] {
                    continue;
                }
                let cost = costs[own - 1][j - 1] - row_price[own] - price[j];
                if cost < least[j] {
                    (least[j], from[j]) = (cost, column);
                }
                if least[j] < step {
                    (step, next) = (least[j], j);
                }
            }
            for j in 0..=n {
                if done[j] {
                    row_price[row_of[j]] += step;
                    price[j] -= step;
                } else {
                    least[j] -= step;
                }
            }
            column = next;
        }
        while column != 0 {
            row_of[column] = row_of[from[column]];
            column = from[column];
        }
    }
    let mut columns = vec![0; n];
    for j in 1..=n {
        columns[row_of[j] - 1] = j - 1;
    }
    columns
}

#[cfg(test)]
mod tests {
    use super::assign;

    #[test]
    fn no_other_order_costs_less() {
        let mut seed = 7u64;
        for _ in 0..200 {
            let mut number = || {
                seed = seed.wrapping_mul(6364136223846793005).wrapping_add(1);
                (seed >> 40) as f64 / f64::from(1 << 24)
            };
            let costs: Vec<Vec<f64>> = (0..5).map(|_| (0..5).map(|_| number()).collect()).collect();
            let sum = |order: &[usize]| -> f64 {
                order.iter().enumerate().map(|(i, j)| costs[i][*j]).sum()
            };
            let best = sum(&assign(&costs));
            let mut order = [0, 1, 2, 3, 4];
            visit(&mut order, 0, &mut |order| {
                assert!(best <= sum(order) + 1e-12)
            });
        }
    }

    fn visit(order: &mut [usize; 5], from: usize, see: &mut dyn FnMut(&[usize])) {
        if from == 5 {
            return see(order);
        }
        for k in from..5 {
            order.swap(from, k);
            visit(order, from + 1, see);
            order.swap(from, k);
        }
    }
}
