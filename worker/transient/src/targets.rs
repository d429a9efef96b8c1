//! Triangles that light paths aim at from the spots, by what the spots send to them.

use picofarm_scene::Vec3;

use crate::{api::Stop, emitter::Emitters};

/// Entries of the table of triangles by spot; beyond that all spots share one row.
const TABLE: usize = 1 << 22;

/// A triangle to aim at.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Target {
    /// Render units.
    pub corners: [Vec3; 3],
    /// Unit normal.
    pub normal: Vec3,
    /// Both sides count.
    pub two_sided: bool,
    /// Near enough to count.
    pub counts: bool,
    /// Share of the light that arrives there which goes on.
    pub share: f32,
}

/// Chances of spots and triangles, as running sums.
#[derive(Debug)]
pub(crate) struct Targets {
    /// Corners and areas, render units.
    triangles: Vec<([Vec3; 3], f32)>,
    /// Running sums of the triangles' weights, one row a spot, or one row for all.
    rows: Vec<f64>,
    /// Running sums of the spots' weights.
    spots: Vec<f64>,
}

/// A point that was drawn.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Drawn {
    /// Emitter.
    pub spot: usize,
    /// Index among the triangles.
    pub target: usize,
    /// On the triangle, uniform.
    pub p: Vec3,
}

/// Index of the entry of running sums in which `at` in [0, 1) of their total falls, and the rest of `at`
/// within it in [0, 1).
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
    /// The chances of these triangles; `None` where the render shall stop.
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

    /// Fills the running sums; `None` where the render shall stop.
    fn weigh(&mut self, all: &[Target], emitters: &Emitters, stop: Stop) -> Option<()> {
        let apart = all.len() * emitters.list.len() <= TABLE;
        let mut spots = 0.0;
        for e in &emitters.list {
            if stop.asked() {
                return None;
            }
            // A narrow lobe is not to be judged by the middle of a triangle.
            let wide = e.surface.diffuse() || e.surface.is_rough();
            let mut sum = 0.0;
            for (t, &([a, b, c], area)) in all.iter().zip(&self.triangles) {
                let to = (a + b + c) / 3.0 - e.p;
                let d2 = to.dot(to).max(area);
                let w = to.normalized();
                let cos = -t.normal.dot(w);
                let cos = if t.two_sided { cos.abs() } else { cos.max(0.0) };
                // What is too far away to count is left to chance.
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

    /// Whether there is anything to aim at.
    pub fn any(&self) -> bool {
        self.spots.last().is_some_and(|&s| s > 0.0)
    }

    /// A spot's row of running sums.
    fn row(&self, spot: usize) -> &[f64] {
        let n = self.triangles.len();
        let at = if self.rows.len() > n { spot * n } else { 0 };
        &self.rows[at..at + n]
    }

    /// Draws a spot and a triangle by `at` in [0, 1), and a point of it by two more numbers.
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

    /// Density per area of aiming from `spot` at a point of a triangle.
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
