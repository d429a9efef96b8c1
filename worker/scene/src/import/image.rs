//! Images in imported files: PNG, JPEG, WebP and uncompressed KTX2 as textures. They are decoded
//! once, and limits are checked before any texel is decoded.

use std::{
    collections::BTreeMap,
    io::{Cursor, Read},
    sync::Arc,
};

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

/// Decodes a PNG, JPEG, WebP or KTX2 image as a texture. An alpha channel is dropped, grey is
/// copied to all channels, and 16 bits are rounded to 8.
pub(super) fn decode(name: &str, bytes: &[u8], wrap: Wrap) -> Result<Texture, String> {
    let decoded = match samples(bytes) {
        Some(read) => read.map(|(size, samples, each)| (size, texels(&samples, each))),
        None if bytes.starts_with(&[0xff, 0xd8, 0xff]) => jpeg(bytes),
        None => Err(Refused::Damaged(
            "it is neither PNG, JPEG, WebP nor KTX2".into(),
        )),
    };
    let (size, texels) = decoded.map_err(|refused| match refused {
        Refused::Damaged(why) => {
            format!(
                "image {} is not readable ({why}); save it as 8-bit PNG or JPEG",
                quoted(name)
            )
        }
        Refused::Unusable(why) => format!("image {}: {why}", quoted(name)),
    })?;
    Texture::new(name, size.0, size.1, texels, wrap)
}

/// Returns the size and the alpha channel of an image, or `None` if it has none.
///
/// # Errors
/// An image that cannot be read.
pub(super) fn alpha(bytes: &[u8]) -> Result<Option<Alpha>, String> {
    let Some(read) = samples(bytes) else {
        return Ok(None);
    };
    let (size, samples, each) = read.map_err(|refused| match refused {
        Refused::Damaged(why) | Refused::Unusable(why) => format!("image is not readable ({why})"),
    })?;
    let alpha = samples.chunks_exact(each).map(|p| p[each - 1]);
    Ok(matches!(each, 2 | 4).then(|| (size, alpha.collect())))
}

/// Width and height, and the alpha of each pixel row by row.
pub(super) type Alpha = ((u32, u32), Vec<u8>);

enum Refused {
    Damaged(String),
    Unusable(String),
}

/// Width and height, and 8-bit RGB row by row.
type Decoded = ((u32, u32), Vec<[u8; 3]>);

/// Width and height, 8-bit samples row by row, and the number of samples of a pixel.
type Samples = ((u32, u32), Vec<u8>, usize);

/// Returns the samples of an image that may have an alpha channel, or `None` for other formats.
fn samples(bytes: &[u8]) -> Option<Result<Samples, Refused>> {
    if bytes.starts_with(b"\x89PNG\r\n\x1a\n") {
        Some(png_samples(bytes))
    } else if bytes.starts_with(b"RIFF") && bytes.get(8..12) == Some(b"WEBP") {
        Some(webp(bytes))
    } else if bytes.starts_with(b"\xabKTX 20\xbb\r\n\x1a\n") {
        Some(ktx(bytes))
    } else {
        None
    }
}

fn webp(bytes: &[u8]) -> Result<Samples, Refused> {
    let damaged = |e: image_webp::DecodingError| Refused::Damaged(e.to_string());
    let mut decoder = image_webp::WebPDecoder::new(Cursor::new(bytes)).map_err(damaged)?;
    let size = decoder.dimensions();
    Texture::check_size(size.0, size.1).map_err(Refused::Unusable)?;
    decoder.set_memory_limit(16 * Texture::MAX_TEXELS as usize);
    let mut samples = vec![0; decoder.output_buffer_size().unwrap_or(0)];
    decoder.read_image(&mut samples).map_err(damaged)?;
    Ok((size, samples, if decoder.has_alpha() { 4 } else { 3 }))
}

