//! Small vectors, medians and linear systems in double precision.

/// A point or direction in the camera's frame, metres.
pub(crate) type V3 = [f64; 3];

pub(crate) fn sub(a: V3, b: V3) -> V3 {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

/// a + b·s.
pub(crate) fn along(a: V3, b: V3, s: f64) -> V3 {
    [a[0] + b[0] * s, a[1] + b[1] * s, a[2] + b[2] * s]
}

pub(crate) fn dot(a: V3, b: V3) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

pub(crate) fn length(a: V3) -> f64 {
    dot(a, a).sqrt()
}

pub(crate) fn unit(a: V3) -> V3 {
    let long = length(a).max(1e-300);
    [a[0] / long, a[1] / long, a[2] / long]
}

/// Returns the middle value; `None` of no values. Reorders the values.
pub(crate) fn median(values: &mut [f64]) -> Option<f64> {
    quantile(values, 0.5)
}

/// Returns the value below which the share `q` of the values is; `None` of no values.
pub(crate) fn quantile(values: &mut [f64], q: f64) -> Option<f64> {
    if values.is_empty() {
        return None;
    }
    let n = ((values.len() - 1) as f64 * q).round() as usize;
    Some(*values.select_nth_unstable_by(n, f64::total_cmp).1)
}

/// Returns the inverse of a symmetric positive matrix `[row][column]` by Gauss-Jordan elimination;
/// `None` if it is singular to working precision.
pub(crate) fn inverse(matrix: &[Vec<f64>]) -> Option<Vec<Vec<f64>>> {
    let n = matrix.len();
    // A unit diagonal makes pivots comparable.
    let scale: Vec<f64> = (0..n).map(|k| 1.0 / matrix[k][k].sqrt()).collect();
    if scale.iter().any(|s| !s.is_finite()) {
        return None;
    }
    let mut a: Vec<Vec<f64>> = (0..n)
        .map(|i| {
            let own = (0..n).map(|j| matrix[i][j] * scale[i] * scale[j]);
            own.chain((0..n).map(|j| f64::from(u8::from(i == j))))
                .collect()
        })
        .collect();
    for k in 0..n {
        let p = (k..n).max_by(|i, j| a[*i][k].abs().total_cmp(&a[*j][k].abs()))?;
        if a[p][k].abs() < 1e-12 {
            return None;
        }
        a.swap(k, p);
        let own = 1.0 / a[k][k];
        a[k].iter_mut().for_each(|x| *x *= own);
        let row = a[k].clone();
        for (i, other) in a.iter_mut().enumerate() {
            if i != k {
                let factor = other[k];
                other
                    .iter_mut()
                    .zip(&row)
                    .for_each(|(x, r)| *x -= factor * r);
            }
        }
    }
    Some(
        (0..n)
            .map(|i| (0..n).map(|j| a[i][n + j] * scale[i] * scale[j]).collect())
            .collect(),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_inverse_times_its_matrix_is_the_identity() {
        let m = vec![
            vec![4.0, 1.0, 0.5],
            vec![1.0, 3e6, 2.0],
            vec![0.5, 2.0, 1e-3],
        ];
        let inverse = inverse(&m).expect("a regular matrix");
        let column = |j: usize| inverse.iter().map(move |row| row[j]);
        for (i, row) in m.iter().enumerate() {
            for j in 0..row.len() {
                let sum: f64 = row.iter().zip(column(j)).map(|(a, b)| a * b).sum();
                let off = (sum - f64::from(u8::from(i == j))).abs();
                assert!(off < 1e-6, "{i} {j}: {sum}");
            }
        }
        assert!(super::inverse(&[vec![1.0, 1.0], vec![1.0, 1.0]]).is_none());
    }

    #[test]
    fn a_median_is_the_middle_value() {
        assert_eq!(median(&mut [3.0, 1.0, 2.0]), Some(2.0));
        assert_eq!(median(&mut []), None);
    }
}
