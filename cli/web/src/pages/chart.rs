//! Charts as SVG without styles of their own: lines over two axes, and parallel coordinates.

use maud::{Markup, html};
use picofarm_figures::number::short;

use super::parts::safe;

const WIDTH: f64 = 720.0;
const HEIGHT: f64 = 260.0;
const LEFT: f64 = 58.0;
const RIGHT: f64 = 14.0;
const TOP: f64 = 24.0;
const BOTTOM: f64 = 34.0;
/// Ticks of an axis, about.
const TICKS: f64 = 5.0;

/// A line of a chart.
pub struct Series {
    /// Text for a pointer.
    pub label: String,
    /// Class of its colour.
    pub class: &'static str,
    /// x and y. Values that are not finite are left out.
    pub points: Vec<(f64, f64)>,
}

/// The range of an axis.
struct Axis {
    from: f64,
    to: f64,
    log: bool,
}

impl Axis {
    /// Returns the range of finite values; logarithmic if they are positive and span a factor of
    /// twenty.
    fn over(values: impl Iterator<Item = f64>, may_be_log: bool) -> Self {
        let (mut from, mut to) = (f64::INFINITY, f64::NEG_INFINITY);
        for value in values.filter(|value| value.is_finite()) {
            (from, to) = (from.min(value), to.max(value));
        }
        if from > to {
            (from, to) = (0.0, 1.0);
        }
        let log = may_be_log && from > 0.0 && to / from >= 20.0;
        if from == to {
            let half = if from == 0.0 { 1.0 } else { 0.5 * from.abs() };
            (from, to) = (from - half, to + half);
        }
        Self { from, to, log }
    }

    /// Returns the place of a value, from 0 to 1.
    fn place(&self, value: f64) -> f64 {
        let scale = |x: f64| if self.log { x.ln() } else { x };
        (scale(value) - scale(self.from)) / (scale(self.to) - scale(self.from))
    }

    fn ticks(&self) -> Vec<f64> {
        if self.log {
            let (from, to) = (
                self.from.log10().floor() as i32,
                self.to.log10().ceil() as i32,
            );
            let steps: &[f64] = if to - from > 2 {
                &[1.0]
            } else {
                &[1.0, 2.0, 5.0]
            };
            let all = (from..=to).flat_map(|e| steps.iter().map(move |s| s * 10f64.powi(e)));
            return all.filter(|x| (self.from..=self.to).contains(x)).collect();
        }
        let raw = (self.to - self.from) / TICKS;
        let power = 10f64.powf(raw.log10().floor());
        let steps = [1.0, 2.0, 5.0, 10.0].map(|step| step * power);
        let step = steps.into_iter().find(|step| *step >= raw).unwrap_or(raw);
        let (first, last) = (
            (self.from / step).ceil() as i64,
            (self.to / step).floor() as i64,
        );
        (first..=last).map(|i| i as f64 * step).collect()
    }
}

/// Returns a chart of lines, or a sentence if there is nothing to draw.
pub fn lines(label: &str, [x_name, y_name]: [&str; 2], series: &[Series]) -> Markup {
    let points = || series.iter().flat_map(|s| &s.points);
    let finite = |p: &&(f64, f64)| p.0.is_finite() && p.1.is_finite();
    if points().filter(finite).count() == 0 {
        return html! { p.none { "No figures yet." } };
    }
    let across = Axis::over(points().filter(finite).map(|p| p.0), false);
    let up = Axis::over(points().filter(finite).map(|p| p.1), true);
    let x = |value: f64| LEFT + across.place(value) * (WIDTH - LEFT - RIGHT);
    let y = |value: f64| HEIGHT - BOTTOM - up.place(value) * (HEIGHT - TOP - BOTTOM);
    html! {
        div.scroll tabindex="0" role="region" aria-label=(label) {
            svg.lines viewBox={ "0 0 " (WIDTH) " " (HEIGHT) } role="img" aria-label=(safe(label)) {
                @for tick in up.ticks() {
                    line.rule x1=(LEFT) x2=(WIDTH - RIGHT) y1=(px(y(tick))) y2=(px(y(tick))) {}
                    text.up x=(LEFT - 6.0) y=(px(y(tick) + 4.0)) { (short(tick)) }
                }
                @for tick in across.ticks().iter().filter(|tick| whole(tick)) {
                    text.across x=(px(x(*tick))) y=(HEIGHT - BOTTOM + 16.0) { (short(*tick)) }
                }
                text.across x=((LEFT + WIDTH - RIGHT) / 2.0) y=(HEIGHT - 3.0) { (x_name) }
                text.name x="2" y="10" { (y_name) }
                @for one in series {
                    @let drawn: Vec<_> = one.points.iter().filter(finite).map(|p| (x(p.0), y(p.1))).collect();
                    g.(one.class) {
                        title { (safe(&one.label)) }
                        @if drawn.len() > 1 { polyline points=(path(&drawn)) {} }
                        @if let Some((x, y)) = drawn.last() { circle cx=(px(*x)) cy=(px(*y)) r="2.5" {} }
                    }
                }
            }
        }
    }
}

