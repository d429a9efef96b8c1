//! The tile of a pass.

/// The position of a pass: the tile's first pixel and its columns, the image's width, and the pass
/// number.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Tile<'a> {
    pub row: u32,
    pub col: u32,
    pub cols: u32,
    pub width: u32,
    pub seed: u64,
    pub pass: u64,
    /// Pixels that may see a near-mirror, row-major, of the whole image. They are chosen without
    /// any sample.
    pub mirrors: &'a [bool],
}