/// Returns the largest image of a KTX2 file with 8-bit samples, plain or deflated.
fn ktx(bytes: &[u8]) -> Result<Samples, Refused> {
    let refused = |what: &str| {
        Err(Refused::Unusable(format!(
            "{what} is not supported; `gltf-transform ktxdecompress IN OUT` converts it to PNG"
        )))
    };
    let file = ktx2::Reader::new(bytes).map_err(|e| Refused::Damaged(e.to_string()))?;
    let header = file.header();
    let (each, blue_first) = match header.format.map(|f| f.value()) {
        Some(9 | 15) => (1, false),
        Some(16 | 22) => (2, false),
        Some(23 | 29) => (3, false),
        Some(30 | 36) => (3, true),
        Some(37 | 43) => (4, false),
        Some(44 | 50) => (4, true),
        None => return refused("KTX2 with Basis Universal"),
        Some(other) => return refused(&format!("KTX2 of Vulkan format {other}")),
    };
    if header.pixel_depth > 1 || header.layer_count > 1 || header.face_count > 1 {
        return refused("KTX2 of more than one image");
    }
    let size = (header.pixel_width, header.pixel_height.max(1));
    Texture::check_size(size.0, size.1).map_err(Refused::Unusable)?;
    let length = size.0 as usize * size.1 as usize * each;
    let Some(level) = file.levels().next() else {
        return Err(Refused::Damaged("it has no image".into()));
    };
    let mut samples = match header.supercompression_scheme.map(|s| s.value()) {
        None => level.data.to_vec(),
        // Deflate, after a zlib header.
        Some(3) => {
            let mut inflated = Vec::with_capacity(length);
            flate2::read::ZlibDecoder::new(level.data)
                .take(length as u64)
                .read_to_end(&mut inflated)
                .map_err(|e| Refused::Damaged(e.to_string()))?;
            inflated
        }
        Some(_) => return refused("KTX2 with Zstandard"),
    };
    if samples.len() < length {
        return Err(Refused::Damaged("it is cut short".into()));
    }
    samples.truncate(length);
    if blue_first {
        samples.chunks_exact_mut(each).for_each(|p| p.swap(0, 2));
    }
    // Two samples are red and green here, but grey and alpha in other formats.
    if each == 2 {
        samples = samples
            .chunks_exact(2)
            .flat_map(|p| [p[0], p[1], 0])
            .collect();
        return Ok((size, samples, 3));
    }
    Ok((size, samples, each))
}

fn png_samples(bytes: &[u8]) -> Result<Samples, Refused> {
    let damaged = |e: png::DecodingError| Refused::Damaged(e.to_string());
    let limits = png::Limits {
        bytes: 16 * Texture::MAX_TEXELS as usize,
    };
    let mut decoder = png::Decoder::new_with_limits(Cursor::new(bytes), limits);
    decoder.set_transformations(png::Transformations::EXPAND);
    let mut reader = decoder.read_info().map_err(damaged)?;
    let size = reader.info().size();
    Texture::check_size(size.0, size.1).map_err(Refused::Unusable)?;
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
    Texture::check_size(size.0, size.1).map_err(Refused::Unusable)?;
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

    /// Returns a KTX2 file of 3×2 texels in a Vulkan format, with an alignment byte of 16.
    fn ktx2(format: u32, scheme: u32, data: &[u8]) -> Vec<u8> {
        let mut bytes = b"\xabKTX 20\xbb\r\n\x1a\n".to_vec();
        for number in [format, 1, 3, 2, 0, 0, 1, 1, scheme] {
            bytes.extend(number.to_le_bytes());
        }
        // The descriptor of 4 bytes, no keys, no global data, and one level.
        for number in [104u32, 4, 0, 0] {
            bytes.extend(number.to_le_bytes());
        }
        for number in [0u64, 0, 108, data.len() as u64, 24] {
            bytes.extend(number.to_le_bytes());
        }
        bytes.extend(4u32.to_le_bytes());
        bytes.extend(data);
        bytes
    }

    #[test]
    fn webp_and_ktx2_have_the_texels_that_were_written() {
        let rgba: Vec<u8> = (0..24).map(|k| k * 9).collect();
        let expected: Vec<[u8; 3]> = rgba.chunks(4).map(|p| [p[0], p[1], p[2]]).collect();
        let alphas: Vec<u8> = rgba.chunks(4).map(|p| p[3]).collect();
        let mut webp = Vec::new();
        let encoder = image_webp::WebPEncoder::new(&mut webp);
        let kind = image_webp::ColorType::Rgba8;
        encoder.encode(&rgba, 3, 2, kind).unwrap();
        let swapped: Vec<u8> = rgba
            .chunks(4)
            .flat_map(|p| [p[2], p[1], p[0], p[3]])
            .collect();
        let mut deflated = Vec::new();
        let level = flate2::Compression::fast();
        let mut encoder = flate2::write::ZlibEncoder::new(&mut deflated, level);
        std::io::Write::write_all(&mut encoder, &rgba).unwrap();
        encoder.finish().unwrap();
        for bytes in [
            webp,
            ktx2(37, 0, &rgba),
            ktx2(50, 0, &swapped),
            ktx2(43, 3, &deflated),
        ] {
            let read = decode("a", &bytes, Wrap::Repeat).unwrap();
            assert_eq!((read.width(), read.height()), (3, 2));
            assert_eq!(read.texels(), expected);
            assert_eq!(alpha(&bytes).unwrap(), Some(((3, 2), alphas.clone())));
            for length in 0..bytes.len() {
                let _ = decode("a", &bytes[..length], Wrap::Repeat);
            }
        }
        let refused = |bytes: &[u8]| decode("a", bytes, Wrap::Repeat).unwrap_err();
        assert!(refused(&ktx2(0, 1, &rgba)).contains("Basis Universal"));
        assert!(refused(&ktx2(37, 0, &rgba[1..])).contains("cut short"));
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
        assert!(
            error.contains("neither PNG, JPEG, WebP nor KTX2"),
            "{error}"
        );
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
