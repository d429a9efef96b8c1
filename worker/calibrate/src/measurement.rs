//! The input: a capture, its per-spot histograms, masks and pulses.

use picofarm_demultiplex::{Capture, DemultiplexError};

/// A measured capture and its calibration as the laboratory states it.
#[derive(Debug, Clone, Copy)]
pub struct Measurement<'a> {
    /// The histogram of all spots together and the stated calibration.
    pub capture: Capture<'a>,
    /// The histogram of each spot alone, `[spot][row][column][bin]`, in the unit of the sum; `None`
    /// if the spots were measured at once.
    pub per_spot: Option<&'a [f32]>,
    /// Stated masks, `[spot][row][column]`: 1 = the spot lights the pixel.
    pub masks: Option<&'a [u8]>,
    /// Laser pulses in each histogram, if known. Pile-up is corrected with it.
    pub pulses: Option<u64>,
}

impl Measurement<'_> {
    pub(crate) fn pixels(&self) -> usize {
        self.capture.pixels()
    }

    pub(crate) fn bins(&self) -> usize {
        self.capture.gate.bins as usize
    }

    pub(crate) fn width(&self) -> usize {
        self.capture.camera.intrinsics.width as usize
    }

    /// Checks everything that the calibration relies on.
    ///
    /// # Errors
    /// Returns [`CalibrateError::Invalid`] for the first argument that cannot be used.
    pub fn check(&self) -> Result<(), CalibrateError> {
        self.capture.check()?;
        let spots = self.capture.spots.len();
        if let Some(h) = self.per_spot {
            let cells = self.pixels() * self.bins();
            if h.len() != spots * cells {
                let what = format!(
                    "has {} values, expected {spots} spots x {} pixels x {} bins = {}",
                    h.len(),
                    self.pixels(),
                    self.bins(),
                    spots * cells
                );
                return Err(CalibrateError::invalid("per_spot", what));
            }
            if let Some(k) = h.iter().position(|x| !x.is_finite()) {
                let what = format!(
                    "is {} at spot {}, pixel {}, bin {}; expected finite values",
                    h[k],
                    k / cells,
                    k % cells / self.bins(),
                    k % self.bins()
                );
                return Err(CalibrateError::invalid("per_spot", what));
            }
        }
        if let Some(masks) = self.masks
            && masks.len() != spots * self.pixels()
        {
            let what = format!(
                "has {} values, expected {spots} spots x {} pixels",
                masks.len(),
                self.pixels()
            );
            return Err(CalibrateError::invalid("masks", what));
        }
        if self.pulses == Some(0) {
            let what = "is 0, expected the number of laser pulses in a histogram, or none";
            return Err(CalibrateError::invalid("pulses", what));
        }
        Ok(())
    }
}

/// The reason why a capture cannot be checked.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum CalibrateError {
    /// An argument is unusable.
    #[error("{argument}: {what}")]
    Invalid {
        /// The argument, e.g. `per_spot`.
        argument: String,
        /// What was found, what was expected, and how to correct it.
        what: String,
    },
    /// The capture cannot be used by the physical method either.
    #[error(transparent)]
    Capture(#[from] DemultiplexError),
}

impl CalibrateError {
    pub(crate) fn invalid(argument: impl Into<String>, what: impl Into<String>) -> Self {
        Self::Invalid {
            argument: argument.into(),
            what: what.into(),
        }
    }
}
