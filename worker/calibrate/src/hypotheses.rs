//! Faults that are not small: a mirrored image, spots in another order, another unit of time. Each
//! is tried, and the one that explains the times is taken.

use serde::{Deserialize, Serialize};

use crate::{
    assign::assign,
    fit::{Fitted, Free, Observed},
    model::Model,
};

/// Pixels that take part in a trial.
const PIXELS: usize = 400;
/// A hypothesis must explain this factor of times more than the stated calibration, and this share.
const BETTER: (f64, f64) = (1.2, 0.03);
/// Or this share more if it brings returns to a share of their distance, by at least some pixels.
const NEARER: (f64, f64, f64) = (0.015, 0.5, 1.0);
/// Share of times that a further fault must explain.
const SIMPLER: f64 = 0.015;
/// Factors of time, and their usual reasons.
pub(crate) const SCALES: [(f64, &str); 5] = [
    (1.0, ""),
    (2.0, "one way instead of there and back"),
    (0.5, "there and back instead of one way"),
    (
        0.299_792_458,
        "a tenth of nanoseconds times 3 taken for metres",
    ),
    (
        3.335_640_952,
        "nanoseconds taken for metres, or the reverse",
    ),
];

/// How the stored image is turned.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Turn {
    /// Columns run from right to left.
    pub mirrored_x: bool,
    /// Rows run from bottom to top.
    pub mirrored_y: bool,
    /// Rows and columns are exchanged; applied after the mirrors.
    pub transposed: bool,
}

impl Turn {
    /// The pixel to which the stored pixel `p` belongs.
    pub fn pixel(self, p: usize, width: usize, height: usize) -> usize {
        let (mut u, mut v) = (p % width, p / width);
        if self.mirrored_x {
            u = width - 1 - u;
        }
        if self.mirrored_y {
            v = height - 1 - v;
        }
        if self.transposed {
            (u, v) = (v, u);
        }
        v * width + u
    }

    fn all(square: bool) -> Vec<Self> {
        let mut all = Vec::new();
        for transposed in [false, true] {
            for (mirrored_x, mirrored_y) in
                [(false, false), (true, false), (false, true), (true, true)]
            {
                if square || !transposed {
                    all.push(Self {
                        mirrored_x,
                        mirrored_y,
                        transposed,
                    });
                }
            }
        }
        all
    }

    /// Returns its description.
    pub fn name(self) -> &'static str {
        match (self.mirrored_x, self.mirrored_y, self.transposed) {
            (false, false, false) => "as stated",
            (true, false, false) => "mirrored left to right",
            (false, true, false) => "mirrored top to bottom",
            (true, true, false) => "turned by 180 degrees",
            (false, false, true) => "transposed",
            (true, false, true) | (false, true, true) => "turned by 90 degrees",
            (true, true, true) => "transposed along the other diagonal",
        }
    }
}

/// A hypothesis.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Hypothesis {
    pub turn: Turn,
    /// Index in [`SCALES`].
    pub scale: usize,
    /// The stated spot of each capture.
    pub order: Vec<usize>,
}

impl Hypothesis {
    pub fn stated(spots: usize) -> Self {
        Self {
            turn: Turn::default(),
            scale: 0,
            order: (0..spots).collect(),
        }
    }

    pub fn reordered(&self) -> bool {
        self.order.iter().enumerate().any(|(k, j)| k != *j)
    }

    pub fn faults(&self) -> usize {
        usize::from(self.turn != Turn::default())
            + usize::from(self.scale > 0)
            + usize::from(self.reordered())
    }

    /// The calibration under this hypothesis.
    pub fn model(&self, stated: &Model) -> Model {
        let factor = SCALES[self.scale].0;
        let mut model = stated.clone();
        model.start *= factor;
        model.width *= factor;
        model.beams = self.order.iter().map(|j| stated.beams[*j]).collect();
        model
    }

