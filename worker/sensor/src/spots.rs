//! Multiplexing: all spots flash at once, so their histograms add up.

use picofarm_settings::SensorError;

/// The 25 of the 100 spots of a 10×10 grid (row by row) that 25 beams light: rows 0, 2, 4, 6, 8 and
/// columns 1, 3, 5, 7, 9.
pub const SPOTS_25_OF_100: [usize; 25] = {
    let mut spots = [0; 25];
    let mut i = 0;
    while i < 25 {
        spots[i] = i / 5 * 20 + i % 5 * 2 + 1;
        i += 1;
    }
    spots
};

/// The 4 of the 100 spots of a 10×10 grid that 4 beams light.
pub const SPOTS_4_OF_100: [usize; 4] = [22, 27, 72, 77];

/// Returns h(p, b) = Σ h_i(p, b) over the spots i in `chosen`, summed as f64 in that order.
///
/// `per_spot` is `[spot][pixel][bin]` (or any `[spot][…]`) with `spots` spots; the result has the
/// shape of one of them. A spot chosen twice counts twice.
///
/// # Errors
/// Returns [`SensorError::Invalid`] if `per_spot` does not divide into `spots`, or a chosen spot is
/// not among them.
///
/// # Examples
/// ```
/// // Three spots, two bins each.
/// let per_spot = [1.0, 2.0, 10.0, 20.0, 100.0, 200.0];
/// assert_eq!(picofarm_sensor::multiplex(&per_spot, 3, &[0, 2])?, [101.0, 202.0]);
/// # Ok::<(), picofarm_sensor::SensorError>(())
/// ```
pub fn multiplex(
    per_spot: &[f32],
    spots: usize,
    chosen: &[usize],
) -> Result<Vec<f32>, SensorError> {
    if spots == 0 || !per_spot.len().is_multiple_of(spots) {
        return Err(SensorError::new(
            "per_spot",
            format!(
                "expected equally many values for each of {spots} spots, found {} values",
                per_spot.len()
            ),
        ));
    }
    if let Some(i) = chosen.iter().position(|s| *s >= spots) {
        return Err(SensorError::new(
            format!("chosen[{i}]"),
            format!(
                "expected one of the spots 0 to {}, found {}",
                spots - 1,
                chosen[i]
            ),
        ));
    }
    let len = per_spot.len() / spots;
    let mut sum = Multiplex::new(len);
    for spot in chosen {
        sum.add(&per_spot[spot * len..][..len])?;
    }
    Ok(sum.finish())
}

/// Like [`multiplex`], for histograms that arrive one after the other.
#[derive(Debug, Clone)]
pub struct Multiplex(Vec<f64>);

impl Multiplex {
    /// Returns an empty sum of histograms of `len` values each.
    pub fn new(len: usize) -> Self {
        Self(vec![0.0; len])
    }

    /// Adds a spot's histogram.
    ///
    /// # Errors
    /// Returns [`SensorError::Invalid`] if its number of values differs.
    pub fn add(&mut self, h: &[f32]) -> Result<(), SensorError> {
        if h.len() != self.0.len() {
            return Err(SensorError::new(
                "per_spot",
                format!(
                    "expected {} values of each spot, found {}",
                    self.0.len(),
                    h.len()
                ),
            ));
        }
        for (sum, h) in self.0.iter_mut().zip(h) {
            *sum += f64::from(*h);
        }
        Ok(())
    }

    /// Returns the sum.
    pub fn finish(self) -> Vec<f32> {
        self.0.into_iter().map(|sum| sum as f32).collect()
    }
}
