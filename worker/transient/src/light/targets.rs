//! Triangles that light paths aim at from the spots, weighted by the light that the spots send to
//! them.

use picofarm_scene::Vec3;

use crate::{api::Stop, light::emitters::Emitters};

/// The maximum number of entries of the table of triangles by spot. With more, all spots share one
/// row.
const TABLE: usize = 1 << 22;

/// A triangle to aim at.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Target {
    /// Corners, render units.
    pub corners: [Vec3; 3],
    /// Unit normal.
    pub normal: Vec3,
    /// Whether both sides count.
    pub two_sided: bool,
    /// Whether it is near enough to count.
    pub counts: bool,
    /// Fraction of the arriving light scattered on.
    pub share: f32,
}

/// Probabilities of spots and triangles, as running sums.
#[derive(Debug)]
pub(crate) struct Targets {
    /// Corners and areas, render units.
    triangles: Vec<([Vec3; 3], f32)>,
    /// Running sums of the triangles' weights, one row per spot, or one row for all.
    rows: Vec<f64>,
    /// Running sums of the spots' weights.
    spots: Vec<f64>,
}

/// A point that was drawn.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Drawn {
    /// Emitter index.
    pub spot: usize,
    /// Index among the triangles.
    pub target: usize,
    /// Point on the triangle, uniformly distributed.
    pub p: Vec3,
}

/// Returns the index of the entry of running sums that contains `at` in [0, 1) of their total, and
/// the position of `at` within it in [0, 1).
fn pick(sums: &[f64], at: f64) -> Option<(usize, f64)> {
    let total = *sums.last()?;
    if !(total > 0.0 && total.is_finite()) {
        return None;
    }
    let at = at * total;
    let k = sums.partition_point(|&s| s <= at).min(sums.len() - 1);
    let before = if k == 0 { 0.0 } else { sums[k - 1] };
    let width = sums[k] - before;
    (width > 0.0).then(|| (k, ((at - before) / width).clamp(0.0, 1.0)))
}

impl Targets {
    /// Returns the probabilities of these triangles, or `None` if the render must stop.
    pub fn new(all: &[Target], emitters: &Emitters, stop: Stop) -> Option<Self> {
        let area = |[a, b, c]: [Vec3; 3]| 0.5 * (b - a).cross(c - a).length();
        let each = all.iter();
        let mut table = Self {
            triangles: each.map(|t| (t.corners, area(t.corners))).collect(),
            rows: vec![],
            spots: vec![],
        };
        table.weigh(all, emitters, stop)?;
        Some(table)
    }

    /// Fills the running sums. Returns `None` if the render must stop.
    fn weigh(&mut self, all: &[Target], emitters: &Emitters, stop: Stop) -> Option<()> {
        let apart = all.len() * emitters.list.len() <= TABLE;
        let mut spots = 0.0;
        for e in &emitters.list {
            if stop.asked() {
                return None;
            }
            // The middle of a triangle does not represent a narrow lobe.
            let wide = e.surface.diffuse() || e.surface.is_rough();
            let mut sum = 0.0;
            for (t, &([a, b, c], area)) in all.iter().zip(&self.triangles) {
                let to = (a + b + c) / 3.0 - e.p;
                let d2 = to.dot(to).max(area);
                let w = to.normalized();
                let cos = -t.normal.dot(w);
                let cos = if t.two_sided { cos.abs() } else { cos.max(0.0) };
                // Targets that are too far away to count are left to chance.
                if wide && t.counts {
                    sum += f64::from(area * cos / d2 * e.intensity(w) * t.share);
                }
                if apart {
                    self.rows.push(sum);
                }
            }
            spots += sum;
            self.spots.push(spots);
        }
        if !apart {
            let mut sum = 0.0;
            for (t, &(_, area)) in all.iter().zip(&self.triangles) {
                if t.counts {
                    sum += f64::from(area);
                }
                self.rows.push(sum);
            }
        }
        Some(())
    }

    /// Returns whether there is anything to aim at.
    pub fn any(&self) -> bool {
        self.spots.last().is_some_and(|&s| s > 0.0)
    }

    /// Returns a spot's row of running sums.
    fn row(&self, spot: usize) -> &[f64] {
        let n = self.triangles.len();
        let at = if self.rows.len() > n { spot * n } else { 0 };
        &self.rows[at..at + n]
    }

    /// Draws a spot and a triangle by `at` in [0, 1), and a point on the triangle by two more
    /// numbers.
    pub fn draw(&self, at: f64, mut uniform: impl FnMut() -> f32) -> Option<Drawn> {
        let (spot, rest) = pick(&self.spots, at)?;
        let (target, _) = pick(self.row(spot), rest)?;
        let [a, b, c] = self.triangles[target].0;
        let (r, v) = (uniform().sqrt(), uniform());
        Some(Drawn {
            spot,
            target,
            p: a * (1.0 - r) + b * (r * (1.0 - v)) + c * (r * v),
        })
    }

    /// Returns the density per area of aiming from `spot` at a point of a triangle.
    pub fn density(&self, spot: usize, target: usize) -> f32 {
        let chance = |sums: &[f64], k: usize| {
            let before = if k == 0 { 0.0 } else { sums[k - 1] };
            let total = sums[sums.len() - 1];
            if total > 0.0 {
                (sums[k] - before) / total
            } else {
                0.0
            }
        };
        let share = chance(&self.spots, spot) * chance(self.row(spot), target);
        share as f32 / self.triangles[target].1
    }
}
