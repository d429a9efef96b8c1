//! Charts as SVG: lines or points over two axes.

use std::fmt::Write;

use super::{text::Safe, ticks::Scale};

/// An axis.
pub(super) struct Axis<'a> {
    /// The quantity, with its unit.
    pub label: &'a str,
    /// Whether the axis is logarithmic.
    pub log: bool,
    /// Whether a linear axis starts at 0.
    pub zero: bool,
    /// Formats a tick's value.
    pub write: fn(f64) -> String,
}

/// A series of points.
#[derive(Debug, Clone, Default)]
pub(super) struct Series {
    /// The text shown when a pointer is over it.
    pub label: String,
    /// The number of its colour and mark.
    pub style: usize,
    /// x, y, and the spread of y to either side.
    pub points: Vec<(f64, f64, f64)>,
    /// Whether points are joined; a point that cannot be drawn breaks the line.
    pub joined: bool,
    /// Whether each point has a mark.
    pub marks: bool,
}

/// The number of colours.
pub(super) const COLOURS: usize = 8;

const WIDTH: f64 = 420.0;
const HEIGHT: f64 = 270.0;
const LEFT: f64 = 62.0;
const RIGHT: f64 = 22.0;
const TOP: f64 = 28.0;
const BOTTOM: f64 = 44.0;

/// Returns a chart, or a sentence if there is nothing to draw.
pub(super) fn chart(title: &str, x: &Axis, y: &Axis, series: &[Series]) -> String {
    let points = || series.iter().flat_map(|s| &s.points);
    let drawn = |p: &&(f64, f64, f64)| {
        let fits = |v: f64, log: bool| v.is_finite() && (!log || v > 0.0);
        fits(p.0, x.log) && fits(p.1, y.log)
    };
    let across = Scale::over(points().filter(drawn).map(|p| p.0), x.log);
    let ends = points().filter(drawn).flat_map(|p| {
        let spread = if p.2.is_finite() { p.2 } else { 0.0 };
        let low = p.1 - spread;
        [
            if y.zero && p.1 >= 0.0 {
                low.max(0.0)
            } else {
                low
            },
            p.1,
            p.1 + spread,
        ]
    });
    let up = Scale::over(ends, y.log);
    let (Some(mut across), Some(mut up)) = (across, up) else {
        return format!("<p class=\"none\">{}: no values to draw.</p>", Safe(title));
    };
    if x.zero {
        across = across.with_zero();
    }
    if y.zero {
        up = up.with_zero();
    }
    let at_x = |v: f64| across.at(v).map(|at| LEFT + at * (WIDTH - LEFT - RIGHT));
    let at_y = |v: f64| {
        up.at(v)
            .map(|at| HEIGHT - BOTTOM - at * (HEIGHT - TOP - BOTTOM))
    };
    let mut out = String::new();
    let title = Safe(title);
    let _ = write!(
        out,
        "<svg class=\"chart\" viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\" aria-label=\"{title}\">\
         <text class=\"title\" x=\"{LEFT}\" y=\"16\">{title}</text>"
    );
    let (right, bottom) = (WIDTH - RIGHT, HEIGHT - BOTTOM);
    for tick in across.ticks(6) {
        let Some(px) = at_x(tick) else { continue };
        let _ = write!(
            out,
            "<path class=\"grid\" d=\"M{px:.1} {TOP}V{bottom}\"/>\
             <text class=\"tick\" x=\"{px:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{}</text>",
            bottom + 15.0,
            Safe((x.write)(tick))
        );
    }
    for tick in up.ticks(5) {
        let Some(py) = at_y(tick) else { continue };
        let _ = write!(
            out,
            "<path class=\"grid\" d=\"M{LEFT} {py:.1}H{right}\"/>\
             <text class=\"tick\" x=\"{}\" y=\"{:.1}\" text-anchor=\"end\">{}</text>",
            LEFT - 6.0,
            py + 3.5,
            Safe((y.write)(tick))
        );
    }
    let _ = write!(
        out,
        "<path class=\"axis\" d=\"M{LEFT} {TOP}V{bottom}H{right}\"/>\
         <text class=\"label\" x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{}</text>\
         <text class=\"label\" transform=\"translate(13 {:.1}) rotate(-90)\" text-anchor=\"middle\">{}</text>",
        (LEFT + right) / 2.0,
        HEIGHT - 8.0,
        Safe(x.label),
        (TOP + bottom) / 2.0,
        Safe(y.label)
    );
    for one in series {
        draw(&mut out, one, &at_x, &at_y);
    }
    out.push_str("</svg>");
    out
}

