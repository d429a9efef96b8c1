//! Panels with a picture.

use std::fmt::Write;

use super::{
    Area, THIN, frame, line,
    scale::{axis, number, power, ticks},
    text::{SMALL, label, upwards},
};
use crate::{data_url, rgb_png};

/// Width of a colour bar.
const BAR: f64 = 5.0;
/// Distance of a colour bar from the picture.
const GAP: f64 = 4.0;
/// Number of colours of a drawn bar.
const STEPS: usize = 128;
/// Most letters of a key.
const LETTERS: usize = 11;

/// A picture. Pixels are `[row][column]`.
#[derive(Debug, Clone)]
pub struct Image {
    /// Title.
    pub title: String,
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// Colours, `[row][column][3]`.
    pub rgb: Vec<u8>,
    /// What the colours mean, if they are a scale.
    pub bar: Option<Bar>,
    /// What single colours mean.
    pub keys: Vec<Key>,
    /// Crosses at these positions, in pixels.
    pub marks: Vec<[f64; 2]>,
}

/// A colour bar. A value `v` has the colour `map(((v − low) / (high − low))^exponent)`.
#[derive(Debug, Clone)]
pub struct Bar {
    /// Value of the first colour.
    pub low: f64,
    /// Value of the last colour.
    pub high: f64,
    /// Larger values exist and have the last colour.
    pub clipped: bool,
    /// Exponent of the scale: 1 is linear.
    pub exponent: f64,
    /// Name of the quantity.
    pub name: &'static str,
    /// Its unit, or nothing.
    pub unit: &'static str,
    /// The colour map.
    pub map: fn(f32) -> [u8; 3],
}

/// A colour with its meaning.
#[derive(Debug, Clone)]
pub struct Key {
    /// The colour.
    pub colour: [u8; 3],
    /// Its meaning.
    pub text: String,
}

impl Image {
    /// Draws the picture, its axes and its bar or keys.
    pub(super) fn draw(&self, body: &mut String, a: Area) {
        let png = rgb_png(self.width as u32, self.height as u32, &self.rgb);
        let url = data_url(&png);
        let _ = writeln!(
            body,
            "<image x=\"{:.2}\" y=\"{:.2}\" width=\"{:.2}\" height=\"{:.2}\" preserveAspectRatio=\"none\" image-rendering=\"optimizeSpeed\" style=\"image-rendering:pixelated\" href=\"{url}\"/>",
            a.x, a.y, a.width, a.height
        );
        let (sx, sy) = (
            a.width / self.width.max(1) as f64,
            a.height / self.height.max(1) as f64,
        );
        for [u, v] in &self.marks {
            let (x, y) = (a.x + u * sx, a.y + v * sy);
            let style = "stroke=\"#f33\" stroke-width=\"0.7\"";
            line(body, [x - 2.0, y - 2.0], [x + 2.0, y + 2.0], style);
            line(body, [x - 2.0, y + 2.0], [x + 2.0, y - 2.0], style);
        }
        frame(body, a);
        self.axes(body, a, sx, sy);
        match &self.bar {
            Some(bar) => bar.draw(body, a),
            None => self.draw_keys(body, a),
        }
    }

    fn axes(&self, body: &mut String, a: Area, sx: f64, sy: f64) {
        let bottom = a.y + a.height;
        for t in ticks(0.0, self.width as f64, 3) {
            let x = a.x + t * sx;
            line(body, [x, bottom], [x, bottom + 2.0], THIN);
            *body += &label(x, bottom + 7.5, SMALL, "middle", &number(t, 0));
        }
        let middle = a.x + a.width / 2.0;
        *body += &label(middle, bottom + 14.0, SMALL, "middle", "column (pixels)");
        for t in ticks(0.0, self.height as f64, 3) {
            let y = a.y + t * sy;
            line(body, [a.x, y], [a.x - 2.0, y], THIN);
            *body += &label(a.x - 3.0, y + 2.0, SMALL, "end", &number(t, 0));
        }
        *body += &upwards(a.x - 14.5, a.y + a.height / 2.0, "row (pixels)");
    }

    fn draw_keys(&self, body: &mut String, a: Area) {
        let rows = (((a.height + 3.0) / 7.0) as usize).max(1);
        let x = a.x + a.width + GAP;
        for (n, key) in self.keys.iter().enumerate() {
            let y = a.y + 7.0 * n as f64;
            // The last row says that more follow.
            if n + 1 == rows && self.keys.len() > rows {
                let more = format!("and {} more", self.keys.len() - n);
                *body += &label(x, y + 4.6, SMALL, "start", &more);
                return;
            }
            let _ = writeln!(
                body,
                "<rect x=\"{x:.2}\" y=\"{y:.2}\" width=\"5\" height=\"5\" fill=\"{}\" stroke=\"#000\" stroke-width=\"0.3\"/>",
                hex(key.colour)
            );
            let text = match key.text.chars().count() {
                n if n <= LETTERS => key.text.clone(),
                _ => key.text.chars().take(LETTERS - 1).collect::<String>() + "…",
            };
            *body += &label(x + 6.5, y + 4.6, SMALL, "start", &text);
        }
    }
}

impl Bar {
    fn draw(&self, body: &mut String, a: Area) {
        let x = a.x + a.width + GAP;
        let height = a.height / STEPS as f64;
        for k in 0..STEPS {
            let t = (k as f32 + 0.5) / STEPS as f32;
            let y = a.y + a.height - (k + 1) as f64 * height;
            // Slightly taller, so that no seam shows.
            let _ = writeln!(
                body,
                "<rect x=\"{x:.2}\" y=\"{y:.3}\" width=\"{BAR}\" height=\"{:.3}\" fill=\"{}\"/>",
                height * if k == 0 { 1.0 } else { 1.3 },
                hex((self.map)(t))
            );
        }
        let bar = Area { x, width: BAR, ..a };
        frame(body, bar);
        let power = power(self.low.abs().max(self.high.abs()));
        let span = self.high - self.low;
        let place = |v: f64| {
            let share = if span > 0.0 {
                (v - self.low) / span
            } else {
                0.0
            };
            a.y + a.height * (1.0 - libm::pow(share.clamp(0.0, 1.0), self.exponent))
        };
        let (top, bottom) = (a.y, a.y + a.height);
        let mut taken = vec![top, bottom];
        let mut letters = 0;
        let mut tick = |y: f64, text: &str| {
            letters = letters.max(text.chars().count());
            line(body, [x + BAR, y], [x + BAR + 1.5, y], THIN);
            *body += &label(x + BAR + 2.5, y + 2.0, SMALL, "start", text);
        };
        let most = number(self.high, power);
        let most = if self.clipped {
            format!("≥ {most}")
        } else {
            most
        };
        tick(bottom, &number(self.low, power));
        if span > 0.0 {
            tick(top, &most);
        }
        for v in ticks(self.low, self.high, 3) {
            let y = place(v);
            if taken.iter().all(|t| (t - y).abs() >= 7.0) {
                tick(y, &number(v, power));
                taken.push(y);
            }
        }
        let name = axis(self.name, self.unit, power);
        // After the longest number.
        let x = x + BAR + 8.5 + 0.5 * SMALL * letters as f64;
        *body += &upwards(x, a.y + a.height / 2.0, &name);
    }
}

/// Returns a colour as `#rrggbb`.
pub(super) fn hex([r, g, b]: [u8; 3]) -> String {
    format!("#{r:02x}{g:02x}{b:02x}")
}
