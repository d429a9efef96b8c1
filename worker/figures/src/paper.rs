//! Figures for papers: a grid of panels with axes, colour bars and keys, as SVG. Lengths are points
//! (1/72 inch); the document states its width and height in millimetres.

mod curve;
mod image;
mod scale;
mod text;

use std::fmt::Write;

pub use curve::{Curve, Mark, Style};
pub use image::{Bar, Image, Key};

use text::{SIZE, label};

/// Points in a millimetre.
const POINTS: f64 = 72.0 / 25.4;
/// Room of a panel for the labels of the vertical axis.
const LEFT: f64 = 21.0;
/// Room for a colour bar or a key.
const RIGHT: f64 = 46.0;
/// Room for the title.
const TOP: f64 = 11.0;
/// Room for the labels of the horizontal axis.
const BOTTOM: f64 = 19.0;
/// The least width of a panel's image: 8 mm.
const LEAST: f64 = 8.0 * POINTS;
/// Height of a curve's panel in parts of its width.
const CURVE: f64 = 0.75;

/// One panel.
#[derive(Debug, Clone)]
pub enum Panel {
    /// A picture with pixel axes.
    Image(Image),
    /// Values over a horizontal axis.
    Curve(Curve),
}

impl Panel {
    fn title(&self) -> &str {
        match self {
            Self::Image(image) => &image.title,
            Self::Curve(curve) => &curve.title,
        }
    }

    /// Returns height over width of the area inside the axes.
    fn ratio(&self) -> f64 {
        match self {
            Self::Image(image) => image.height as f64 / image.width.max(1) as f64,
            Self::Curve(_) => CURVE,
        }
    }
}

/// The area inside a panel's axes.
#[derive(Debug, Clone, Copy)]
struct Area {
    x: f64,
    y: f64,
    width: f64,
    height: f64,
}

/// A drawn figure.
#[derive(Debug, Clone)]
pub struct Drawn {
    /// The SVG document.
    pub svg: String,
    /// Its width, millimetres.
    pub width_mm: f64,
    /// Its height, millimetres.
    pub height_mm: f64,
}

/// Returns how many columns of panels fit a width well.
pub fn columns(width_mm: f64, panels: usize) -> usize {
    ((width_mm / 42.0) as usize).clamp(1, panels.max(1))
}

/// Draws the panels row by row in a figure of this width.
///
/// # Errors
/// Returns the least width in millimetres for so many columns, if that is larger.
pub fn draw(panels: &[Panel], width_mm: f64, columns: usize) -> Result<Drawn, f64> {
    let columns = columns.max(1);
    let cell = width_mm * POINTS / columns as f64;
    let inner = cell - LEFT - RIGHT;
    if inner < LEAST {
        return Err(((LEAST + LEFT + RIGHT) * columns as f64 / POINTS).ceil());
    }
    let mut body = String::new();
    let mut y = 0.0;
    for (row, group) in panels.chunks(columns).enumerate() {
        let tallest = group.iter().map(|p| inner * p.ratio()).fold(0.0, f64::max);
        for (column, panel) in group.iter().enumerate() {
            let area = Area {
                x: column as f64 * cell + LEFT,
                y: y + TOP,
                width: inner,
                height: inner * panel.ratio(),
            };
            let letter = match panels.len() {
                1 => String::new(),
                _ => format!("({}) ", letters(row * columns + column)),
            };
            let title = format!("{letter}{}", panel.title());
            body += &label(area.x, area.y - 3.5, SIZE, "start", &title);
            match panel {
                Panel::Image(image) => image.draw(&mut body, area),
                Panel::Curve(curve) => curve.draw(&mut body, area),
            }
        }
        y += TOP + tallest + BOTTOM;
    }
    let (w, height_mm) = (width_mm * POINTS, y / POINTS);
    let mut svg = String::new();
    let _ = writeln!(
        svg,
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{width_mm}mm\" height=\"{height_mm:.3}mm\" viewBox=\"0 0 {w:.3} {y:.3}\" font-family=\"Helvetica, Arial, sans-serif\" fill=\"#000\">"
    );
    let _ = writeln!(
        svg,
        "<rect width=\"{w:.3}\" height=\"{y:.3}\" fill=\"#fff\"/>"
    );
    svg += &body;
    svg += "</svg>\n";
    Ok(Drawn {
        svg,
        width_mm,
        height_mm,
    })
}

