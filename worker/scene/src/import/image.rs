//! Images in imported files: PNG and JPEG as textures. They are decoded once, and limits are
//! checked before any texel is decoded.

use std::{collections::BTreeMap, io::Cursor, sync::Arc};

use zune_jpeg::{
    JpegDecoder,
    zune_core::{bytestream::ZCursor, colorspace::ColorSpace, options::DecoderOptions},
};

use crate::{Texture, Wrap};

use super::quoted;

/// The greatest number of texels of all textures of one file (800 MB).
const MAX_TEXELS: u64 = 1 << 28;

/// The textures of one file, by the key that identifies them there.
#[derive(Debug)]
pub(super) struct Images<K> {
    known: BTreeMap<K, Arc<Texture>>,
    texels: u64,
}

impl<K> Default for Images<K> {
    fn default() -> Self {
        Self {
            known: BTreeMap::new(),
            texels: 0,
        }
    }
}

impl<K: Ord> Images<K> {
    /// Returns the texture called `key`, which `decode` makes on first use.
    pub(super) fn get(
        &mut self,
        key: K,
        decode: impl FnOnce() -> Result<Texture, String>,
    ) -> Result<Arc<Texture>, String> {
        if let Some(known) = self.known.get(&key) {
            return Ok(known.clone());
        }
        let texture = Arc::new(decode()?);
        self.texels += texture.texels().len() as u64;
        if self.texels > MAX_TEXELS {
            return Err(format!(
                "the textures have more than {MAX_TEXELS} texels in all; scale them down"
            ));
        }
        self.known.insert(key, texture.clone());
        Ok(texture)
    }
}

/// Decodes a PNG or JPEG image as a texture. An alpha channel is dropped, grey is copied to all
/// channels, and 16 bits are rounded to 8.
pub(super) fn decode(name: &str, bytes: &[u8], wrap: Wrap) -> Result<Texture, String> {
    let decoded = if bytes.starts_with(b"\x89PNG\r\n\x1a\n") {
        png(bytes)
    } else if bytes.starts_with(&[0xff, 0xd8, 0xff]) {
        jpeg(bytes)
    } else {
        Err(Refused::Damaged("it is neither a PNG nor a JPEG".into()))
    };
    let (size, texels) = decoded.map_err(|refused| match refused {
        Refused::Damaged(why) => {
            format!(
                "image {} is not readable ({why}); save it as 8-bit PNG or JPEG",
                quoted(name)
            )
        }
        Refused::TooLarge(why) => format!("image {}: {why}", quoted(name)),
    })?;
    Texture::new(name, size.0, size.1, texels, wrap)
}

/// Returns the size and the alpha channel of an image, or `None` if it has none.
///
/// # Errors
/// An image that cannot be read.
pub(super) fn alpha(bytes: &[u8]) -> Result<Option<Alpha>, String> {
    if !bytes.starts_with(b"\x89PNG\r\n\x1a\n") {
        return Ok(None);
    }
    let (size, samples, each) = png_samples(bytes).map_err(|refused| match refused {
        Refused::Damaged(why) | Refused::TooLarge(why) => format!("image is not readable ({why})"),
    })?;
    let alpha = samples.chunks_exact(each).map(|p| p[each - 1]);
    Ok(matches!(each, 2 | 4).then(|| (size, alpha.collect())))
}

/// Width and height, and the alpha of each pixel row by row.
pub(super) type Alpha = ((u32, u32), Vec<u8>);

enum Refused {
    Damaged(String),
    TooLarge(String),
}

/// Width and height, and 8-bit RGB row by row.
type Decoded = ((u32, u32), Vec<[u8; 3]>);

fn png(bytes: &[u8]) -> Result<Decoded, Refused> {
    let (size, samples, each) = png_samples(bytes)?;
    Ok((size, texels(&samples, each)))
}

/// Width and height, 8-bit samples row by row, and the number of samples of a pixel.
type Samples = ((u32, u32), Vec<u8>, usize);

fn png_samples(bytes: &[u8]) -> Result<Samples, Refused> {
    let damaged = |e: png::DecodingError| Refused::Damaged(e.to_string());
    let limits = png::Limits {
        bytes: 16 * Texture::MAX_TEXELS as usize,
    };
    let mut decoder = png::Decoder::new_with_limits(Cursor::new(bytes), limits);
    decoder.set_transformations(png::Transformations::EXPAND);
    let mut reader = decoder.read_info().map_err(damaged)?;
    let size = reader.info().size();
    Texture::check_size(size.0, size.1).map_err(Refused::TooLarge)?;
    let length = reader.output_buffer_size().unwrap_or(0);
    let mut samples = vec![0; length];
    let info = reader.next_frame(&mut samples).map_err(damaged)?;
    samples.truncate(info.buffer_size());
    if info.bit_depth == png::BitDepth::Sixteen {
        let rounded = |pair: &[u8; 2]| ((u32::from(u16::from_be_bytes(*pair)) + 128) / 257) as u8;
        samples = samples.as_chunks::<2>().0.iter().map(rounded).collect();
    }
    Ok((size, samples, info.color_type.samples()))
}

