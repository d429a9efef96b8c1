//! Labels.

use crate::text::Safe;

/// Size of titles, points.
pub const SIZE: f64 = 7.0;
/// Size of ticks and axes, points.
pub const SMALL: f64 = 5.5;

/// Returns a label at a point; `anchor` is start, middle or end.
pub fn label(x: f64, y: f64, size: f64, anchor: &str, text: &str) -> String {
    format!(
        "<text x=\"{x:.2}\" y=\"{y:.2}\" font-size=\"{size}\" text-anchor=\"{anchor}\">{}</text>\n",
        rich(text)
    )
}

/// Returns a label that reads upwards, centred at a point.
pub fn upwards(x: f64, y: f64, text: &str) -> String {
    format!(
        "<text transform=\"translate({x:.2} {y:.2}) rotate(-90)\" font-size=\"{SMALL}\" text-anchor=\"middle\">{}</text>\n",
        rich(text)
    )
}

/// Escapes a text. What follows `^` up to the next space or `/` is raised.
fn rich(text: &str) -> String {
    let Some((before, rest)) = text.split_once('^') else {
        return Safe(text).to_string();
    };
    let end = rest.find([' ', '/', ')']).unwrap_or(rest.len());
    let (power, after) = rest.split_at(end);
    format!(
        "{}<tspan dy=\"-2\" font-size=\"4\">{}</tspan><tspan dy=\"2\">{}</tspan>",
        Safe(before),
        Safe(power.replace('-', "\u{2212}")),
        Safe(after)
    )
}