    /// The observations under this hypothesis.
    pub fn observed(&self, seen: &Observed, width: usize, height: usize) -> Observed {
        let mut seen = seen.clone();
        for p in &mut seen.pixels {
            *p = self.turn.pixel(*p, width, height);
        }
        for r in seen.returns.iter_mut().flatten() {
            r.pixel = self.turn.pixel(r.pixel, width, height);
        }
        seen
    }
}

/// The wrong calibration that comes nearest to the stated one.
pub(crate) struct Rival {
    pub hypothesis: Hypothesis,
    /// Share of times that it explains after a fit.
    pub share: f64,
    /// Mean distance of returns from their spots, pixels; NaN without returns.
    pub pixels: f64,
}

impl Rival {
    /// Returns its description.
    pub fn name(&self) -> String {
        let h = &self.hypothesis;
        let mut parts = Vec::new();
        if h.turn != Turn::default() {
            parts.push(format!("an image that is {}", h.turn.name()));
        }
        if h.scale > 0 {
            parts.push(format!("times {} times as long", SCALES[h.scale].0));
        }
        if h.reordered() {
            parts.push(format!("spots {}", order_name(&h.order)));
        }
        parts.join(" with ")
    }
}

/// What explains the times best.
pub(crate) struct Chosen {
    pub hypothesis: Hypothesis,
    /// Share of times that it explains, and that the stated calibration does, both after a fit.
    pub share: f64,
    pub stated_share: f64,
    /// Mean distance of returns from their spots, pixels, so and as stated; NaN without returns.
    pub pixels: f64,
    pub stated_pixels: f64,
    /// The wrong calibration that comes nearest, if the stated one is taken.
    pub rival: Option<Rival>,
}

/// Tries all hypotheses. Time scales are tried only where spots have stated places, because
/// otherwise every length grows with them.
pub(crate) fn choose(stated: &Model, seen: &Observed, width: usize, height: usize) -> Chosen {
    let seen = seen.thinned(PIXELS);
    let spots = stated.beams.len();
    let placed = stated.beams.iter().all(|b| b.point.is_some());
    let free = Free::LASER;
    let score = |h: &Hypothesis| -> (Fitted, f64) {
        let own = h.observed(&seen, width, height);
        let fitted = own.fit(&h.model(stated), free);
        let distance = distance(&fitted.model, &own);
        (fitted, distance)
    };
    let first = Hypothesis::stated(spots);
    let (base, base_distance) = score(&first);
    let mut best = (base.agreeing, base_distance, first);
    let mut rival: Option<Rival> = None;
    let scales = if placed { SCALES.len() } else { 1 };
    for turn in Turn::all(width == height) {
        for scale in 0..scales {
            let plain = Hypothesis {
                turn,
                scale,
                order: (0..spots).collect(),
            };
            let own = plain.observed(&seen, width, height);
            let mut tries = vec![];
            if plain.faults() > 0 {
                tries.push(plain.clone());
            }
            let order = by_returns(&plain.model(stated), &own);
            for order in order.into_iter().chain(usual_orders(
                spots,
                own.returns.iter().flatten().next().is_none(),
            )) {
                let h = Hypothesis {
                    order,
                    ..plain.clone()
                };
                if h.reordered() {
                    tries.push(h);
                }
            }
            for h in tries {
                let (fitted, distance) = score(&h);
                if rival.as_ref().is_none_or(|r| fitted.agreeing > r.share) {
                    rival = Some(Rival {
                        hypothesis: h.clone(),
                        share: fitted.agreeing,
                        pixels: distance,
                    });
                }
                let cost = |h: &Hypothesis| SIMPLER * h.faults() as f64;
                if fitted.agreeing - cost(&h) > best.0 - cost(&best.2) {
                    best = (fitted.agreeing, distance, h);
                }
            }
        }
    }
    let better = best.0 > BETTER.0 * base.agreeing + BETTER.1;
    let nearer = best.0 > base.agreeing + NEARER.0
        && best.1 < NEARER.1 * base_distance
        && best.1 < base_distance - NEARER.2;
    if !better && !nearer {
        best = (base.agreeing, base_distance, Hypothesis::stated(spots));
    }
    Chosen {
        rival: rival.filter(|_| best.2.faults() == 0),
        share: best.0,
        pixels: best.1,
        stated_share: base.agreeing,
        stated_pixels: base_distance,
        hypothesis: best.2,
    }
}

