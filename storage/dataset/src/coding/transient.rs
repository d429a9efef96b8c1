//! Encodes single histogram images like data sets do, but without a store, for measurements.

use bytes::Bytes;

use crate::coding::codec::ChunkCodec;
use crate::coding::squareroot::EncodeError;
use crate::layout::quantity::Quantity;
use crate::layout::spec::DatasetSpec;
use crate::scenes::dataset::ArrayCodec;
use crate::scenes::encode::encode_transient;
use crate::scenes::window::Decoding;
use picofarm_store::StorageError;

/// Encodes transients as in data sets with these properties.
#[derive(Debug)]
pub struct TransientCodec {
    spec: DatasetSpec,
    array: ArrayCodec,
}

/// An encoded transient.
#[derive(Debug, Clone)]
pub struct CodedImage {
    /// The shard, which is the scene's object in a data set.
    pub shard: Bytes,
    /// The error recorded in the manifest.
    pub error: EncodeError,
    /// Saturated bins: (flat index in `[bin][row][column]`, exact value).
    pub overflow: Vec<(u64, f32)>,
    /// Photons per unit of h.
    pub scale: f32,
}

impl TransientCodec {
    /// Returns a codec for these properties.
    ///
    /// # Errors
    /// [`StorageError::Invalid`] names the property out of range.
    pub fn new(spec: &DatasetSpec) -> Result<Self, StorageError> {
        spec.check()?;
        let layout = Quantity::Transient.layout(spec);
        let codec = ChunkCodec::new(&layout);
        Ok(Self {
            spec: *spec,
            array: ArrayCodec { layout, codec },
        })
    }

    /// Encodes h, `[row][column][bin]`, on rayon threads.
    ///
    /// # Errors
    /// [`StorageError::Invalid`] if the size differs, or a value is negative or not finite.
    pub fn encode(&self, h: &[f32], scale: f32) -> Result<CodedImage, StorageError> {
        self.check(h.len())?;
        let coded = encode_transient(&self.spec, &self.array, &[h], scale)?;
        Ok(CodedImage {
            error: coded.error.finish(coded.overflow.len()),
            shard: coded.shard.into(),
            overflow: coded.overflow,
            scale,
        })
    }

    /// Decodes into `target`, on rayon threads.
    ///
    /// # Errors
    /// [`StorageError::Codec`] if the bytes are damaged; [`StorageError::Invalid`] if the target
    /// has another size.
    pub fn decode(&self, coded: &CodedImage, target: &mut [f32]) -> Result<(), StorageError> {
        self.check(target.len())?;
        let decoding = Decoding {
            spec: &self.spec,
            array: &self.array,
            scale: coded.scale,
            overflow: &coded.overflow,
        };
        match decoding.shard(&coded.shard, target)?.0 {
            true => Ok(()),
            false => Err(StorageError::codec(
                "cannot decode a transient",
                "a saturated bin has no exact value",
            )),
        }
    }

    fn check(&self, len: usize) -> Result<(), StorageError> {
        let expected = self.spec.transient_len();
        if len == expected {
            return Ok(());
        }
        let what = format!("expected {expected} values, found {len}");
        Err(StorageError::invalid("transient", what))
    }
}
