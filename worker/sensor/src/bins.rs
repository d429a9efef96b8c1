//! Sums over adjacent bins, cuts along the time axis, and the time-integrated image. Arrays are
//! `[pixel][bin]`.

use std::ops::Range;

use rayon::prelude::*;

use picofarm_settings::SensorError;

/// Histograms with fewer, wider bins.
#[derive(Debug, Clone, PartialEq)]
pub struct Rebinned<T> {
    /// `[pixel][bin]`.
    pub data: Vec<T>,
    /// Bins per pixel.
    pub bins: usize,
    /// Bins of each pixel that remain at the end of the gate, fewer than the factor. They are
    /// dropped.
    pub dropped_bins: usize,
}

/// Sums each `factor` adjacent bins, as f64. 1502 bins by four give 375: the first 1500 are used,
/// two are dropped.
///
/// # Errors
/// Returns [`SensorError::Invalid`] if `data` is not a whole number of pixels, or `factor` is 0 or
/// above `bins`.
///
/// # Examples
/// ```
/// let pixel = [1.0, 2.0, 3.0, 4.0, 5.0];
/// let sums = picofarm_sensor::rebin(&pixel, 5, 2)?;
/// assert_eq!(sums.data, [3.0, 7.0]);
/// assert_eq!(sums.dropped_bins, 1);
/// # Ok::<(), picofarm_sensor::SensorError>(())
/// ```
pub fn rebin(data: &[f32], bins: usize, factor: usize) -> Result<Rebinned<f32>, SensorError> {
    rebinned(data, bins, factor, |group| {
        group.iter().map(|v| f64::from(*v)).sum::<f64>() as f32
    })
}

/// Like [`rebin`], for counts. A sum above `u32::MAX` saturates.
///
/// # Errors
/// Returns the errors of [`rebin`].
pub fn rebin_counts(
    data: &[u32],
    bins: usize,
    factor: usize,
) -> Result<Rebinned<u32>, SensorError> {
    rebinned(data, bins, factor, |group| {
        group.iter().fold(0u32, |sum, v| sum.saturating_add(*v))
    })
}

/// Like [`rebin`], for the standard errors of independent bins: the square root of the sum of their
/// squares.
///
/// # Errors
/// Returns the errors of [`rebin`].
pub fn rebin_errors(
    data: &[f32],
    bins: usize,
    factor: usize,
) -> Result<Rebinned<f32>, SensorError> {
    rebinned(data, bins, factor, |group| {
        group
            .iter()
            .map(|v| f64::from(*v) * f64::from(*v))
            .sum::<f64>()
            .sqrt() as f32
    })
}

fn rebinned<T: Copy + Send + Sync>(
    data: &[T],
    bins: usize,
    factor: usize,
    sum: impl Fn(&[T]) -> T + Sync,
) -> Result<Rebinned<T>, SensorError> {
    pixels(data.len(), bins)?;
    check_factor(bins, factor)?;
    let whole = bins / factor * factor;
    let data = data
        .par_chunks(bins)
        .flat_map_iter(|h| h[..whole].chunks_exact(factor).map(&sum))
        .collect();
    Ok(Rebinned {
        data,
        bins: bins / factor,
        dropped_bins: bins - whole,
    })
}

pub(crate) fn check_factor(bins: usize, factor: usize) -> Result<(), SensorError> {
    if (1..=bins).contains(&factor) {
        return Ok(());
    }
    Err(SensorError::new(
        "rebin",
        format!("expected 1 to {bins} bins (the histogram's), found {factor}"),
    ))
}

/// Returns the number of pixels of `values` values.
pub(crate) fn pixels(values: usize, bins: usize) -> Result<usize, SensorError> {
    if bins == 0 {
        return Err(SensorError::new("bins", "expected at least 1, found 0"));
    }
    if !values.is_multiple_of(bins) {
        return Err(SensorError::new(
            "transient",
            format!("expected a whole number of pixels of {bins} bins, found {values} values"),
        ));
    }
    Ok(values / bins)
}

/// Returns the bins `range` of each pixel.
///
/// # Errors
/// Returns [`SensorError::Invalid`] if `data` is not a whole number of pixels, or `range` is empty
/// or extends beyond `bins`.
pub fn crop<T: Copy + Send + Sync>(
    data: &[T],
    bins: usize,
    range: Range<usize>,
) -> Result<Vec<T>, SensorError> {
    pixels(data.len(), bins)?;
    if range.is_empty() || range.end > bins {
        return Err(SensorError::new(
            "range",
            format!("expected some of the bins 0..{bins}, found {range:?}"),
        ));
    }
    Ok(data
        .par_chunks(bins)
        .flat_map_iter(|h| h[range.clone()].iter().copied())
        .collect())
}

/// Returns Σ over the bins of each pixel, summed as f64: the image of a camera without timing.
///
/// # Errors
/// Returns [`SensorError::Invalid`] if `data` is not a whole number of pixels.
///
/// # Examples
/// ```
/// let two_pixels = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0];
/// assert_eq!(picofarm_sensor::intensity(&two_pixels, 3)?, [6.0, 15.0]);
/// # Ok::<(), picofarm_sensor::SensorError>(())
/// ```
pub fn intensity(data: &[f32], bins: usize) -> Result<Vec<f32>, SensorError> {
    pixels(data.len(), bins)?;
    Ok(data
        .par_chunks(bins)
        .map(|h| h.iter().map(|v| f64::from(*v)).sum::<f64>() as f32)
        .collect())
}
