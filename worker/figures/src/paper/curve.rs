//! Panels with values over a horizontal axis.

use std::fmt::Write;

use super::{
    Area, THIN, frame,
    image::hex,
    line,
    scale::{axis, number, power, ticks},
    text::{SMALL, label, upwards},
};

/// Most points of a drawn curve. Of more bins, each point is the largest of its share.
const POINTS: usize = 1000;
/// Length of a mark in parts of the panel's height.
const MARK: f64 = 0.12;
/// Room above the curve.
const HEAD: f64 = 1.25;

/// Values of equal bins.
#[derive(Debug, Clone)]
pub struct Curve {
    /// Title.
    pub title: String,
    /// Start of the first bin and end of the last.
    pub range: [f64; 2],
    /// Name and unit of the horizontal axis.
    pub horizontal: (&'static str, &'static str),
    /// Name and unit of the vertical axis.
    pub vertical: (&'static str, &'static str),
    /// Values.
    pub values: Vec<f64>,
    /// Marks below the upper edge, drawn in this order.
    pub marks: Vec<Mark>,
    /// Meanings of the styles of marks.
    pub styles: Vec<Style>,
}

/// A mark on the horizontal axis.
#[derive(Debug, Clone, Copy)]
pub struct Mark {
    /// Where.
    pub at: f64,
    /// Index of its style.
    pub style: usize,
}

/// What marks of a colour mean.
#[derive(Debug, Clone)]
pub struct Style {
    /// The colour.
    pub colour: [u8; 3],
    /// The meaning.
    pub text: String,
}

impl Curve {
    /// Draws curve, marks and axes.
    pub(super) fn draw(&self, body: &mut String, a: Area) {
        let [start, end] = self.range;
        let most = self.values.iter().fold(0.0f64, |m, v| m.max(*v));
        let high = if most > 0.0 { most * HEAD } else { 1.0 };
        let x = |v: f64| a.x + a.width * (v - start) / (end - start);
        let bottom = a.y + a.height;
        let y = |v: f64| bottom - a.height * (v / high).clamp(0.0, 1.0);
        self.steps(body, &x, &y);
        for mark in &self.marks {
            let Some(style) = self.styles.get(mark.style) else {
                continue;
            };
            if (start..=end).contains(&mark.at) {
                let stroke = format!("stroke=\"{}\" stroke-width=\"0.6\"", hex(style.colour));
                let x = x(mark.at);
                line(body, [x, a.y], [x, a.y + MARK * a.height], &stroke);
            }
        }
        frame(body, a);
        for t in ticks(start, end, 3) {
            line(body, [x(t), bottom], [x(t), bottom + 2.0], THIN);
            *body += &label(x(t), bottom + 7.5, SMALL, "middle", &number(t, 0));
        }
        let (name, unit) = self.horizontal;
        let middle = a.x + a.width / 2.0;
        *body += &label(middle, bottom + 14.0, SMALL, "middle", &axis(name, unit, 0));
        let power = power(high);
        for t in ticks(0.0, high, 3) {
            line(body, [a.x, y(t)], [a.x - 2.0, y(t)], THIN);
            *body += &label(a.x - 3.0, y(t) + 2.0, SMALL, "end", &number(t, power));
        }
        let (name, unit) = self.vertical;
        let name = axis(name, unit, power);
        *body += &upwards(a.x - 14.5, a.y + a.height / 2.0, &name);
        for (n, style) in self.styles.iter().enumerate() {
            let (x, y) = (a.x + a.width + 4.0, a.y + 7.0 * n as f64 + 2.5);
            let stroke = format!("stroke=\"{}\" stroke-width=\"1\"", hex(style.colour));
            line(body, [x, y - 2.5], [x, y + 2.5], &stroke);
            *body += &label(x + 3.0, y + 2.0, SMALL, "start", &style.text);
        }
    }

    /// Draws the values as steps.
    fn steps(&self, body: &mut String, x: &dyn Fn(f64) -> f64, y: &dyn Fn(f64) -> f64) {
        let count = self.values.len();
        if count == 0 {
            return;
        }
        let points = count.min(POINTS);
        let [start, end] = self.range;
        let edge = |k: usize| start + (end - start) * k as f64 / points as f64;
        let mut path = format!("M{:.2} {:.2}", x(start), y(0.0));
        for k in 0..points {
            let bins = k * count / points..((k + 1) * count / points);
            let value = self.values[bins].iter().fold(0.0f64, |m, v| m.max(*v));
            let _ = write!(path, "V{:.2}H{:.2}", y(value), x(edge(k + 1)));
        }
        let _ = write!(path, "V{:.2}", y(0.0));
        let _ = writeln!(
            body,
            "<path d=\"{path}\" fill=\"#31688e\" fill-opacity=\"0.25\" stroke=\"#31688e\" stroke-width=\"0.5\" stroke-linejoin=\"round\"/>"
        );
    }
}
