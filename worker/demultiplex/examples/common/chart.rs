//! A chart in SVG: panels with a logarithmic axis of errors and series of points.
#![allow(dead_code, reason = "each example uses its part")]

use std::fmt::Write;

const INK: &str = "#333";
const COLOURS: [&str; 3] = ["#0072b2", "#d55e00", "#009e73"];
const SIZE: [f64; 2] = [860.0, 400.0];
/// Top and bottom of a panel, pixels.
const SPAN: [f64; 2] = [56.0, 330.0];

/// A series of points, (position in 0 to 1, error in metres).
pub struct Series {
    pub name: &'static str,
    pub points: Vec<(f64, f64)>,
}

/// One panel.
pub struct Panel {
    pub title: &'static str,
    /// What the horizontal axis shows.
    pub axis: &'static str,
    /// Position in 0 to 1, and text.
    pub ticks: Vec<(f64, String)>,
    pub series: Vec<Series>,
}

/// Draws panels side by side. Errors are between `least` and `most` metres.
pub fn draw(title: &str, panels: &[Panel], [least, most]: [f64; 2]) -> String {
    let [width, height] = SIZE;
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" width=\"{width}\" height=\"{height}\" \
         font-family=\"sans-serif\" font-size=\"13\">\n<title>{title}</title>\n\
         <rect width=\"{width}\" height=\"{height}\" fill=\"#ffffff\"/>\n"
    );
    let y = |error: f64| {
        let share = (error.clamp(least, most) / least).ln() / (most / least).ln();
        SPAN[1] - share * (SPAN[1] - SPAN[0])
    };
    let wide = width / panels.len() as f64;
    for (n, panel) in panels.iter().enumerate() {
        let (left, right) = (n as f64 * wide + 70.0, (n + 1) as f64 * wide - 20.0);
        let x = |position: f64| left + 16.0 + position * (right - left - 32.0);
        let mut add = |text: String| writeln!(svg, "{text}").expect("text grows");
        for error in [0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5] {
            if error < least || error > most {
                continue;
            }
            let y = y(error);
            add(format!(
                "<line x1=\"{left:.1}\" y1=\"{y:.1}\" x2=\"{right:.1}\" y2=\"{y:.1}\" stroke=\"#e4e4e4\"/>\
                 <text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\" fill=\"{INK}\">{}</text>",
                left - 8.0,
                y + 4.0,
                match error < 0.01 {
                    true => format!("{:.0} mm", error * 1e3),
                    false => format!("{:.0} cm", error * 1e2),
                }
            ));
        }
        for (position, text) in &panel.ticks {
            let x = x(*position);
            add(format!(
                "<line x1=\"{x:.1}\" y1=\"{}\" x2=\"{x:.1}\" y2=\"{}\" stroke=\"#e4e4e4\"/>\
                 <text x=\"{x:.1}\" y=\"{}\" text-anchor=\"middle\" fill=\"{INK}\">{text}</text>",
                SPAN[0],
                SPAN[1],
                SPAN[1] + 18.0
            ));
        }
        let middle = 0.5 * (left + right);
        add(format!(
            "<text x=\"{middle:.1}\" y=\"24\" text-anchor=\"middle\" fill=\"{INK}\" font-weight=\"bold\">{}</text>\
             <text x=\"{middle:.1}\" y=\"{}\" text-anchor=\"middle\" fill=\"{INK}\">{}</text>",
            panel.title,
            SPAN[1] + 40.0,
            panel.axis
        ));
        for (k, series) in panel.series.iter().enumerate() {
            let colour = COLOURS[k % COLOURS.len()];
            let points: Vec<String> = series
                .points
                .iter()
                .map(|(position, error)| format!("{:.1},{:.1}", x(*position), y(*error)))
                .collect();
            add(format!(
                "<polyline points=\"{}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"2.5\"/>",
                points.join(" ")
            ));
            for (position, error) in &series.points {
                add(format!(
                    "<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"4\" fill=\"{colour}\"/>",
                    x(*position),
                    y(*error)
                ));
            }
            let at = left + 4.0 + k as f64 * (right - left) / panel.series.len() as f64;
            add(format!(
                "<rect x=\"{at:.1}\" y=\"36\" width=\"14\" height=\"4\" fill=\"{colour}\"/>\
                 <text x=\"{:.1}\" y=\"42\" fill=\"{INK}\">{}</text>",
                at + 20.0,
                series.name
            ));
        }
    }
    svg + "</svg>\n"
}
