//! Plots error over time.

use std::path::Path;

use picofarm_cli::{error::Result, output::files::save};
use picofarm_figures::Canvas;

use super::{
    axes::{Axes, INK, LETTER, Span},
    ladder::Outcome,
};

const SIZE: (usize, usize) = (1000, 700);
const MARGIN: (usize, usize) = (64, 64);
const BELOW: usize = 72;
/// Wong's colours, which people with colour blindness can distinguish.
const COLOURS: [[u8; 3]; 7] = [
    [0, 114, 178],
    [213, 94, 0],
    [0, 158, 115],
    [204, 121, 167],
    [86, 180, 233],
    [230, 159, 0],
    [90, 90, 90],
];
const TARGET: [u8; 3] = [170, 170, 170];
/// Dash length of a peer's line, in pixels.
const DASH: usize = 7;

struct Line {
    name: String,
    points: Vec<(f64, f64)>,
    colour: [u8; 3],
    dash: usize,
}

/// Draws one line per scene and variant (solid, with discs, in a colour of its own) and one per
/// peer (dashed, with squares, in the colour of the scene's first variant).
///
/// # Errors
/// Fails if the file cannot be written.
pub fn draw(found: &[Outcome], targets: &[f64], path: &Path) -> Result<()> {
    let lines = lines(found);
    let points = || lines.iter().flat_map(|l| &l.points);
    let percent = |e: f64| 100.0 * e;
    let mut axes = Axes {
        canvas: Canvas::new(SIZE.0, SIZE.1, [255; 3]),
        left: MARGIN.0,
        top: MARGIN.1,
        width: SIZE.0 - MARGIN.0 - 24,
        height: SIZE.1 - MARGIN.1 - BELOW,
        x: Span::around(points().map(|p| p.0)),
        y: Span::around(
            points()
                .map(|p| p.1)
                .chain(targets.first().copied())
                .map(percent),
        ),
    };
    axes.draw("CPU seconds", "error %, median over pixels");
    for &target in targets {
        let y = axes.at(1.0, percent(target)).1;
        let ends = (axes.left as f64, (axes.left + axes.width) as f64);
        axes.line((ends.0, y), (ends.1, y), 3, TARGET);
    }
    for line in &lines {
        let at: Vec<_> = line
            .points
            .iter()
            .map(|&(t, e)| axes.at(t, percent(e)))
            .collect();
        for pair in at.windows(2) {
            axes.line(pair[0], pair[1], line.dash, line.colour);
        }
        for &p in &at {
            axes.marker(p, line.dash == 0, line.colour);
        }
    }
    legend(&mut axes, &lines);
    save(&axes.canvas, path)
}

fn lines(found: &[Outcome]) -> Vec<Line> {
    let mut lines = Vec::new();
    for scene in found {
        let name = |of: &str| format!("{} {of}", scene.scene);
        let ours = scene
            .variants
            .iter()
            .map(|v| (name(&v.name), v.points(), 0));
        let peers = scene
            .peers
            .iter()
            .enumerate()
            .map(|(i, p)| (name(&p.name), p.points(), DASH * (i + 1)));
        for (name, mut points, dash) in ours.chain(peers) {
            points.retain(|p| p.0 > 0.0 && p.1 > 0.0);
            points.sort_by(|a, b| a.0.total_cmp(&b.0));
            lines.push(Line {
                name,
                points,
                colour: COLOURS[lines.len() % COLOURS.len()],
                dash,
            });
        }
    }
    lines
}

/// Draws the legend in the upper right corner, which falling curves do not cross.
fn legend(axes: &mut Axes, lines: &[Line]) {
    const ROW: usize = 16;
    let longest = lines.iter().map(|l| l.name.chars().count()).max();
    let width = longest.unwrap_or(0) * LETTER + 48;
    let x = (axes.left + axes.width).saturating_sub(width + 12);
    let top = axes.top + 12;
    for dy in 0..lines.len() * ROW + 8 {
        for dx in 0..width {
            axes.canvas.set(x + dx, top + dy, [255; 3]);
        }
    }
    for (k, line) in lines.iter().enumerate() {
        let y = top + 4 + k * ROW;
        let (from, to) = (
            (x as f64 + 4.0, y as f64 + 4.0),
            (x as f64 + 34.0, y as f64 + 4.0),
        );
        axes.line(from, to, line.dash, line.colour);
        axes.marker(
            (x as f64 + 19.0, y as f64 + 4.0),
            line.dash == 0,
            line.colour,
        );
        axes.text(x + 42, y, &line.name, 1, INK);
    }
}