fn draw(
    out: &mut String,
    series: &Series,
    at_x: &dyn Fn(f64) -> Option<f64>,
    at_y: &dyn Fn(f64) -> Option<f64>,
) {
    let colour = series.style % COLOURS;
    let at = |p: &(f64, f64, f64)| Some((at_x(p.0)?, at_y(p.1)?));
    let _ = write!(
        out,
        "<g class=\"c{colour}\"><title>{}</title>",
        Safe(&series.label)
    );
    if series.joined {
        let mut path = String::new();
        let mut down = false;
        for point in &series.points {
            let Some((px, py)) = at(point) else {
                down = false;
                continue;
            };
            let _ = write!(path, "{}{px:.1} {py:.1}", if down { 'L' } else { 'M' });
            down = true;
        }
        if !path.is_empty() {
            let dash = DASHES[series.style / COLOURS % DASHES.len()];
            let _ = write!(
                out,
                "<path class=\"line\" stroke-dasharray=\"{dash}\" d=\"{path}\"/>"
            );
        }
    }
    // A line of one point is invisible, so the point has a mark.
    let alone = series.points.iter().filter(|p| at(p).is_some()).count() == 1;
    if series.marks || alone {
        for point in &series.points {
            let Some((px, py)) = at(point) else { continue };
            // A spread that extends below the axis ends at it.
            let low = at_y(point.1 - point.2).unwrap_or(HEIGHT - BOTTOM);
            let high = at_y(point.1 + point.2);
            if let (true, Some(high)) = (point.2 > 0.0, high) {
                let _ = write!(
                    out,
                    "<path class=\"bar\" d=\"M{px:.1} {low:.1}V{high:.1}\"/>"
                );
            }
            out.push_str(&mark(series.style, px, py));
        }
    }
    out.push_str("</g>");
}

const DASHES: [&str; 4] = ["none", "6 3", "2 2", "8 2 2 2"];

/// Returns the mark of a style; there are as many shapes as dash patterns.
fn mark(style: usize, x: f64, y: f64) -> String {
    match style / COLOURS % DASHES.len() {
        0 => format!("<circle class=\"mark\" cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"4\"/>"),
        1 => format!("<path class=\"mark\" d=\"M{x:.1} {y:.1}m-4 -4h8v8h-8z\"/>"),
        2 => format!("<path class=\"mark\" d=\"M{x:.1} {y:.1}m0 -5l5 9h-10z\"/>"),
        _ => format!("<path class=\"mark\" d=\"M{x:.1} {y:.1}m0 -5l5 5l-5 5l-5 -5z\"/>"),
    }
}

/// Returns the legend of colours and marks.
pub(super) fn legend<'a>(entries: impl Iterator<Item = (usize, &'a str)>) -> String {
    let mut out = String::from("<ul class=\"legend\">");
    for (style, label) in entries {
        let dash = DASHES[style / COLOURS % DASHES.len()];
        let _ = write!(
            out,
            "<li><svg viewBox=\"0 0 26 12\" aria-hidden=\"true\"><g class=\"c{}\"><path class=\"line\" \
             stroke-dasharray=\"{dash}\" d=\"M0 6H26\"/>{}</g></svg>{}</li>",
            style % COLOURS,
            mark(style, 13.0, 6.0),
            Safe(label)
        );
    }
    out + "</ul>"
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::number::short;

    fn axis(log: bool, zero: bool) -> Axis<'static> {
        Axis {
            label: "a < b",
            log,
            zero,
            write: short,
        }
    }

    /// Returns the numbers in every attribute that contains some.
    fn numbers(svg: &str) -> Vec<String> {
        let attributes = svg.split('"').skip(1).step_by(2);
        let drawn = attributes.filter(|a| a.starts_with(|c: char| c.is_ascii_digit() || c == 'M'));
        let words = drawn
            .flat_map(|a| a.split(|c: char| c == ' ' || (c.is_ascii_alphabetic() && c != 'N')));
        words.filter(|w| !w.is_empty()).map(str::to_owned).collect()
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 64, ..ProptestConfig::default() })]

        #[test]
        fn any_values_give_numbers_within_the_picture(
            points in prop::collection::vec((prop::num::f64::ANY, prop::num::f64::ANY, prop::num::f64::ANY), 0..5),
            logs: (bool, bool), zero: bool, style in 0..40usize,
        ) {
            let series = Series { label: "s".into(), style, points, joined: true, marks: true };
            let svg = chart("t", &axis(logs.0, zero), &axis(logs.1, zero), &[series]);
            prop_assert!(!svg.contains("NaN") && !svg.contains("inf"), "{}", svg);
            for number in numbers(&svg) {
                let value: f64 = number.parse().unwrap_or_else(|_| panic!("{number} in {svg}"));
                prop_assert!(value.abs() <= 430.0, "{} in {}", number, svg);
            }
        }
    }

    #[test]
    fn nothing_to_draw_is_said_and_one_point_is_a_mark() {
        let of = |points: Vec<(f64, f64, f64)>| {
            let series = Series {
                points,
                joined: true,
                ..Series::default()
            };
            chart(
                "loss <1>",
                &axis(false, true),
                &axis(true, false),
                &[series],
            )
        };
        for nothing in [vec![], vec![(1.0, f64::NAN, 0.0)], vec![(1.0, -1.0, 0.0)]] {
            assert_eq!(
                of(nothing),
                "<p class=\"none\">loss &lt;1&gt;: no values to draw.</p>"
            );
        }
        assert!(of(vec![(1.0, 2.0, 0.0)]).contains("<circle"));
        let broken = of(vec![
            (1.0, 2.0, 0.0),
            (2.0, f64::NAN, 0.0),
            (3.0, 1.0, 0.0),
            (4.0, 1.0, 0.0),
        ]);
        let line = broken.split("class=\"line\"").nth(1).unwrap();
        assert_eq!(
            line.split("/>").next().unwrap().matches('M').count(),
            2,
            "{broken}"
        );
    }
}
