//! A reconstruction's state as bytes, for resuming later or elsewhere. Only the state of the
//! optimisation is stored; the earlier steps are repeated in a few seconds with the same bits.

use crate::{
    Measured, Progress, ReconstructError, Reconstruction, Settings, reconstruction::Saved,
};

/// The first bytes of a checkpoint: its format and version.
const MAGIC: &[u8; 8] = b"pfrecon2";

impl Reconstruction {
    /// Returns the state as bytes: little-endian, a few MB.
    pub fn checkpoint(&self) -> Vec<u8> {
        let mut out = MAGIC.to_vec();
        out.extend(self.fingerprint().to_le_bytes());
        let Some(saved) = self.saved() else {
            return out;
        };
        out.extend(saved.done.to_le_bytes());
        out.extend(saved.misses.to_le_bytes());
        out.extend(saved.settles.unwrap_or(u32::MAX).to_le_bytes());
        out.extend(saved.loss.to_le_bytes());
        out.extend(saved.held_out.to_le_bytes());
        for values in [&saved.logits, &saved.first, &saved.second] {
            out.extend(values.iter().flat_map(|v| v.to_le_bytes()));
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
        let bad = |what: &str| ReconstructError::invalid("checkpoint", what);
        let mut begun = Self::begin(measured, settings, progress)?;
        let rest = checkpoint.strip_prefix(MAGIC);
        let rest = rest.ok_or_else(|| bad("is none, or of another version; begin anew"))?;
        let (print, rest) = rest
            .split_first_chunk()
            .ok_or_else(|| bad("is cut off; begin anew"))?;
        if u64::from_le_bytes(*print) != begun.fingerprint() {
            return Err(bad(
                "is of other measurements or settings; give those it was made with",
            ));
        }
        if rest.is_empty() {
            return Ok(begun);
        }
        let nodes = begun.trainable_nodes().len();
        if rest.len() != 28 + 12 * nodes {
            return Err(bad("is cut off; begin anew"));
        }
        let cut = || bad("is cut off; begin anew");
        let (done, rest) = rest.split_first_chunk().ok_or_else(cut)?;
        let (misses, rest) = rest.split_first_chunk().ok_or_else(cut)?;
        let (settles, rest) = rest.split_first_chunk().ok_or_else(cut)?;
        let (loss, rest) = rest.split_first_chunk().ok_or_else(cut)?;
        let (held_out, rest) = rest.split_first_chunk().ok_or_else(cut)?;
        let settles = u32::from_le_bytes(*settles);
        let (words, _) = rest.as_chunks::<4>();
        let values = |part: usize| -> Vec<f32> {
            let part = &words[part * nodes..(part + 1) * nodes];
            part.iter().map(|w| f32::from_le_bytes(*w)).collect()
        };
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

    /// Returns the FNV-1a hash of the optimisation's inputs.
    fn fingerprint(&self) -> u64 {
        let mut hash = 0xcbf2_9ce4_8422_2325u64;
        let mut take = |x: u32| {
            for byte in x.to_le_bytes() {
                hash = (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01b3);
            }
        };
        let settings = self.settings();
        take(settings.iterations);
        take(settings.batch);
        take(settings.seed as u32);
        take((settings.seed >> 32) as u32);
        for &i in self.trainable_nodes() {
            take(i);
            take(self.start_field().logit[i as usize].to_bits());
        }
        hash
    }
}
