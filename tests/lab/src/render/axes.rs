//! Logarithmic axes on a canvas: a frame, ticks, grid lines, lines between points, text in two
//! sizes.

use font8x8::UnicodeFonts;

use picofarm_figures::Canvas;

pub const INK: [u8; 3] = [40, 40, 40];
const GRID: [u8; 3] = [225, 225, 225];
const FINE: [u8; 3] = [242, 242, 242];

/// Width of one letter at scale 1.
pub const LETTER: usize = 8;

/// A logarithmic interval along one side of the frame.
#[derive(Debug, Clone, Copy)]
pub struct Span {
    low: f64,
    high: f64,
}

impl Span {
    /// Returns a span that contains all values, with a margin and at least one and a half decades.
    pub fn around(values: impl Iterator<Item = f64>) -> Self {
        let usable = values.filter(|v| v.is_finite() && *v > 0.0);
        let (low, high) = usable.fold((f64::INFINITY, 0.0f64), |(l, h), v| (l.min(v), h.max(v)));
        if low > high {
            return Self {
                low: 0.1,
                high: 10.0,
            };
        }
        let missing = (30.0 / (high / low)).max(1.0).sqrt();
        Self {
            low: low / missing.max(1.4),
            high: high * missing.max(1.4),
        }
    }

    /// Returns the relative position of `v`: 0 at the low end, 1 at the high one.
    pub fn share(self, v: f64) -> f64 {
        (v / self.low).ln() / (self.high / self.low).ln()
    }

    /// Returns 1, 2 and 5 times the powers of ten in the span, and whether each gets a label.
    fn ticks(self) -> Vec<(f64, bool)> {
        let decades = (self.low.log10().floor() as i32)..=(self.high.log10().ceil() as i32);
        let labelled = |digit: i32| match (self.high / self.low).log10() {
            d if d > 3.5 => digit == 1,
            _ => matches!(digit, 1 | 2 | 5),
        };
        decades
            .flat_map(|d| (1..10).map(move |digit| (digit, f64::from(digit) * 10f64.powi(d))))
            .filter(|(_, v)| (self.low..=self.high).contains(v))
            .map(|(digit, v)| (v, labelled(digit)))
            .collect()
    }
}

/// The frame in pixels and its two spans.
pub struct Axes {
    pub canvas: Canvas,
    pub left: usize,
    pub top: usize,
    pub width: usize,
    pub height: usize,
    pub x: Span,
    pub y: Span,
}

impl Axes {
    /// Returns the pixel of a point.
    pub fn at(&self, x: f64, y: f64) -> (f64, f64) {
        (
            self.left as f64 + self.x.share(x) * self.width as f64,
            (self.top + self.height) as f64 - self.y.share(y) * self.height as f64,
        )
    }

    /// Draws grid, frame, tick labels and the axes' names.
    pub fn draw(&mut self, x_name: &str, y_name: &str) {
        let (left, top) = (self.left, self.top);
        let (right, bottom) = (left + self.width, top + self.height);
        for (v, labelled) in self.x.ticks() {
            let px = self.at(v, 1.0).0.round() as usize;
            let colour = if labelled { GRID } else { FINE };
            (top..bottom).for_each(|y| self.canvas.set(px, y, colour));
            if labelled {
                let text = tick(v);
                let x = px.saturating_sub(text.len() * LETTER / 2);
                self.canvas.text(x, bottom + 8, &text, INK);
            }
        }
        for (v, labelled) in self.y.ticks() {
            let py = self.at(1.0, v).1.round() as usize;
            let colour = if labelled { GRID } else { FINE };
            (left..right).for_each(|x| self.canvas.set(x, py, colour));
            if labelled {
                let text = tick(v);
                let x = left.saturating_sub(8 + text.len() * LETTER);
                self.canvas.text(x, py.saturating_sub(4), &text, INK);
            }
        }
        for x in left..=right {
            self.canvas.set(x, top, INK);
            self.canvas.set(x, bottom, INK);
        }
        for y in top..=bottom {
            self.canvas.set(left, y, INK);
            self.canvas.set(right, y, INK);
        }
        let middle = (left + self.width / 2).saturating_sub(x_name.len() * LETTER);
        self.text(middle, bottom + 26, x_name, 2, INK);
        self.text(8, top.saturating_sub(26), y_name, 2, INK);
    }

    /// Draws text with letters of `scale` times eight pixels.
    pub fn text(&mut self, x: usize, y: usize, text: &str, scale: usize, colour: [u8; 3]) {
        for (i, letter) in text.chars().enumerate() {
            let glyph = font8x8::BASIC_FONTS.get(letter).unwrap_or_default();
            for (row, bits) in glyph.iter().enumerate() {
                for column in (0..8).filter(|c| bits >> c & 1 == 1) {
                    for k in 0..scale * scale {
                        let (dx, dy) = (k % scale, k / scale);
                        self.canvas.set(
                            x + (i * LETTER + column) * scale + dx,
                            y + row * scale + dy,
                            colour,
                        );
                    }
                }
            }
        }
    }

    /// Draws a line two pixels wide, clipped at the frame. `dash` = pixels on and off, 0 for a
    /// solid line.
    pub fn line(&mut self, from: (f64, f64), to: (f64, f64), dash: usize, colour: [u8; 3]) {
        let steps = (to.0 - from.0)
            .abs()
            .max((to.1 - from.1).abs())
            .ceil()
            .max(1.0) as usize;
        for k in 0..=steps {
            if dash > 0 && (k / dash) % 2 == 1 {
                continue;
            }
            let t = k as f64 / steps as f64;
            let (x, y) = (from.0 + t * (to.0 - from.0), from.1 + t * (to.1 - from.1));
            for (dx, dy) in [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)] {
                self.dot(x + dx, y + dy, colour);
            }
        }
    }

    /// Draws a marker: a filled square (`round` = false) or disc.
    pub fn marker(&mut self, at: (f64, f64), round: bool, colour: [u8; 3]) {
        for dy in -4i32..=4 {
            for dx in -4i32..=4 {
                if !round || dx * dx + dy * dy <= 18 {
                    self.dot(at.0 + f64::from(dx), at.1 + f64::from(dy), colour);
                }
            }
        }
    }

    fn dot(&mut self, x: f64, y: f64, colour: [u8; 3]) {
        let inside = |v: f64, from: usize, n: usize| v >= from as f64 && v < (from + n) as f64;
        if inside(x, self.left, self.width) && inside(y, self.top, self.height) {
            self.canvas.set(x as usize, y as usize, colour);
        }
    }
}

/// Formats a tick: "0.02", "5", "200".
fn tick(v: f64) -> String {
    let decimals = (-v.log10().floor()).max(0.0) as usize;
    format!("{v:.decimals$}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spans_hold_what_they_are_around() {
        for values in [vec![1.0], vec![0.02, 3.0], vec![5.0, 5000.0, f64::NAN, 0.0]] {
            let span = Span::around(values.iter().copied());
            for v in values.into_iter().filter(|v| *v > 0.0) {
                assert!((0.01..0.99).contains(&span.share(v)), "{v} in {span:?}");
            }
            assert!(span.ticks().iter().filter(|t| t.1).count() >= 2, "{span:?}");
        }
        assert!(Span::around(std::iter::empty()).high > 0.0);
    }

    #[test]
    fn ticks_read_well() {
        assert_eq!(
            [0.02, 0.1, 5.0, 200.0].map(tick),
            ["0.02", "0.1", "5", "200"]
        );
    }
}