/// An axis of parallel coordinates.
pub struct Coordinate {
    /// Its name.
    pub name: String,
    /// Its texts, from bottom to top, if its values are no numbers.
    pub words: Vec<String>,
    /// A value for each line: a number, or a position in `words`.
    pub values: Vec<Option<f64>>,
}

/// Returns parallel coordinates: an axis for each coordinate, and a line for each of `lines`, with
/// its text and the class of its colour. The last lines are drawn on top.
pub fn parallel(label: &str, axes: &[Coordinate], drawn: &[(String, &'static str)]) -> Markup {
    let scales: Vec<Axis> = axes
        .iter()
        .map(|axis| match axis.words.len() {
            0 => Axis::over(axis.values.iter().flatten().copied(), true),
            words => Axis::over([0.0, words as f64 - 1.0].into_iter(), false),
        })
        .collect();
    let step = (WIDTH - 2.0 * LEFT) / (axes.len().max(2) - 1) as f64;
    let x = |axis: usize| LEFT + step * axis as f64;
    let y = |place: f64| HEIGHT - BOTTOM - place * (HEIGHT - BOTTOM - 26.0);
    html! {
        div.scroll tabindex="0" role="region" aria-label=(label) {
            svg.lines.parallel viewBox={ "0 0 " (WIDTH) " " (HEIGHT) } role="img" aria-label=(safe(label)) {
                @for (i, (text, class)) in drawn.iter().enumerate() {
                    @let points: Vec<_> = axes.iter().zip(&scales).enumerate().filter_map(|(axis, (of, scale))| {
                        let value = of.values.get(i).copied().flatten()?;
                        Some((x(axis), y(scale.place(value))))
                    }).collect();
                    g.(class) { title { (safe(text)) } polyline points=(path(&points)) {} }
                }
                @for (i, (axis, scale)) in axes.iter().zip(&scales).enumerate() {
                    line.axis x1=(px(x(i))) x2=(px(x(i))) y1=(y(0.0)) y2=(y(1.0)) {}
                    text.across x=(px(x(i))) y="12" { (safe(&axis.name)) }
                    @if axis.words.is_empty() {
                        @let numbers = axis.values.iter().flatten().all(whole);
                        @for tick in scale.ticks().into_iter().filter(|tick| !numbers || whole(tick)) {
                            text.tick x=(px(x(i) + 4.0)) y=(px(y(scale.place(tick)) + 4.0)) { (short(tick)) }
                        }
                    }
                    @for (at, word) in axis.words.iter().enumerate() {
                        text.tick x=(px(x(i) + 4.0)) y=(px(y(scale.place(at as f64)) + 4.0)) { (safe(word)) }
                    }
                }
            }
        }
    }
}

fn px(value: f64) -> String {
    format!("{value:.1}")
}

fn path(points: &[(f64, f64)]) -> String {
    let points = points.iter().map(|(x, y)| format!("{x:.1},{y:.1}"));
    points.collect::<Vec<_>>().join(" ")
}

fn whole(value: &f64) -> bool {
    value.fract() == 0.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_axis_has_round_ticks_within_its_range_and_is_logarithmic_over_decades() {
        let linear = Axis::over([0.3, 9.7].into_iter(), true);
        assert!(linear.log, "a factor of 32");
        let linear = Axis::over([2.0, 9.7, f64::NAN].into_iter(), true);
        assert!(!linear.log);
        assert_eq!(linear.ticks(), [2.0, 4.0, 6.0, 8.0]);
        let log = Axis::over([1e-4, 1e-1].into_iter(), true);
        let powers: Vec<i32> = log
            .ticks()
            .iter()
            .map(|x| x.log10().round() as i32)
            .collect();
        assert_eq!(powers, [-4, -3, -2, -1]);
        assert!((log.place(1e-2) - 2.0 / 3.0).abs() < 1e-9);
        let one = Axis::over([5.0].into_iter(), true);
        assert!((one.place(5.0) - 0.5).abs() < 1e-9);
    }

    #[test]
    fn values_that_are_not_finite_are_not_drawn() {
        let series = |points| Series {
            label: "<a>".into(),
            class: "best",
            points,
        };
        let drawn = lines(
            "x",
            ["epoch", "m"],
            &[series(vec![(1.0, 2.0), (2.0, f64::NAN), (3.0, 1.0)])],
        );
        let drawn = drawn.into_string();
        assert!(
            !drawn.contains("NaN") && drawn.contains("&lt;a&gt;"),
            "{drawn}"
        );
        assert_eq!(drawn.matches("polyline").count(), 2, "opened and closed");
        let none = lines("x", ["epoch", "m"], &[series(vec![(1.0, f64::INFINITY)])]);
        assert!(none.into_string().contains("No figures yet"));
    }
}
