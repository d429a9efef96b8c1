//! PNG encoding.

/// Encodes an 8-bit RGB PNG of `width` × `height` pixels, rows from the top.
///
/// # Panics
/// If `rgb` does not have three bytes per pixel, or there is no pixel.
pub fn rgb_png(width: u32, height: u32, rgb: &[u8]) -> Vec<u8> {
    encode(width, height, rgb, None)
}

/// Like [`rgb_png`], for a picture with this many pixels in a metre.
///
/// # Panics
/// As [`rgb_png`].
pub fn rgb_png_with_density(width: u32, height: u32, rgb: &[u8], per_metre: u32) -> Vec<u8> {
    let density = png::PixelDimensions {
        xppu: per_metre,
        yppu: per_metre,
        unit: png::Unit::Meter,
    };
    encode(width, height, rgb, Some(density))
}

fn encode(width: u32, height: u32, rgb: &[u8], density: Option<png::PixelDimensions>) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, width, height);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_compression(png::Compression::Fast);
    encoder.set_filter(png::Filter::Adaptive);
    encoder.set_pixel_dims(density);
    let written = encoder.write_header().and_then(|mut writer| {
        writer.write_image_data(rgb)?;
        writer.finish()
    });
    written.expect("memory takes every image whose size fits its pixels");
    bytes
}
