//! The picture of one render: light summed over time, depth, the energy over time, and light in
//! flight at four times.

use picofarm_figures::{Canvas, TEXT, inferno, scene::quantile, viridis};

/// The picture to draw.
pub struct Preview<'a> {
    pub width: usize,
    pub height: usize,
    pub bins: usize,
    pub gate_start_m: f64,
    pub bin_width_m: f64,
    /// `[row][column][bin]`.
    pub transient: &'a [f32],
    /// z-depth in metres, `[row][column]`, 0 = nothing. Without it, the path of the brightest bin
    /// is drawn.
    pub depth: Option<&'a [f32]>,
}

/// The longer side of an image, pixels.
const CELL: usize = 256;
const GAP: usize = 6;
/// Most rows and columns whose histograms are drawn one by one: those of sensors with few zones.
const MOST_ZONES: usize = 16;
const HEAD: usize = TEXT + 8;
const BACKGROUND: [u8; 3] = [16, 16, 20];
const INK: [u8; 3] = [210, 210, 215];
/// Shares of the energy that have arrived at the times of the lower row.
const SHARES: [f64; 3] = [0.1, 0.4, 0.75];
/// Metres that light travels in a nanosecond.
const METRES_PER_NS: f64 = 0.299_792_458;

/// Draws the picture.
pub fn draw(p: &Preview<'_>) -> Canvas {
    let longer = p.width.max(p.height).max(1);
    let cell_height = (CELL * p.height).div_ceil(longer);
    let row = HEAD + cell_height + GAP;
    let mut canvas = Canvas::new(GAP + 3 * (CELL + GAP), 2 * row, BACKGROUND);
    let mut image = |n: usize, title: &str, colour: &dyn Fn(usize) -> [u8; 3]| {
        let (x, y) = (GAP + n % 3 * (CELL + GAP), n / 3 * row);
        canvas.text(x, y + 4, title, INK);
        let (w, h) = ((CELL * p.width).div_ceil(longer), cell_height);
        for v in 0..h {
            for u in 0..w {
                let pixel = (v * p.height / h) * p.width + u * p.width / w;
                canvas.set(x + u, y + HEAD + v, colour(pixel));
            }
        }
    };
    let sum = |lo: usize, hi: usize| -> Vec<f32> {
        let pixels = p.transient.chunks_exact(p.bins);
        pixels.map(|h| h[lo..hi].iter().sum()).collect()
    };
    let ns = |bin: usize| (p.gate_start_m + bin as f64 * p.bin_width_m) / METRES_PER_NS;
    let all = sum(0, p.bins);
    let white = quantile(&all, 0.99).max(f32::MIN_POSITIVE);
    image(0, "all light", &|i| inferno((all[i] / white).powf(0.5)));
    let (title, far_away) = match p.depth {
        Some(depth) => ("depth", depth.to_vec()),
        None => ("brightest path", brightest(p)),
    };
    let seen: Vec<f32> = far_away.iter().copied().filter(|d| *d > 0.0).collect();
    let (near, far) = (quantile(&seen, 0.001), quantile(&seen, 1.0));
    image(
        1,
        &format!("{title}, {near:.2} to {far:.2} m"),
        &|i| match far_away[i] {
            d if d > 0.0 => viridis(1.0 - (d - near) / (far - near).max(1e-6)),
            _ => BACKGROUND,
        },
    );
    // Without the brightest pixels, which the laser's spots make.
    let mut energy = vec![0.0f64; p.bins];
    for (histogram, total) in p.transient.chunks_exact(p.bins).zip(&all) {
        if *total <= white {
            for (e, x) in energy.iter_mut().zip(histogram) {
                *e += f64::from(*x);
            }
        }
    }
    let total: f64 = energy.iter().sum();
    for (n, share) in SHARES.into_iter().enumerate() {
        let mut reached = 0.0;
        let bin = energy.iter().position(|e| {
            reached += e;
            reached >= share * total
        });
        let bin = bin.unwrap_or(0);
        let slice = sum(bin.saturating_sub(1), (bin + 2).min(p.bins));
        let white = quantile(&slice, 0.995).max(f32::MIN_POSITIVE);
        image(3 + n, &format!("light at {:.2} ns", ns(bin)), &|i| {
            inferno((slice[i] / white).powf(0.6))
        });
    }
    curve(&mut canvas, &energy, cell_height, [ns(0), ns(p.bins)]);
    if longer <= MOST_ZONES && p.bins > 1 {
        // In place of the light at the last time, of which few pixels show little.
        let (x, y) = (GAP + 2 * (CELL + GAP), row);
        zones(&mut canvas, p, [x, y], cell_height);
    }
    canvas
}