/// Returns a, b, …, z, aa, ab, ….
fn letters(n: usize) -> String {
    let last = char::from(b'a' + (n % 26) as u8);
    match n / 26 {
        0 => last.to_string(),
        more => letters(more - 1) + &last.to_string(),
    }
}

/// Draws the frame of an area.
fn frame(body: &mut String, a: Area) {
    let _ = writeln!(
        body,
        "<rect x=\"{:.2}\" y=\"{:.2}\" width=\"{:.2}\" height=\"{:.2}\" fill=\"none\" stroke=\"#000\" stroke-width=\"0.5\"/>",
        a.x, a.y, a.width, a.height
    );
}

/// Draws a line.
fn line(body: &mut String, from: [f64; 2], to: [f64; 2], style: &str) {
    let _ = writeln!(
        body,
        "<path d=\"M{:.2} {:.2}L{:.2} {:.2}\" {style}/>",
        from[0], from[1], to[0], to[1]
    );
}

/// The style of ticks.
const THIN: &str = "stroke=\"#000\" stroke-width=\"0.5\"";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn panels_are_lettered_past_z() {
        assert_eq!([0, 25, 26, 27].map(letters), ["a", "z", "aa", "ab"]);
    }

    #[test]
    fn the_ends_of_a_bar_are_the_limits_of_its_values() {
        // A ramp of depth, and a histogram with a peak that a spot explains.
        let map = crate::viridis;
        let depth = [1.0f32, 1.5, 2.0, 2.5, 3.0, 3.5];
        let image = Image {
            title: "depth".into(),
            width: 3,
            height: 2,
            rgb: depth.iter().flat_map(|d| map((d - 1.0) / 2.5)).collect(),
            bar: Some(Bar {
                low: 1.0,
                high: 3.5,
                clipped: true,
                exponent: 1.0,
                name: "z-depth",
                unit: "m",
                map,
            }),
            keys: vec![],
            marks: vec![[1.5, 1.0]],
        };
        let labels = Image {
            title: "labels & <more>".into(),
            bar: None,
            keys: vec![Key {
                colour: [255, 0, 16],
                text: "a very long name".into(),
            }],
            ..image.clone()
        };
        let curve = Curve {
            title: "pixel (1, 0)".into(),
            range: [5.0, 9.0],
            horizontal: ("time", "ns"),
            vertical: ("light", "1/(m² sr)"),
            values: vec![0.0, 2e-5, 8e-5, 1e-5],
            marks: vec![Mark { at: 7.5, style: 0 }, Mark { at: 70.0, style: 0 }],
            styles: vec![Style {
                colour: [214, 96, 30],
                text: "lit".into(),
            }],
        };
        let panels = [
            Panel::Image(image),
            Panel::Image(labels),
            Panel::Curve(curve),
        ];
        let drawn = draw(&panels, 85.0, 2).unwrap();
        assert_eq!(drawn.svg.matches("image-rendering:pixelated").count(), 2);
        assert!(drawn.svg.contains(">1</text>") && drawn.svg.contains(">≥ 3.5</text>"));
        // The pictures themselves depend on the compressor of PNG.
        let whole = drawn.svg.split("href=\"data:").enumerate();
        let lines = whole.map(|(k, part)| match k {
            0 => part.to_owned(),
            _ => format!("href=\"…{}", &part[part.find('"').expect("a quote")..]),
        });
        insta::assert_snapshot!(lines.collect::<String>());
    }

    #[test]
    fn a_width_without_room_states_the_least_one() {
        let image = Image {
            title: "t".into(),
            width: 2,
            height: 1,
            rgb: vec![0; 6],
            bar: None,
            keys: vec![],
            marks: vec![],
        };
        let panels = [Panel::Image(image.clone()), Panel::Image(image)];
        let least = draw(&panels, 20.0, 2).unwrap_err();
        assert!(draw(&panels, least, 2).is_ok());
        assert!(draw(&panels, least - 1.1, 2).is_err());
    }
}
