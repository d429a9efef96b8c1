//! The textures of a glTF document: each is stored once, as PNG in the binary chunk.

use std::sync::Arc;

use serde::Serialize;

use crate::{Texture, Wrap};

use super::{binary::Binary, png};

#[derive(Debug, Serialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct ImageEntry {
    name: String,
    mime_type: &'static str,
    buffer_view: usize,
}

#[derive(Debug, Serialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct SamplerEntry {
    mag_filter: u32,
    wrap_s: u32,
    wrap_t: u32,
}

#[derive(Debug, Serialize)]
pub(super) struct TextureEntry {
    sampler: usize,
    source: usize,
}

#[derive(Debug, Serialize)]
pub(super) struct TextureInfo {
    index: usize,
}

/// The distinct textures of a scene in order of first use.
#[derive(Debug, Default)]
pub(super) struct Textures {
    list: Vec<Arc<Texture>>,
}

impl Textures {
    /// Returns a reference to a texture, and adds the texture if it is new.
    pub(super) fn info(&mut self, texture: &Arc<Texture>) -> TextureInfo {
        let known = self
            .list
            .iter()
            .position(|t| Arc::ptr_eq(t, texture) || t == texture);
        let index = known.unwrap_or_else(|| {
            self.list.push(texture.clone());
            self.list.len() - 1
        });
        TextureInfo { index }
    }

    /// Returns the document's images, samplers and textures; the PNG bytes are appended to
    /// `binary`.
    pub(super) fn entries(
        &self,
        binary: &mut Binary,
    ) -> (Vec<ImageEntry>, Vec<SamplerEntry>, Vec<TextureEntry>) {
        const LINEAR: u32 = 9729;
        let images = self.list.iter().map(|t| ImageEntry {
            name: t.name().to_owned(),
            mime_type: "image/png",
            buffer_view: binary.view(png(t).into_iter(), None),
        });
        let samplers = self.list.iter().map(|t| {
            let wrap = match t.wrap() {
                Wrap::Repeat => 10497,
                Wrap::Mirror => 33648,
                Wrap::Clamp => 33071,
            };
            SamplerEntry {
                mag_filter: LINEAR,
                wrap_s: wrap,
                wrap_t: wrap,
            }
        });
        let textures = (0..self.list.len()).map(|k| TextureEntry {
            sampler: k,
            source: k,
        });
        (images.collect(), samplers.collect(), textures.collect())
    }
}
