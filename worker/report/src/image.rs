//! Pictures as PNG inside the page.

use super::colour::Rgb;

/// Returns a data URL of a picture, row by row.
///
/// # Panics
/// If the number of `pixels` does not match the size, or is 0.
pub(super) fn data_url(width: usize, height: usize, pixels: &[Rgb]) -> String {
    assert!(
        !pixels.is_empty() && pixels.len() == width * height,
        "{width}×{height} pixels"
    );
    let side = |n: usize| u32::try_from(n).expect("a picture's side fits");
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, side(width), side(height));
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    let written = encoder.write_header().and_then(|mut writer| {
        writer.write_image_data(pixels.as_flattened())?;
        writer.finish()
    });
    written.expect("memory takes every byte, and the sizes fit");
    picofarm_figures::data_url(&bytes)
}

#[cfg(test)]
mod tests {
    use base64::{Engine, engine::general_purpose::STANDARD};

    use super::*;

    #[test]
    fn a_picture_is_a_png_that_has_its_pixels() {
        let pixels = [[1, 2, 3], [250, 251, 252]];
        let url = data_url(2, 1, &pixels);
        let bytes = STANDARD
            .decode(url.strip_prefix("data:image/png;base64,").unwrap())
            .unwrap();
        let mut reader = png::Decoder::new(std::io::Cursor::new(bytes))
            .read_info()
            .unwrap();
        let mut read = vec![0; 6];
        reader.next_frame(&mut read).unwrap();
        assert_eq!(read, pixels.as_flattened());
    }
}
