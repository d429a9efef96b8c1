//! The samples of a ray: stratified positions for the coarse network, then more of them where it
//! has matter (NeRF, section 5.2). Positions are functions of the ray's end, z = base + far ·
//! slope, so that gradients reach the end of a light path through the stratified positions.
//! Positions by importance are fixed numbers.

/// A constant added to weights before they are normalised to a distribution.
const FLOOR: f32 = 1e-5;

/// Positions along rays, row by row: z = base + far · slope, metres.
#[derive(Debug, Clone, PartialEq)]
pub struct Places {
    /// The number of rays.
    pub rays: usize,
    /// The number of positions of a ray.
    pub count: usize,
    /// The part that does not depend on the ray's end.
    pub base: Vec<f32>,
    /// The factor of the ray's end.
    pub slope: Vec<f32>,
}

/// Random numbers in [0, 1) for some rays: the offset of each stratified position in its interval,
/// and the quantile of each further one. Empty = the even choice, which evaluation uses.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Draws {
    /// (rays, coarse).
    pub jitter: Vec<f32>,
    /// (rays, fine).
    pub share: Vec<f32>,
}

impl Places {
    /// Returns `count` positions between `near` and the end: even, or one in each interval between
    /// the middles of the even ones.
    pub fn stratified(rays: usize, count: usize, near: f32, jitter: &[f32]) -> Self {
        let even = |i: usize| i as f32 / (count - 1) as f32;
        let place = |k: usize| {
            let i = k % count;
            let Some(u) = jitter.get(k) else {
                return even(i);
            };
            let lower = 0.5 * (even(i.max(1) - 1) + even(i.max(1)));
            let upper = 0.5 * (even(i) + even((i + 1).min(count - 1)));
            let lower = if i == 0 { 0.0 } else { lower };
            lower + (upper - lower) * u
        };
        let slope: Vec<f32> = (0..rays * count).map(place).collect();
        let base = slope.iter().map(|s| near * (1.0 - s)).collect();
        Self {
            rays,
            count,
            base,
            slope,
        }
    }

    /// Returns the positions for given ends.
    pub fn at(&self, far: &[f32]) -> Vec<f32> {
        let end = |k: usize| far[k / self.count];
        let each = self.base.iter().zip(&self.slope).enumerate();
        each.map(|(k, (b, s))| b + end(k) * s).collect()
    }

    /// Returns these positions and `count` more a ray by the coarse weights, sorted. `weights` has
    /// one number a position.
    pub fn refined(&self, far: &[f32], weights: &[f32], count: usize, share: &[f32]) -> Self {
        let z = self.at(far);
        let both = self.count + count;
        let mut out = Self {
            rays: self.rays,
            count: both,
            base: Vec::with_capacity(self.rays * both),
            slope: Vec::with_capacity(self.rays * both),
        };
        let even: Vec<f32> = (0..count)
            .map(|i| i as f32 / (count.max(2) - 1) as f32)
            .collect();
        for ray in 0..self.rays {
            let of = ray * self.count..(ray + 1) * self.count;
            let share = match share.is_empty() {
                true => &even,
                false => &share[ray * count..(ray + 1) * count],
            };
            let (base, slope) = (&self.base[of.clone()], &self.slope[of.clone()]);
            let mut all: Vec<(f32, f32, f32)> = (0..self.count)
                .map(|i| (z[of.start + i], base[i], slope[i]))
                .collect();
            let found = by_importance(&z[of.clone()], &weights[of], share);
            all.extend(found.into_iter().map(|z| (z, z, 0.0)));
            all.sort_by(|a, b| a.0.total_cmp(&b.0));
            out.base.extend(all.iter().map(|p| p.1));
            out.slope.extend(all.iter().map(|p| p.2));
        }
        out
    }
}

/// Returns positions distributed by the weights: the inverse of a distribution with even density
/// between the middles of neighbouring positions. The first and the last weight are not used.
fn by_importance(z: &[f32], weights: &[f32], share: &[f32]) -> Vec<f32> {
    let middles: Vec<f32> = z.windows(2).map(|w| 0.5 * (w[0] + w[1])).collect();
    let inner = &weights[1..weights.len() - 1];
    let total: f32 = inner.iter().map(|w| w + FLOOR).sum();
    let mut sums = vec![0.0f32];
    let mut sum = 0.0f32;
    for w in inner {
        sum += (w + FLOOR) / total;
        sums.push(sum);
    }
    let last = sums.len() - 1;
    let place = |&u: &f32| {
        let above = sums.partition_point(|s| *s <= u);
        let (below, above) = (above.max(1) - 1, above.min(last));
        let width = sums[above] - sums[below];
        let width = if width < FLOOR { 1.0 } else { width };
        let t = (u - sums[below]) / width;
        middles[below] + t * (middles[above] - middles[below])
    };
    share.iter().map(place).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stratified_places_lie_in_their_intervals_and_reach_both_ends() {
        let even = Places::stratified(1, 5, 0.1, &[]).at(&[6.1]);
        for (z, want) in even.iter().zip([0.1, 1.6, 3.1, 4.6, 6.1]) {
            assert!((z - want).abs() < 1e-6, "{even:?}");
        }
        let low = Places::stratified(1, 5, 0.1, &[0.0; 5]).at(&[6.1]);
        for (z, want) in low.iter().zip([0.1, 0.85, 2.35, 3.85, 5.35]) {
            assert!((z - want).abs() < 1e-5, "{low:?}");
        }
    }

    #[test]
    fn further_places_gather_where_the_weight_is() {
        let places = Places::stratified(1, 64, 0.1, &[]);
        let mut weights = vec![0.0; 64];
        weights[32] = 1.0;
        let refined = places.refined(&[6.0], &weights, 128, &[]);
        let z = refined.at(&[6.0]);
        assert!(z.is_sorted());
        let peak = places.at(&[6.0])[32];
        let near = z.iter().filter(|z| (*z - peak).abs() < 0.06).count();
        assert!(near > 120, "{near}");
        assert_eq!(refined.slope.iter().filter(|s| **s == 0.0).count(), 128 + 1);
    }
}
