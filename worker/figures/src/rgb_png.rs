//! PNG encoding.

/// Encodes an 8-bit RGB PNG of `width` × `height` pixels, rows from the top.
///
/// # Panics
/// If `rgb` does not have three bytes per pixel, or there is no pixel.
pub fn rgb_png(width: u32, height: u32, rgb: &[u8]) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, width, height);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_compression(png::Compression::Fast);
    encoder.set_filter(png::Filter::Adaptive);
    let written = encoder.write_header().and_then(|mut writer| {
        writer.write_image_data(rgb)?;
        writer.finish()
    });
    written.expect("memory takes every image whose size fits its pixels");
    bytes
}
