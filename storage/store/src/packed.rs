//! Compression of objects that are read once.

/// zstd level. It is low because each such object is read only once.
const LEVEL: i32 = 1;

/// Compresses bytes with a checksum, so that a reader can detect corruption.
pub fn pack(bytes: &[u8]) -> std::io::Result<Vec<u8>> {
    let mut packer = zstd::bulk::Compressor::new(LEVEL)?;
    packer.include_checksum(true)?;
    packer.compress(bytes)
}

/// Decompresses bytes that state their size, which must be at most `most`.
pub fn unpack(packed: &[u8], most: u64) -> std::io::Result<Vec<u8>> {
    let invalid = |what: &str| std::io::Error::new(std::io::ErrorKind::InvalidData, what);
    let size = zstd::zstd_safe::get_frame_content_size(packed);
    let size = size
        .ok()
        .flatten()
        .ok_or_else(|| invalid("does not say how large it is"))?;
    picofarm_files::read_entry(zstd::Decoder::new(packed)?, size, most)
}
