//! Images of the release's layout: OpenEXR and 8-bit PNG.

use std::io::Cursor;
use std::path::Path;

use super::ImportError;

#[cfg(feature = "formats")]
pub(super) use super::exr::{exr, exr_size};
#[cfg(not(feature = "formats"))]
pub(super) use super::without_formats::{exr, exr_size};

/// A channel of an OpenEXR file, `[row][column]`.
#[derive(Debug, Clone)]
pub(super) struct Channel {
    pub name: String,
    /// `half`, `float` or `uint`.
    pub stored: &'static str,
    pub values: Vec<f32>,
}

/// An OpenEXR file.
#[derive(Debug, Clone)]
pub(super) struct Exr {
    pub width: usize,
    pub height: usize,
    /// Name of the compression.
    pub compression: String,
    pub channels: Vec<Channel>,
}

/// Reads the first channel of an 8-bit PNG of `width` × `height` pixels, which may be grey. An
/// image of another size is refused before decompression.
pub(super) fn png(
    file: &Path,
    bytes: &[u8],
    (width, height): (usize, usize),
) -> Result<Vec<u8>, ImportError> {
    let hint = "save it again as an 8-bit grey PNG";
    let failed = |e: png::DecodingError| ImportError::unreadable(file, e, hint);
    let mut decoder = png::Decoder::new(Cursor::new(bytes));
    decoder.set_transformations(png::Transformations::EXPAND | png::Transformations::STRIP_16);
    let mut reader = decoder.read_info().map_err(failed)?;
    let size = reader.info().size();
    if (size.0 as usize, size.1 as usize) != (width, height) {
        let expected = format!("{width}x{height}, as depth.exr");
        let found = format!("{}x{}", size.0, size.1);
        let hint = "see whether the files belong together";
        return Err(ImportError::refused(file, "size", expected, found, hint));
    }
    let size = reader.output_buffer_size();
    let mut buffer = vec![0; size.filter(|n| *n <= 1 << 30).unwrap_or(0)];
    let info = reader.next_frame(&mut buffer).map_err(failed)?;
    let samples = info.color_type.samples();
    let values = buffer[..info.buffer_size()]
        .chunks_exact(samples)
        .map(|pixel| pixel[0])
        .collect();
    Ok(values)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_png_of_another_size_is_refused_before_it_is_unpacked() {
        let mut bytes = Vec::new();
        let mut encoder = png::Encoder::new(&mut bytes, 8192, 8192);
        encoder.set_color(png::ColorType::Grayscale);
        let mut writer = encoder.write_header().unwrap();
        writer.write_image_data(&vec![0; 8192 * 8192]).unwrap();
        writer.finish().unwrap();
        assert!(bytes.len() < 1 << 18, "{}", bytes.len());
        let said = png(Path::new("a.png"), &bytes, (4, 4))
            .unwrap_err()
            .to_string();
        assert!(said.contains("8192x8192") && said.contains("4x4"), "{said}");
    }
}
