//! The form in which the state of a fit is stored: eight bytes for format and version, a
//! fingerprint of the inputs, and little-endian numbers. The grid's fit and PlatoNeRF's share it.

use crate::ReconstructError;

/// The running means of gradients and of their squares (Kingma and Ba 2015).
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Moments {
    /// The mean of the gradients.
    pub first: Vec<f32>,
    /// The mean of their squares.
    pub second: Vec<f32>,
}

impl Moments {
    /// Returns the moments of `count` values before the first step.
    pub fn new(count: usize) -> Self {
        Self {
            first: vec![0.0; count],
            second: vec![0.0; count],
        }
    }
}

/// A hash of a fit's inputs (FNV-1a).
#[derive(Debug, Clone)]
pub struct Fingerprint(u64);

impl Default for Fingerprint {
    fn default() -> Self {
        Self(0xcbf2_9ce4_8422_2325)
    }
}

impl Fingerprint {
    /// Adds bytes of the inputs.
    pub fn take(&mut self, bytes: &[u8]) {
        for byte in bytes {
            self.0 = (self.0 ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01b3);
        }
    }

    /// Returns the hash.
    pub fn value(&self) -> u64 {
        self.0
    }
}

/// Returns the beginning of a stored state.
pub fn header(magic: &[u8; 8], fingerprint: u64) -> Vec<u8> {
    let mut bytes = magic.to_vec();
    bytes.extend(fingerprint.to_le_bytes());
    bytes
}

/// Appends numbers to a stored state.
pub fn put(bytes: &mut Vec<u8>, values: &[f32]) {
    bytes.extend(values.iter().flat_map(|v| v.to_le_bytes()));
}

/// Returns part `part` of the numbers in a stored state, each part with `count` numbers.
///
/// # Panics
/// If there are fewer numbers.
pub fn part(words: &[[u8; 4]], part: usize, count: usize) -> Vec<f32> {
    let words = &words[part * count..(part + 1) * count];
    words.iter().map(|w| f32::from_le_bytes(*w)).collect()
}

/// Returns the bytes after the header of a stored state.
///
/// # Errors
/// [`ReconstructError::Invalid`] for a state of another version or of other inputs.
pub fn body<'a>(
    magic: &[u8; 8],
    fingerprint: u64,
    state: &'a [u8],
) -> Result<&'a [u8], ReconstructError> {
    let bad = |what: &str| ReconstructError::invalid("checkpoint", what);
    let rest = state.strip_prefix(magic);
    let rest = rest.ok_or_else(|| bad("is none, or of another version; begin anew"))?;
    let (found, rest) = rest.split_first_chunk().ok_or_else(cut_off)?;
    match u64::from_le_bytes(*found) == fingerprint {
        true => Ok(rest),
        false => Err(bad(
            "is of other measurements or settings; give those it was made with",
        )),
    }
}

/// Returns the error for a stored state that ends too early.
pub fn cut_off() -> ReconstructError {
    ReconstructError::invalid("checkpoint", "is cut off; begin anew")
}
