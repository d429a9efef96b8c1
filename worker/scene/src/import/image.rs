//! Images of foreign files: PNG and JPEG as textures, decoded once and within limits that are checked
//! before any texel is.

use std::{collections::BTreeMap, io::Cursor, sync::Arc};

use image::{ImageReader, Limits};

use crate::{Texture, Wrap};

/// Most texels of all textures of one file (800 MB).
const MAX_TEXELS: u64 = 1 << 28;

/// Textures of one file, by whatever names them there.
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
    /// The texture called `key`, made by `decode` when first asked for.
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

/// A PNG or JPEG image as a texture; an alpha channel is dropped, grey is spread over the channels, and 16
/// bits are rounded to 8.
pub(super) fn decode(name: &str, bytes: &[u8], wrap: Wrap) -> Result<Texture, String> {
    let damaged = |e: image::ImageError| {
        format!("image {name:?} is not readable ({e}); save it as 8-bit PNG or JPEG")
    };
    let reader = || {
        ImageReader::new(Cursor::new(bytes))
            .with_guessed_format()
            .map_err(|e| damaged(e.into()))
    };
    let (width, height) = reader()?.into_dimensions().map_err(damaged)?;
    Texture::check_size(width, height).map_err(|e| format!("image {name:?}: {e}"))?;
    let mut limits = Limits::default();
    limits.max_alloc = Some(16 * Texture::MAX_TEXELS);
    let mut reader = reader()?;
    reader.limits(limits);
    let rgb = reader.decode().map_err(damaged)?.into_rgb8();
    let texels = rgb.as_raw().as_chunks::<3>().0.to_vec();
    Texture::new(name, rgb.width(), rgb.height(), texels, wrap)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_header_that_promises_too_much_is_refused_before_decoding() {
        let mut png = Vec::new();
        let small = image::RgbImage::new(1, 1);
        small
            .write_to(&mut Cursor::new(&mut png), image::ImageFormat::Png)
            .unwrap();
        assert!(decode("a", &png, Wrap::Repeat).is_ok());
        png[16..24].copy_from_slice(&[0, 0, 0x40, 0, 0, 0, 0x40, 0]);
        // The checksum no longer fits; whichever is found first, nothing large is allocated.
        assert!(decode("a", &png, Wrap::Repeat).is_err());
        assert!(decode("a", b"no image", Wrap::Repeat).is_err());
    }
}
