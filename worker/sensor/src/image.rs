//! What needs an image with a time axis: zones, crosstalk, and the detector's gate.

use std::borrow::Cow;

use picofarm_settings::{Crosstalk, Gate, Sensor, SensorError, Zones};
use rayon::prelude::*;

use crate::{bins::pixels, resample::Resampler, sense::Histograms};

/// Where the pixels and bins of histograms are.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Frame {
    /// Pixels in a row.
    pub width: usize,
    /// Time at which bin 0 starts, picoseconds after the pulse: [`crate::PS_PER_M`] times the path.
    pub start_ps: f64,
}

/// Histograms as the detector's pixels receive them.
pub(crate) struct Received<'a> {
    pub transient: Cow<'a, [f32]>,
    pub two_bounce: Option<Cow<'a, [f32]>>,
    /// Pixels in a row.
    pub width: usize,
}

/// Returns the detector's gate as a resampler of bins, if it has one.
pub(crate) fn gate(
    sensor: &Sensor,
    frame: &Frame,
    bins: usize,
    width_ps: f64,
) -> Result<Option<Resampler>, SensorError> {
    let Some(own) = sensor.gate else {
        return Ok(None);
    };
    // The resampler knows no unit; these are picoseconds.
    let axis = |start_m: f64, bin_width_m: f64, bins: u32| Gate {
        start_m,
        bin_width_m,
        bins,
    };
    let from = axis(frame.start_ps, width_ps, bins as u32);
    let to = axis(own.start_ps, own.bin_width_ps, own.bins);
    Resampler::new(&from, &to, 1.0, 0.0).map(Some)
}

/// Returns the histograms of the detector's pixels.
pub(crate) fn received<'a>(
    sensor: &Sensor,
    h: &Histograms<'a>,
    frame: &Frame,
) -> Result<Received<'a>, SensorError> {
    let all = pixels(h.transient.len(), h.bins)?;
    let width = frame.width;
    if width == 0 || !all.is_multiple_of(width) {
        return Err(SensorError::new(
            "width",
            format!(
                "expected whole rows of an image of {all} pixels, found {width} pixels in a row"
            ),
        ));
    }
    let Some(zones) = sensor.zones else {
        return Ok(Received {
            transient: Cow::Borrowed(h.transient),
            two_bounce: h.two_bounce.map(Cow::Borrowed),
            width,
        });
    };
    let (rows, columns) = (zones.rows as usize, zones.columns as usize);
    let height = all / width;
    if !height.is_multiple_of(rows) || !width.is_multiple_of(columns) || all == 0 {
        return Err(SensorError::new(
            "sensor.zones",
            format!(
                "{rows}x{columns} zones do not divide the image of {height}x{width} pixels (rows x columns); \
                 render with multiples of {rows} rows and {columns} columns, or choose other zones"
            ),
        ));
    }
    let mean = mean_of_zones(h.transient, h.bins, width, zones);
    Ok(Received {
        transient: Cow::Owned(mean),
        two_bounce: None,
        width: columns,
    })
}

/// Returns the means over zones, `[zone][bin]`, summed as f64 in the order of the pixels.
fn mean_of_zones(h: &[f32], bins: usize, width: usize, zones: Zones) -> Vec<f32> {
    let (rows, columns) = (zones.rows as usize, zones.columns as usize);
    let (tall, wide) = (h.len() / bins / width / rows, width / columns);
    let share = 1.0 / (tall * wide) as f64;
    let mut out = vec![0.0f32; rows * columns * bins];
    out.par_chunks_mut(bins).enumerate().for_each_init(
        || vec![0.0f64; bins],
        |sums, (zone, out)| {
            sums.fill(0.0);
            for row in 0..tall {
                let first = ((zone / columns * tall + row) * width + zone % columns * wide) * bins;
                for pixel in h[first..first + wide * bins].chunks_exact(bins) {
                    for (sum, h) in sums.iter_mut().zip(pixel) {
                        *sum += f64::from(*h);
                    }
                }
            }
            for (out, sum) in out.iter_mut().zip(sums.iter()) {
                *out = (sum * share) as f32;
            }
        },
    );
    out
}

/// The neighbours above, below, left and right of a pixel.
pub(crate) fn neighbours(pixel: usize, pixels: usize, width: usize) -> impl Iterator<Item = usize> {
    let column = pixel % width;
    [
        (pixel >= width).then(|| pixel - width),
        (pixel + width < pixels).then_some(pixel + width),
        (column > 0).then(|| pixel - 1),
        (column + 1 < width).then_some(pixel + 1),
    ]
    .into_iter()
    .flatten()
}

/// Adds the light of the neighbours to each pixel.
pub(crate) fn with_crosstalk(
    h: &[f32],
    bins: usize,
    width: usize,
    crosstalk: Crosstalk,
) -> Vec<f32> {
    let all = h.len() / bins;
    let k = crosstalk.probability;
    let mut out = vec![0.0f32; h.len()];
    out.par_chunks_mut(bins).enumerate().for_each_init(
        || vec![0.0f64; bins],
        |sums, (pixel, out)| {
            sums.fill(0.0);
            for other in neighbours(pixel, all, width) {
                for (sum, h) in sums.iter_mut().zip(&h[other * bins..]) {
                    *sum += f64::from(*h);
                }
            }
            let own = &h[pixel * bins..];
            for ((out, own), sum) in out.iter_mut().zip(own).zip(sums.iter()) {
                *out = (f64::from(*own) + k * sum) as f32;
            }
        },
    );
    out
}
