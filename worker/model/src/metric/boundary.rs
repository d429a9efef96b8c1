//! The boundary F1 of depth (Depth Pro, section 3.3), which the code released with Shoot-Bounce-3D
//! reports. It measures whether edges of the true depth are edges of the estimate, regardless of
//! its scale.

/// The ratios of neighbouring depths above which there is an edge: ten, evenly from 1.05 to 1.25.
/// Each is weighted by its size.
const FROM: f64 = 1.05;
const TO: f64 = 1.25;
const STEPS: usize = 10;

/// The lower bound of depths, in units of a network's output: 1e-6 m over 4.5 m.
const NEAREST: f32 = 1e-6 / 4.5;

/// Returns the boundary F1 of an image, 0 to 1. Depths have any unit, `[row][column]`.
pub(super) fn boundary_f1(said: &[f32], truth: &[f32], width: usize) -> f64 {
    let mut weights = 0.0;
    let mut sum = 0.0;
    for k in 0..STEPS {
        let ratio = FROM + (TO - FROM) * k as f64 / (STEPS - 1) as f64;
        weights += ratio;
        sum += ratio * f1(said, truth, width, ratio as f32);
    }
    sum / weights
}

/// Returns F1 at one ratio. Precision and recall are averages over the four directions in which a
/// neighbour is farther away.
fn f1(said: &[f32], truth: &[f32], width: usize, ratio: f32) -> f64 {
    let edge =
        |z: &[f32], near: usize, far: usize| z[far].max(NEAREST) / z[near].max(NEAREST) > ratio;
    // For each direction, the number of edges in both images, in the estimate, and in the truth.
    let mut counts = [[0u64; 3]; 4];
    let mut compare = |direction: usize, near: usize, far: usize| {
        let (a, b) = (edge(said, near, far), edge(truth, near, far));
        let found = [a && b, a, b].map(u64::from);
        for (count, found) in counts[direction].iter_mut().zip(found) {
            *count += found;
        }
    };
    for i in 0..said.len() {
        if i % width + 1 < width {
            compare(0, i, i + 1);
            compare(1, i + 1, i);
        }
        if i + width < said.len() {
            compare(2, i, i + width);
            compare(3, i + width, i);
        }
    }
    let mean = |of: usize| {
        let each = counts.iter().map(|c| c[0] as f64 / c[of].max(1) as f64);
        each.sum::<f64>() / 4.0
    };
    let (precision, recall) = (mean(1), mean(2));
    match precision + recall {
        0.0 => 0.0,
        both => 2.0 * precision * recall / both,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns an image of a 1 m distant square in front of a 2 m distant wall, from column and row
    /// `from`.
    fn image(from: usize) -> Vec<f32> {
        let inside = |x: usize| (from..from + 4).contains(&x);
        (0..144)
            .map(|i| match inside(i % 12) && inside(i / 12) {
                true => 1.0,
                false => 2.0,
            })
            .collect()
    }

    #[test]
    fn the_truth_at_any_scale_has_all_edges_and_a_plane_none() {
        let truth = image(3);
        let scaled: Vec<f32> = truth.iter().map(|z| 0.3 * z).collect();
        assert_eq!(boundary_f1(&truth, &truth, 12), 1.0);
        assert_eq!(boundary_f1(&scaled, &truth, 12), 1.0);
        assert_eq!(boundary_f1(&[1.0; 144], &truth, 12), 0.0);
        assert_eq!(boundary_f1(&[0.0; 144], &truth, 12), 0.0);
    }

    #[test]
    fn edges_elsewhere_are_no_edges_and_those_in_part_count_in_part() {
        let truth = image(3);
        assert_eq!(boundary_f1(&image(5), &truth, 12), 0.0);
        // The image is shifted right by one pixel: of the upper edge's four pixels three are the
        // truth's, of the sides none.
        let mut moved = truth.clone();
        for row in moved.chunks_mut(12) {
            row.rotate_right(1);
        }
        let half = boundary_f1(&moved, &truth, 12);
        assert!((half - 0.375).abs() < 1e-12, "{half}");
        // An edge of ratio 1.1 exceeds only the lowest three of the ten thresholds: 1.05, 1.0722
        // and 1.0944.
        let faint: Vec<f32> = truth
            .iter()
            .map(|z| if *z > 1.5 { 1.1 } else { 1.0 })
            .collect();
        let each: Vec<f64> = (0..10).map(|k| 1.05 + 0.2 * f64::from(k) / 9.0).collect();
        let expected = each[..3].iter().sum::<f64>() / each.iter().sum::<f64>();
        assert!((boundary_f1(&faint, &truth, 12) - expected).abs() < 1e-12);
    }
}
