//! Animated GIFs.

/// Encodes an animation of frames of `size` (w, h), at most 65,535 per side. A frame has an index
/// into `palette` (r, g, b of 256 colours) per pixel, row by row. Each frame is shown for `delay`
/// hundredths of a second, in an endless loop.
///
/// # Panics
/// If a frame does not have w·h pixels, or the size is 0 or too large.
pub fn animation(
    size: (usize, usize),
    palette: &[u8],
    delay: u16,
    frames: &mut dyn Iterator<Item = Vec<u8>>,
) -> Vec<u8> {
    let side = |n: usize| u16::try_from(n).expect("a side of at most 65,535 pixels");
    let (width, height) = (side(size.0), side(size.1));
    let mut bytes = Vec::new();
    let memory = "memory takes every byte, and frames are as large as said";
    {
        let mut encoder = gif::Encoder::new(&mut bytes, width, height, palette).expect(memory);
        encoder.set_repeat(gif::Repeat::Infinite).expect(memory);
        for buffer in frames {
            assert_eq!(buffer.len(), size.0 * size.1, "pixels of a frame");
            let frame = gif::Frame {
                width,
                height,
                delay,
                buffer: buffer.into(),
                ..gif::Frame::default()
            };
            encoder.write_frame(&frame).expect(memory);
        }
    }
    bytes
}
