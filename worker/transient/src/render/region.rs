//! A part of the image.

/// A rectangle of pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Region {
    pub row: u32,
    pub col: u32,
    pub rows: u32,
    pub cols: u32,
}

impl Region {
    pub fn pixels(&self) -> usize {
        self.rows as usize * self.cols as usize
    }
}
