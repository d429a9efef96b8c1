//! The binary buffers of a glTF file, checked against the document's claims before they are read.

use std::path::{Path, PathBuf};

use base64::{Engine, engine::general_purpose::STANDARD};
use gltf::{
    Accessor,
    accessor::{DataType, Dimensions},
    json,
};

use crate::SceneError;

use super::{Opener, format_error, of_file, read_file};

/// The bytes of every buffer, by index.
#[derive(Debug)]
pub(super) struct Buffers(pub(super) Vec<Vec<u8>>);

impl Buffers {
    /// Reads or decodes every buffer.
    pub(super) fn read(
        path: &Path,
        root: &json::Root,
        mut blob: Option<Vec<u8>>,
        files: &Opener,
    ) -> Result<Self, SceneError> {
        let fallbacks = fallbacks(root);
        let read = |(index, buffer): (usize, &json::Buffer)| {
            let at = format!("buffers[{index}]");
            let length = usize::try_from(buffer.byte_length.0).unwrap_or(usize::MAX);
            // The binary chunk is the first buffer.
            if fallbacks[index] && (index > 0 || blob.is_none()) {
                return Ok(Vec::new());
            }
            if let Some(uri) = &buffer.uri
                && let Some(file) = buffer_file(path, uri)?
            {
                return read_file(files, &file).and_then(|data| checked(path, &at, data, length));
            }
            let data = match &buffer.uri {
                Some(uri) => data_uri(uri),
                None => blob
                    .take()
                    .ok_or_else(|| "the file has no binary chunk".into()),
            };
            let data = data.map_err(|why| {
                let what = format!("{at}: cannot be read ({why}); export the file again");
                format_error(path, what)
            })?;
            checked(path, &at, data, length)
        };
        let all = root.buffers.iter().enumerate();
        all.map(read).collect::<Result<_, _>>().map(Self)
    }

    /// Returns a buffer's bytes, for the readers of the `gltf` crate.
    pub(super) fn get(&self, buffer: &gltf::Buffer<'_>) -> Option<&[u8]> {
        self.0.get(buffer.index()).map(Vec::as_slice)
    }

    /// Returns the bytes of a view.
    pub(super) fn view(&self, view: &gltf::buffer::View<'_>) -> Result<&[u8], String> {
        let buffer = self
            .0
            .get(view.buffer().index())
            .map_or(&[][..], Vec::as_slice);
        let end = view.offset().checked_add(view.length());
        end.and_then(|end| buffer.get(view.offset()..end)).ok_or_else(|| {
            format!(
                "bufferViews[{}] does not fit its buffer of {} bytes; the file is damaged, export it again",
                view.index(),
                buffer.len()
            )
        })
    }

    /// Checks an accessor's type, and that it is inside its view and buffer; the readers of the
    /// `gltf` crate rely on both.
    pub(super) fn check(
        &self,
        accessor: &Accessor<'_>,
        dimensions: Dimensions,
        types: &[DataType],
    ) -> Result<(), String> {
        let at = format!("accessors[{}]", accessor.index());
        if accessor.dimensions() != dimensions || !types.contains(&accessor.data_type()) {
            return Err(format!(
                "{at}: expected {dimensions:?} of {types:?}, found {:?} of {:?}",
                accessor.dimensions(),
                accessor.data_type()
            ));
        }
        let Some(view) = accessor.view() else {
            return Err(format!("{at}: has no bufferView; export the file again"));
        };
        let size = accessor.size();
        let stride = view.stride().unwrap_or(size);
        let need = accessor.count().checked_sub(1).and_then(|n| {
            n.checked_mul(stride)?
                .checked_add(size)?
                .checked_add(accessor.offset())
        });
        let end = view.offset().checked_add(view.length());
        let buffer = self.0.get(view.buffer().index()).map_or(0, Vec::len);
        match (need, end) {
            (Some(need), Some(end)) if stride >= size && need <= view.length() && end <= buffer => {
                Ok(())
            }
            _ => Err(format!(
                "{at}: {} elements do not fit its bufferView of {} bytes; the file is damaged, export it again",
                accessor.count(),
                view.length()
            )),
        }
    }
}

/// Returns for each buffer whether it only serves readers without meshopt's extension: it says so,
/// or it has no content and all of its views are compressed.
fn fallbacks(root: &json::Root) -> Vec<bool> {
    const NAME: &str = "meshopt_compression";
    // The numbers of views and of compressed views.
    let mut views = vec![(0u32, 0u32); root.buffers.len()];
    for view in &root.buffer_views {
        let mut extensions = view.extensions.iter().flat_map(|e| e.others.keys());
        let compressed = extensions.any(|name| name.ends_with(NAME));
        if let Some((all, packed)) = views.get_mut(view.buffer.value()) {
            (*all, *packed) = (*all + 1, *packed + u32::from(compressed));
        }
    }
    let buffers = root.buffers.iter().zip(views);
    let fallback = |(buffer, (all, packed)): (&json::Buffer, (u32, u32))| {
        let extensions = buffer.extensions.iter().flat_map(|e| &e.others);
        let mut stated = extensions.filter(|(name, _)| name.ends_with(NAME));
        stated.any(|(_, e)| e.get("fallback") == Some(&serde_json::Value::Bool(true)))
            || (buffer.uri.is_none() && all > 0 && all == packed)
    };
    buffers.map(fallback).collect()
}

fn checked(path: &Path, at: &str, data: Vec<u8>, length: usize) -> Result<Vec<u8>, SceneError> {
    if data.len() < length {
        return Err(format_error(
            path,
            format!(
                "{at}: has {} of {length} bytes; the file is cut short, copy or export it again",
                data.len()
            ),
        ));
    }
    Ok(data)
}

/// Returns the file in the folder of the glTF file `path` that a buffer's URI names, or `None` for
/// data within the URI.
///
/// # Errors
/// A name that is not a plain path once it is decoded.
pub(super) fn buffer_file(path: &Path, uri: &str) -> Result<Option<PathBuf>, SceneError> {
    let base = path.parent().unwrap_or(Path::new(""));
    if uri.starts_with("data:") {
        return Ok(None);
    }
    let named = Opener::named(base, &percent_decoded(uri));
    named.map(Some).map_err(of_file)
}

/// Returns the bytes of a data URI.
pub(super) fn data_uri(uri: &str) -> Result<Vec<u8>, String> {
    let coded = uri
        .strip_prefix("data:")
        .and_then(|rest| rest.split_once(";base64,"));
    let (_, text) = coded.ok_or("it is no data URI in base64")?;
    STANDARD.decode(text).map_err(|e| e.to_string())
}

/// Decodes file names in glTF, which are URIs: `%20` stands for a space.
fn percent_decoded(uri: &str) -> String {
    let bytes = uri.as_bytes();
    let mut out = Vec::with_capacity(bytes.len());
    let mut i = 0;
    while i < bytes.len() {
        let hex = (bytes[i] == b'%')
            .then(|| uri.get(i + 1..i + 3))
            .flatten()
            .and_then(|h| u8::from_str_radix(h, 16).ok());
        out.push(hex.unwrap_or(bytes[i]));
        i += if hex.is_some() { 3 } else { 1 };
    }
    String::from_utf8_lossy(&out).into_owned()
}
