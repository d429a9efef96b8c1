//! A fit's state as bytes, for resuming later: weights, Adam's moments, the step, and a fingerprint
//! of the input.

use picofarm_reconstruct::{Measured, ReconstructError};

use crate::{
    adam::Moments,
    settings::{Settings, invalid},
    training::{State, Training, shape},
};

/// The first bytes of a checkpoint: its format and version.
const MAGIC: &[u8; 8] = b"pfplato1";

impl Training {
    /// Returns the state as bytes: little-endian, 24 bytes a weight of one network (12 MB at full
    /// size).
    pub fn checkpoint(&self) -> Vec<u8> {
        let state = &self.state;
        let mut out = MAGIC.to_vec();
        out.extend(self.fingerprint().to_le_bytes());
        for number in [state.step, state.draw, state.loss.to_bits()] {
            out.extend(number.to_le_bytes());
        }
        for (weights, moments) in state.weights.iter().zip(&state.moments) {
            for values in [weights, &moments.first, &moments.second] {
                out.extend(values.iter().flat_map(|v| v.to_le_bytes()));
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
        let bad = |what: &str| invalid("checkpoint", what);
        let mut begun = Self::begin(measured, settings)?;
        let rest = checkpoint
            .strip_prefix(MAGIC)
            .ok_or_else(|| bad("is none, or of another version; begin anew"))?;
        let count = shape(&settings).weights();
        let (print, rest) = rest
            .split_first_chunk()
            .ok_or_else(|| bad("is cut off; begin anew"))?;
        if u64::from_le_bytes(*print) != begun.fingerprint() {
            return Err(bad(
                "is of other measurements or settings; give those it was made with",
            ));
        }
        if rest.len() != 12 + 24 * count {
            return Err(bad("is cut off; begin anew"));
        }
        let words = rest.as_chunks::<4>().0;
        let number = |k: usize| u32::from_le_bytes(words[k]);
        let values = |part: usize| -> Vec<f32> {
            let of = &words[3 + part * count..3 + (part + 1) * count];
            of.iter().map(|w| f32::from_le_bytes(*w)).collect()
        };
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

    /// Returns the FNV-1a hash of settings and measurements.
    fn fingerprint(&self) -> u64 {
        let mut hash = 0xcbf2_9ce4_8422_2325u64;
        let mut take = |bytes: &[u8]| {
            for byte in bytes {
                hash = (hash ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01b3);
            }
        };
        take(format!("{:?}", self.settings).as_bytes());
        let m = self.pool.measured();
        take(format!("{:?}{:?}", m.camera, m.spots).as_bytes());
        take(&m.used);
        take(&m.lit);
        m.tau.iter().for_each(|t| take(&t.to_le_bytes()));
        hash
    }
}
