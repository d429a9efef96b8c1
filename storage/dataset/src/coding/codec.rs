//! Encodes and decodes chunks through zarrs' codec chains, built from the stored metadata.

use std::borrow::Cow;
use std::num::NonZeroU64;

use serde_json::Value;
use zarrs::array::codec::CodecChain;
use zarrs::array::codec::api::{ArrayToBytesCodecTraits, CodecOptions};
use zarrs::array::{ArrayBytes, DataType, FillValue, data_type};

use crate::layout::arrays::{Layout, index_codecs};
use crate::layout::quantity::Element;
use picofarm_store::StorageError;

/// The codecs of one kind of chunk. They are deterministic: single-threaded per chunk, and
/// stateless.
#[derive(Debug, Clone)]
pub struct ChunkCodec {
    chain: CodecChain,
    shape: Vec<NonZeroU64>,
    data_type: DataType,
    fill: FillValue,
    len_bytes: usize,
    name: &'static str,
    /// Whether chunks are compressed by blosc, followed by a checksum of four bytes.
    blosc: bool,
}

/// Size of blosc's header: versions, flags and element size (a byte each), then the uncompressed
/// size, the block size and the compressed size.
const BLOSC_HEADER: usize = 16;

impl ChunkCodec {
    /// Returns the codec of an array's objects, or of the inner chunks of its shards.
    pub fn new(layout: &Layout) -> Self {
        let shape = layout.inner.as_ref().unwrap_or(&layout.object_shape);
        Self::for_element(
            &layout.chunk_codecs(),
            std::iter::once(1).chain(shape.iter().copied()),
            layout.element,
            layout.quantity.name(),
        )
    }

    fn for_element(
        codecs: &Value,
        shape: impl IntoIterator<Item = u64>,
        element: Element,
        name: &'static str,
    ) -> Self {
        let data_type = match element {
            Element::F32 => data_type::float32(),
            Element::U8 => data_type::uint8(),
            Element::U16 => data_type::uint16(),
            Element::I16 => data_type::int16(),
            Element::U32 => data_type::uint32(),
        };
        // The fill value is not used by these codecs; only its size must match.
        let fill = FillValue::from(vec![0u8; element.size() as usize]);
        Self::from_parts(
            codecs,
            shape,
            data_type,
            fill,
            element.size() as usize,
            name,
        )
    }

    /// Returns the codec of the index of a shard with `chunks` inner chunks.
    pub fn index(chunks: usize) -> Self {
        Self::from_parts(
            &index_codecs(),
            [chunks as u64, 2],
            data_type::uint64(),
            FillValue::from(u64::MAX),
            8,
            "shard index",
        )
    }

    /// Returns a codec of other chunks (see `render_group`).
    pub fn plain(codecs: &Value, shape: &[u64], element: Element) -> Self {
        Self::for_element(codecs, shape.iter().copied(), element, "array")
    }

    fn from_parts(
        codecs: &Value,
        shape: impl IntoIterator<Item = u64>,
        data_type: DataType,
        fill: FillValue,
        element_size: usize,
        name: &'static str,
    ) -> Self {
        let metadata: Vec<zarrs::metadata::v3::MetadataV3> =
            serde_json::from_value(codecs.clone()).expect("our own codec metadata is well formed");
        let chain =
            CodecChain::from_metadata(&metadata).expect("our own codecs are compiled into zarrs");
        let shape: Vec<NonZeroU64> = shape
            .into_iter()
            .map(|n| NonZeroU64::new(n).expect("sizes are checked to be positive"))
            .collect();
        let blosc = metadata.iter().any(|codec| codec.name() == "blosc");
        let len_bytes = shape.iter().map(|n| n.get() as usize).product::<usize>() * element_size;
        Self {
            chain,
            shape,
            data_type,
            fill,
            len_bytes,
            name,
            blosc,
        }
    }

    /// Checks that a chunk announces the size given by the array's metadata, because decoding
    /// allocates the announced size.
    fn check_announced(&self, bytes: &[u8]) -> Result<(), String> {
        if !self.blosc {
            return Ok(());
        }
        let word = |at: usize| {
            let word = bytes.get(at..at + 4)?.try_into().ok()?;
            Some(u32::from_le_bytes(word) as usize)
        };
        let header = (word(4), word(8), word(BLOSC_HEADER - 4));
        let (Some(unpacked), Some(block), Some(packed)) = header else {
            return Err("it is shorter than its header".into());
        };
        if unpacked != self.len_bytes {
            return Err(format!(
                "it announces {unpacked} bytes where the array has {}",
                self.len_bytes
            ));
        }
        if block > unpacked.max(1) || packed > bytes.len() {
            return Err("its header announces more than it holds".into());
        }
        Ok(())
    }

    /// Encodes a chunk of native-endian values.
    pub fn encode(&self, values: &[u8]) -> Result<Vec<u8>, StorageError> {
        self.chain
            .encode(
                ArrayBytes::from(Cow::Borrowed(values)),
                &self.shape,
                &self.data_type,
                &self.fill,
                &CodecOptions::default(),
            )
            .map(Cow::into_owned)
            .map_err(|e| StorageError::codec(format!("cannot encode a chunk of {}", self.name), e))
    }

    /// Decodes a chunk to native-endian values, checking its crc32c and size.
    pub fn decode(&self, bytes: &[u8]) -> Result<Vec<u8>, StorageError> {
        let fail =
            |e: String| StorageError::codec(format!("cannot decode a chunk of {}", self.name), e);
        self.check_announced(bytes).map_err(&fail)?;
        let decoded = self
            .chain
            .decode(
                Cow::Borrowed(bytes),
                &self.shape,
                &self.data_type,
                &self.fill,
                &CodecOptions::default(),
            )
            .and_then(|bytes| Ok(bytes.into_fixed()?))
            .map_err(|e| fail(e.to_string()))?;
        if decoded.len() != self.len_bytes {
            return Err(fail(format!(
                "expected {} bytes, found {}",
                self.len_bytes,
                decoded.len()
            )));
        }
        Ok(decoded.into_owned())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_chunk_that_announces_more_than_its_array_has_is_not_unpacked() {
        let codecs = crate::layout::arrays::image_codecs(Element::F32, "shuffle");
        let large = ChunkCodec::plain(&codecs, &[1 << 24], Element::F32);
        let bomb = large.encode(&vec![0; 64 << 20]).unwrap();
        assert!(bomb.len() < 1 << 20, "{}", bomb.len());
        let small = ChunkCodec::plain(&codecs, &[8], Element::F32);
        let said = small.decode(&bomb).unwrap_err().to_string();
        assert!(said.contains("announces 67108864 bytes"), "{said}");
        let whole = small.encode(&[1; 32]).unwrap();
        assert_eq!(small.decode(&whole).unwrap(), [1; 32]);
        for cut in 0..whole.len() {
            assert!(small.decode(&whole[..cut]).is_err());
        }
    }
}