fn jpeg(bytes: &[u8]) -> Result<Decoded, Refused> {
    let damaged = |e: zune_jpeg::errors::DecodeErrors| Refused::Damaged(e.to_string());
    let options = DecoderOptions::default()
        .set_strict_mode(false)
        .set_max_width(usize::MAX)
        .set_max_height(usize::MAX)
        .jpeg_set_out_colorspace(ColorSpace::RGB);
    let mut decoder = JpegDecoder::new_with_options(ZCursor::new(bytes), options);
    decoder.decode_headers().map_err(damaged)?;
    let info = decoder
        .info()
        .ok_or_else(|| Refused::Damaged("it has no size".into()))?;
    let size = (u32::from(info.width), u32::from(info.height));
    Texture::check_size(size.0, size.1).map_err(Refused::TooLarge)?;
    let samples = decoder.decode().map_err(damaged)?;
    Ok((size, texels(&samples, 3)))
}

/// Converts pixels of 1 to 4 samples to texels: grey, grey and alpha, RGB, RGB and alpha.
fn texels(samples: &[u8], each: usize) -> Vec<[u8; 3]> {
    let pixels = samples.chunks_exact(each);
    match each {
        1 | 2 => pixels.map(|p| [p[0]; 3]).collect(),
        _ => pixels.map(|p| [p[0], p[1], p[2]]).collect(),
    }
}

#[cfg(test)]
mod tests {
    use image::{DynamicImage, ImageFormat};

    use super::*;

    fn written(image: &DynamicImage, format: ImageFormat) -> Vec<u8> {
        let mut bytes = Cursor::new(Vec::new());
        image.write_to(&mut bytes, format).unwrap();
        bytes.into_inner()
    }

    #[test]
    fn textures_are_what_another_decoder_reads_for_every_kind_of_pixel() {
        let rgba = image::RgbaImage::from_fn(13, 7, |x, y| {
            image::Rgba([
                (x * 19) as u8,
                (y * 36) as u8,
                (x * y * 3) as u8,
                255 - x as u8,
            ])
        });
        let all = DynamicImage::from(rgba);
        let deep = DynamicImage::from(image::Rgb32FImage::from_fn(13, 7, |x, y| {
            image::Rgb([x as f32 / 12.0, y as f32 / 6.0, (x + y) as f32 / 18.0])
        }));
        for (image, format) in [
            (all.to_rgba8().into(), ImageFormat::Png),
            (all.to_rgb8().into(), ImageFormat::Png),
            (all.to_luma8().into(), ImageFormat::Png),
            (all.to_luma_alpha8().into(), ImageFormat::Png),
            (deep.to_rgb16().into(), ImageFormat::Png),
            (deep.to_rgba16().into(), ImageFormat::Png),
            (deep.to_luma16().into(), ImageFormat::Png),
            (all.to_rgb8().into(), ImageFormat::Jpeg),
            (all.to_luma8().into(), ImageFormat::Jpeg),
        ] {
            let bytes = written(&image, format);
            let theirs = image::load_from_memory(&bytes).unwrap().into_rgb8();
            let ours = decode("a", &bytes, Wrap::Repeat).unwrap();
            assert_eq!((ours.width(), ours.height()), theirs.dimensions());
            assert_eq!(
                ours.texels().as_flattened(),
                theirs.as_raw(),
                "{:?}",
                image.color()
            );
        }
    }

    #[test]
    fn a_header_that_promises_too_much_is_refused_before_decoding() {
        let small = DynamicImage::new_rgb8(1, 1);
        let mut png = written(&small, ImageFormat::Png);
        assert!(decode("a", &png, Wrap::Repeat).is_ok());
        png[16..24].copy_from_slice(&[0, 0, 0x40, 0, 0, 0, 0x40, 0]);
        // The checksum is also wrong. Whichever fault is detected first, no large buffer is
        // allocated.
        assert!(decode("a", &png, Wrap::Repeat).is_err());
        let error = decode("a", b"no image", Wrap::Repeat).unwrap_err();
        assert!(error.contains("neither a PNG nor a JPEG"), "{error}");
        let mut jpeg = written(&small, ImageFormat::Jpeg);
        let frame = jpeg.windows(2).position(|w| w == [0xff, 0xc0]).unwrap();
        jpeg[frame + 5..frame + 9].copy_from_slice(&[0xff; 4]);
        assert!(decode("a", &jpeg, Wrap::Repeat).is_err());
        for length in 0..jpeg.len() {
            // A truncated file is refused, or read up to its end.
            let _ = decode("a", &jpeg[..length], Wrap::Repeat);
        }
    }
}
