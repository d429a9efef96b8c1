//! A fit's state as bytes, for resuming later: weights, Adam's moments, the step, and a fingerprint
//! of the input.

use picofarm_reconstruct::{
    Measured, ReconstructError,
    saved::{self, Fingerprint, Moments},
};

use crate::{
    settings::Settings,
    training::{State, Training, shape},
};

/// The first bytes of a checkpoint: its format and version.
const MAGIC: &[u8; 8] = b"pfplato1";

impl Training {
    /// Returns the state as bytes: little-endian, 24 bytes a weight of one network (12 MB at full
    /// size).
    pub fn checkpoint(&self) -> Vec<u8> {
        let state = &self.state;
        let mut out = saved::header(MAGIC, self.fingerprint());
        for number in [state.step, state.draw, state.loss.to_bits()] {
            out.extend(number.to_le_bytes());
        }
        for (weights, moments) in state.weights.iter().zip(&state.moments) {
            for values in [weights, &moments.first, &moments.second] {
                saved::put(&mut out, values);
            }
        }
        out
    }

    /// Resumes from a checkpoint of the same measurements and settings.
    ///
    /// # Errors
    /// [`ReconstructError::Invalid`] for bytes that are not a checkpoint of these; otherwise as for
    /// [`Training::begin`].
    pub fn resume(
        measured: Measured,
        settings: Settings,
        checkpoint: &[u8],
    ) -> Result<Self, ReconstructError> {
        let mut begun = Self::begin(measured, settings)?;
        let count = shape(&settings).weights();
        let rest = saved::body(MAGIC, begun.fingerprint(), checkpoint)?;
        if rest.len() != 12 + 24 * count {
            return Err(saved::cut_off());
        }
        let words = rest.as_chunks::<4>().0;
        let number = |k: usize| u32::from_le_bytes(words[k]);
        let values = |part| saved::part(&words[3..], part, count);
        let moments = |network: usize| Moments {
            first: values(3 * network + 1),
            second: values(3 * network + 2),
        };
        begun.state = State {
            weights: [values(0), values(3)],
            moments: [moments(0), moments(1)],
            step: number(0),
            draw: number(1),
            loss: f32::from_bits(number(2)),
        };
        Ok(begun)
    }

    /// Returns the hash of settings and measurements.
    fn fingerprint(&self) -> u64 {
        let mut hash = Fingerprint::default();
        let mut take = |bytes: &[u8]| hash.take(bytes);
        take(format!("{:?}", self.settings).as_bytes());
        let m = self.pool.measured();
        take(format!("{:?}{:?}", m.camera, m.spots).as_bytes());
        take(&m.used);
        take(&m.lit);
        m.tau.iter().for_each(|t| take(&t.to_le_bytes()));
        hash.value()
    }
}