/// Mean distance of returns from the projections of their spots, pixels; NaN without returns.
pub(crate) fn distance(model: &Model, seen: &Observed) -> f64 {
    let all: Vec<f64> = (0..model.beams.len())
        .filter_map(|k| apart(model, k, seen.returns[k]?.pixel))
        .collect();
    all.iter().sum::<f64>() / all.len() as f64
}

/// Distance of a pixel from the projection of a spot, pixels.
pub(crate) fn apart(model: &Model, k: usize, pixel: usize) -> Option<f64> {
    let [x, y] = model.film(model.spot(k).0)?;
    let u = (pixel % model.columns) as f64 + 0.5 - x;
    let v = (pixel / model.columns) as f64 + 0.5 - y;
    Some((u * u + v * v).sqrt())
}

/// The spots to which returns belong, by the assignment of least squared distance on the film;
/// `None` if less than half of the spots have a return.
fn by_returns(model: &Model, seen: &Observed) -> Option<Vec<usize>> {
    let spots = model.beams.len();
    if 2 * seen.returns.iter().flatten().count() < spots {
        return None;
    }
    let most = model.columns as f64 / 4.0;
    let costs: Vec<Vec<f64>> = (0..spots)
        .map(|k| {
            let Some(r) = seen.returns[k] else {
                return (0..spots).map(|j| f64::from(u8::from(j != k))).collect();
            };
            // Beams without a stated spot are followed to the time of this return.
            let mut placed = model.clone();
            placed.place_beams(&vec![Some(r.bin); spots]);
            (0..spots)
                .map(|j| {
                    apart(&placed, j, r.pixel)
                        .map_or(most, |d| d.min(most))
                        .powi(2)
                })
                .collect()
        })
        .collect();
    Some(assign(&costs))
}

/// Orders that are tried where no return tells the order.
fn usual_orders(spots: usize, without_returns: bool) -> Vec<Vec<usize>> {
    if !without_returns {
        return Vec::new();
    }
    let side = spots.isqrt();
    let mut all: Vec<Vec<usize>> = vec![
        (0..spots).map(|k| (k + 1) % spots).collect(),
        (0..spots).map(|k| (k + spots - 1) % spots).collect(),
        (0..spots).rev().collect(),
    ];
    if side * side == spots {
        all.push((0..spots).map(|k| k % side * side + k / side).collect());
    }
    all
}

/// Names an order of spots.
pub(crate) fn order_name(order: &[usize]) -> String {
    let n = order.len();
    let moved: Vec<usize> = (0..n).filter(|k| order[*k] != *k).collect();
    let shifted = (1..n).find(|s| (0..n).all(|k| order[k] == (k + s) % n));
    if let Some(s) = shifted {
        let by = if s * 2 <= n {
            s as i64
        } else {
            s as i64 - n as i64
        };
        return format!("shifted by {by}");
    }
    if (0..n).all(|k| order[k] == n - 1 - k) {
        return "in reverse".into();
    }
    match moved[..] {
        [a, b] => format!("with spots {a} and {b} swapped"),
        _ => format!("in another order: {} of {n} spots moved", moved.len()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn mirrors_undo_themselves_and_orders_have_names() {
        let turn = Turn {
            mirrored_x: true,
            ..Turn::default()
        };
        for p in 0..12 {
            assert_eq!(turn.pixel(turn.pixel(p, 4, 3), 4, 3), p);
        }
        assert_eq!(turn.pixel(0, 4, 3), 3);
        assert_eq!(order_name(&[1, 2, 3, 0]), "shifted by 1");
        assert_eq!(order_name(&[3, 0, 1, 2]), "shifted by -1");
        assert_eq!(order_name(&[0, 2, 1, 3]), "with spots 1 and 2 swapped");
        assert_eq!(order_name(&[3, 2, 1, 0]), "in reverse");
    }
}
