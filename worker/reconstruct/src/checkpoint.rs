//! A reconstruction's state as bytes, for resuming later or elsewhere. Only the state of the
//! optimisation is stored; the earlier steps are repeated in a few seconds with the same bits.

use crate::{
    Measured, Progress, ReconstructError, Reconstruction, Settings,
    reconstruction::Saved,
    saved::{self, Fingerprint},
};

/// The first bytes of a checkpoint: its format and version.
const MAGIC: &[u8; 8] = b"pfrecon2";

impl Reconstruction {
    /// Returns the state as bytes: little-endian, a few MB.
    pub fn checkpoint(&self) -> Vec<u8> {
        let mut out = saved::header(MAGIC, self.fingerprint());
        let Some(state) = self.saved() else {
            return out;
        };
        out.extend(state.done.to_le_bytes());
        out.extend(state.misses.to_le_bytes());
        out.extend(state.settles.unwrap_or(u32::MAX).to_le_bytes());
        out.extend(state.loss.to_le_bytes());
        out.extend(state.held_out.to_le_bytes());
        for values in [&state.logits, &state.first, &state.second] {
            saved::put(&mut out, values);
        }
        out
    }

    /// Resumes from a checkpoint of the same measurements and settings.
    ///
    /// # Errors
    /// [`ReconstructError::Invalid`] for bytes that are not a checkpoint of these; otherwise as for
    /// [`Reconstruction::begin`].
    pub fn resume(
        measured: Measured,
        settings: Settings,
        checkpoint: &[u8],
        progress: &dyn Progress,
    ) -> Result<Self, ReconstructError> {
        let mut begun = Self::begin(measured, settings, progress)?;
        let rest = saved::body(MAGIC, begun.fingerprint(), checkpoint)?;
        if rest.is_empty() {
            return Ok(begun);
        }
        let nodes = begun.trainable_nodes().len();
        if rest.len() != 28 + 12 * nodes {
            return Err(saved::cut_off());
        }
        let cut = saved::cut_off;
        let (done, rest) = rest.split_first_chunk().ok_or_else(cut)?;
        let (misses, rest) = rest.split_first_chunk().ok_or_else(cut)?;
        let (settles, rest) = rest.split_first_chunk().ok_or_else(cut)?;
        let (loss, rest) = rest.split_first_chunk().ok_or_else(cut)?;
        let (held_out, rest) = rest.split_first_chunk().ok_or_else(cut)?;
        let settles = u32::from_le_bytes(*settles);
        let (words, _) = rest.as_chunks::<4>();
        let values = |part| saved::part(words, part, nodes);
        begun.set_saved(Saved {
            done: u32::from_le_bytes(*done),
            loss: f64::from_le_bytes(*loss),
            held_out: f64::from_le_bytes(*held_out),
            misses: u32::from_le_bytes(*misses),
            settles: (settles != u32::MAX).then_some(settles),
            logits: values(0),
            first: values(1),
            second: values(2),
        });
        Ok(begun)
    }

    /// Returns the hash of the optimisation's inputs.
    fn fingerprint(&self) -> u64 {
        let mut hash = Fingerprint::default();
        let mut take = |x: u32| hash.take(&x.to_le_bytes());
        let settings = self.settings();
        take(settings.iterations);
        take(settings.batch);
        take(settings.seed as u32);
        take((settings.seed >> 32) as u32);
        for &i in self.trainable_nodes() {
            take(i);
            take(self.start_field().logit[i as usize].to_bits());
        }
        hash.value()
    }
}
