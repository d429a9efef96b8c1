//! Zarr's sharding format: inner chunks one after another, then an index of (offset, size) pairs.
//!
//! zarrs' own sharding codec writes inner chunks in the order in which threads finish them, and
//! requires the whole shard in one buffer of codes. This module writes them in a fixed order and
//! encodes each inner chunk directly from the floats, so the bytes depend only on the values. zarrs
//! and zarr-python can read the result.

use std::ops::Range;

use crate::coding::codec::ChunkCodec;
use picofarm_store::StorageError;

/// (offset, size) of an inner chunk; `None` = all fill value.
pub type IndexEntry = Option<Range<u64>>;

/// Returns the size in bytes of an index of `chunks` entries, including its crc32c.
pub fn index_len(chunks: usize) -> usize {
    chunks * 16 + 4
}

/// Joins encoded inner chunks with the index of `count` entries. Each chunk comes with its place in
/// the index; its bytes follow those of the chunk before it. Places without a chunk are all fill
/// value.
///
/// # Errors
/// [`StorageError::Codec`].
pub fn assemble<'a>(
    count: usize,
    chunks: impl Iterator<Item = (usize, &'a [u8])> + Clone,
) -> Result<Vec<u8>, StorageError> {
    let payload: usize = chunks.clone().map(|(_, chunk)| chunk.len()).sum();
    let mut shard = Vec::with_capacity(payload + index_len(count));
    let mut index = vec![[u64::MAX; 2]; count];
    for (place, chunk) in chunks {
        index[place] = [shard.len() as u64, chunk.len() as u64];
        shard.extend_from_slice(chunk);
    }
    shard.extend(ChunkCodec::index(count).encode(bytemuck::cast_slice(&index))?);
    Ok(shard)
}

/// Parses the index from the last [`index_len`] bytes of a shard of `shard_len` bytes.
///
/// # Errors
/// [`StorageError::Codec`] if it is damaged.
pub fn parse_index(
    tail: &[u8],
    chunks: usize,
    shard_len: u64,
) -> Result<Vec<IndexEntry>, StorageError> {
    let decoded = ChunkCodec::index(chunks).decode(tail)?;
    let limit = shard_len.saturating_sub(index_len(chunks) as u64);
    decoded
        .chunks_exact(16)
        .map(|pair| {
            let offset = u64::from_ne_bytes(pair[..8].try_into().expect("a pair has 16 bytes"));
            let size = u64::from_ne_bytes(pair[8..].try_into().expect("a pair has 16 bytes"));
            if offset == u64::MAX && size == u64::MAX {
                return Ok(None);
            }
            match offset.checked_add(size) {
                Some(end) if end <= limit => Ok(Some(offset..end)),
                _ => Err(StorageError::codec(
                    "cannot read a shard's index",
                    format!("an inner chunk at {offset} of {size} bytes lies outside the shard of {shard_len} bytes"),
                )),
            }
        })
        .collect()
}
