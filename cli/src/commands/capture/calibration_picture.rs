//! The picture of a calibration: residuals over pixels as stated and corrected, residuals of each
//! spot, and the pulse.

use picofarm_calibrate::Checked;
use picofarm_exchange::capture::Capture;
use picofarm_figures::{Canvas, TEXT, inferno};

/// Side of a panel, pixels, and the space around it.
const SIDE: usize = 256;
const GAP: usize = 16;
const INK: [u8; 3] = [40, 40, 40];
const PAPER: [u8; 3] = [255, 255, 255];
const LINE: [u8; 3] = [200, 200, 200];
const BLUE: [u8; 3] = [0, 114, 178];
const RED: [u8; 3] = [213, 94, 0];
/// Residual of the brightest colour, bins.
const MOST_BINS: f64 = 1.0;
/// Bins of the pulse that are shown before and after its peak.
const SPAN: (f64, f64) = (4.0, 7.0);

/// Draws the picture.
pub fn draw(checked: &Checked, capture: &Capture) -> Canvas {
    let panel = SIDE + GAP;
    let mut canvas = Canvas::new(2 * panel + GAP, 2 * (panel + TEXT + 4) + GAP, PAPER);
    let place = |k: usize| {
        let top = GAP + (k / 2) * (panel + TEXT + 4);
        (GAP + (k % 2) * panel, top)
    };
    let bin = capture.gate.bin_width_m;
    let (w, h) = (capture.width as usize, capture.height as usize);
    let maps = [
        (&checked.pictures.stated_m, "stated"),
        (&checked.pictures.corrected_m, "corrected"),
    ];
    for (k, (map, name)) in maps.into_iter().enumerate() {
        let (x, y) = place(k);
        let title = format!("{name}: 0 to {:.0} mm", 1e3 * MOST_BINS * bin);
        canvas.text(x, y, &title, INK);
        canvas.image((x, y + TEXT + 4), SIDE, (w, h), |p| match map[p] {
            m if m.is_finite() => inferno((f64::from(m) / (MOST_BINS * bin)).min(1.0) as f32),
            _ => LINE,
        });
    }
    spots(&mut canvas, place(2), checked, bin);
    pulse(&mut canvas, place(3), checked);
    canvas
}

fn frame(canvas: &mut Canvas, (x, y): (usize, usize), title: &str) -> (usize, usize) {
    canvas.text(x, y, title, INK);
    let top = y + TEXT + 4;
    for k in 0..SIDE {
        for (a, b) in [(k, 0), (k, SIDE - 1), (0, k), (SIDE - 1, k)] {
            canvas.set(x + a, top + b, LINE);
        }
    }
    (x, top)
}

/// The median residual of each spot, from −1 to 1 bin; its return's as a cross.
fn spots(canvas: &mut Canvas, place: (usize, usize), checked: &Checked, bin: f64) {
    let (x, y) = frame(canvas, place, "spots: -1 to 1 bin, + return");
    let all = &checked.report.spots;
    let height = |m: f64| {
        let share = 0.5 - 0.5 * (m / bin).clamp(-1.0, 1.0);
        y + (share * (SIDE - 1) as f64).round() as usize
    };
    let middle = height(0.0);
    for k in 0..SIDE {
        canvas.set(x + k, middle, LINE);
    }
    let wide = SIDE / all.len().max(1);
    for (k, spot) in all.iter().enumerate() {
        let left = x + k * SIDE / all.len() + wide / 6;
        if let Some(m) = spot.median_m {
            let end = height(m);
            for v in middle.min(end)..=middle.max(end) {
                for u in 0..(2 * wide / 3).max(1) {
                    canvas.set(left + u, v, BLUE);
                }
            }
        }
        if let Some(m) = spot.return_m {
            canvas.cross(left + wide / 3, height(m), RED);
        }
    }
}

/// Shares of light of the returns, and the estimated pulse.
fn pulse(canvas: &mut Canvas, place: (usize, usize), checked: &Checked) {
    let pictures = &checked.pictures;
    let title = match checked.report.pulse {
        Some(p) => format!("pulse: {:.0} ps at half height", p.fwhm_ps),
        None => "no return shows the pulse".into(),
    };
    let (x, y) = frame(canvas, place, &title);
    let column = |bins: f64| {
        let share = (bins + SPAN.0) / (SPAN.0 + SPAN.1);
        (0.0..1.0)
            .contains(&share)
            .then(|| x + (share * SIDE as f64) as usize)
    };
    let row = |share: f64| y + ((1.0 - 1.2 * share.clamp(0.0, 0.8)) * (SIDE - 4) as f64) as usize;
    for k in 0..(SPAN.0 + SPAN.1) as usize {
        if let Some(column) = column(k as f64 - SPAN.0) {
            (0..SIDE).for_each(|v| canvas.set(column, y + v, LINE));
        }
    }
    if let Some(pulse) = pictures.pulse {
        let mut last: Option<usize> = None;
        for k in 0..SIDE {
            let bins = k as f64 / SIDE as f64 * (SPAN.0 + SPAN.1) - SPAN.0;
            let now = row(pulse.share(bins));
            let before = last.unwrap_or(now);
            for v in now.min(before)..=now.max(before) {
                canvas.set(x + k, v, BLUE);
            }
            last = Some(now);
        }
    }
    for [bins, share] in &pictures.pulse_samples {
        if let Some(column) = column(*bins) {
            canvas.cross(column, row(*share), RED);
        }
    }
}