/// Draws the histogram of each pixel in its place, relative to its brightest bin.
fn zones(canvas: &mut Canvas, p: &Preview<'_>, [x, y]: [usize; 2], height: usize) {
    let longer = p.width.max(p.height).max(1);
    let (wide, tall) = ((CELL * p.width).div_ceil(longer), height);
    for v in 0..HEAD + tall {
        for u in 0..CELL {
            canvas.set(x + u, y + v, BACKGROUND);
        }
    }
    canvas.text(x, y + 4, "each pixel over time", INK);
    for (pixel, h) in p.transient.chunks_exact(p.bins).enumerate() {
        let most = h.iter().fold(f32::MIN_POSITIVE, |m, x| m.max(*x));
        let (row, column) = (pixel / p.width, pixel % p.width);
        let (left, right) = (column * wide / p.width, (column + 1) * wide / p.width);
        let (top, bottom) = (row * tall / p.height, (row + 1) * tall / p.height);
        // A dark line remains between pixels.
        let (w, room) = (right - left - 1, bottom - top - 1);
        for u in 0..w {
            let lo = u * p.bins / w;
            let hi = ((u + 1) * p.bins / w).clamp(lo + 1, p.bins.max(lo + 1));
            let peak = h[lo.min(p.bins - 1)..hi.min(p.bins)]
                .iter()
                .fold(0.0f32, |m, x| m.max(*x));
            let bar = (peak.max(0.0) / most * room as f32) as usize;
            for v in 0..room {
                let colour = match room - v <= bar {
                    true => inferno(0.75),
                    false => inferno(0.08),
                };
                canvas.set(x + left + u, y + HEAD + top + v, colour);
            }
        }
    }
}

/// Returns the path of the brightest bin of each pixel in metres; 0 without light.
fn brightest(p: &Preview<'_>) -> Vec<f32> {
    let path = |h: &[f32]| {
        let first = (0..p.bins).fold(0, |best, bin| if h[bin] > h[best] { bin } else { best });
        match h[first] > 0.0 {
            true => (p.gate_start_m + (first as f64 + 0.5) * p.bin_width_m) as f32,
            false => 0.0,
        }
    };
    p.transient.chunks_exact(p.bins).map(path).collect()
}

/// Draws the energy over time in the third cell.
fn curve(canvas: &mut Canvas, energy: &[f64], height: usize, [start, end]: [f64; 2]) {
    let (x, y) = (GAP + 2 * (CELL + GAP), HEAD);
    let title = format!("light over time, {start:.1} to {end:.1} ns");
    canvas.text(x, 4, &title, INK);
    let most = energy.iter().fold(f64::MIN_POSITIVE, |m, e| m.max(*e));
    for u in 0..CELL {
        let lo = u * energy.len() / CELL;
        let hi = ((u + 1) * energy.len() / CELL).clamp(lo + 1, energy.len().max(lo + 1));
        let bins = energy.get(lo..hi).unwrap_or_default();
        let peak = bins.iter().fold(0.0f64, |m, e| m.max(*e));
        let bar = ((peak / most) * height.saturating_sub(1) as f64).round() as usize;
        for v in 0..=bar.min(height.saturating_sub(1)) {
            canvas.set(x + u, y + height - 1 - v, inferno(0.75));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn few_pixels_are_drawn_with_a_histogram_each() {
        // Two pixels side by side: light in the first half of the time, and in the second.
        let transient = [4.0, 4.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0];
        let canvas = draw(&Preview {
            width: 2,
            height: 1,
            bins: 4,
            gate_start_m: 0.0,
            bin_width_m: 0.1,
            transient: &transient,
            depth: None,
        });
        let (x, y) = (GAP + 2 * (CELL + GAP), HEAD + CELL / 2 + GAP + HEAD);
        let at = |u: usize| canvas.part((x + u, y + CELL / 4), (1, 1)).unwrap().png();
        let [lit, dark] = [0.75, 0.08].map(|share| Canvas::new(1, 1, inferno(share)).png());
        assert_eq!([at(30), at(100)], [lit.clone(), dark.clone()]);
        assert_eq!([at(CELL / 2 + 30), at(CELL / 2 + 100)], [dark, lit]);
    }

    #[test]
    fn pictures_of_any_shape_and_of_darkness_are_drawn() {
        for (width, height, bins) in [(1, 1, 1), (7, 3, 5), (3, 40, 300)] {
            for (light, known) in [(0.0, true), (1.0, true), (0.0, false), (1.0, false)] {
                let transient = vec![light; width * height * bins];
                let depth = vec![light; width * height];
                let canvas = draw(&Preview {
                    width,
                    height,
                    bins,
                    gate_start_m: 1.0,
                    bin_width_m: 0.1,
                    transient: &transient,
                    depth: known.then_some(&depth[..]),
                });
                assert!(Canvas::from_png(&canvas.png()).is_ok());
            }
        }
    }
}
