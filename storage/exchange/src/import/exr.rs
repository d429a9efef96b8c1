//! Decodes OpenEXR with any compression that the `exr` crate supports, including DWAA.

use std::io::Cursor;
use std::path::Path;

use exr::block::{UncompressedBlock, chunk::Chunk};
use exr::meta::attribute::SampleType;
use half::f16;
use rayon::prelude::*;

use super::ImportError;
use super::files::Files;
use super::image::{Channel, Exr};

const MEND_EXR: &str = "convert it to scan lines of one resolution with ZIP compression, e.g. in Python: \
                        import OpenEXR; f = OpenEXR.File(path); f.header()['compression'] = OpenEXR.ZIP_COMPRESSION; \
                        f.write(path)";

/// Maximum number of values per byte of an OpenEXR file: an image of one colour under the best of
/// its compressions.
const RATIO: usize = 1 << 12;

/// Returns the width and height of an OpenEXR file's only layer.
pub(super) fn exr_size(file: &Path, files: &Files) -> Result<(usize, usize), ImportError> {
    let reader = std::io::BufReader::new(files.open(file)?);
    let meta = exr::meta::MetaData::read_from_buffered(reader, false);
    let meta = meta.map_err(|e| match e {
        exr::error::Error::Io(e) => ImportError::io("read", file, e),
        e => ImportError::unreadable(file, e, MEND_EXR),
    })?;
    let size = meta.headers[0].layer_size;
    Ok((size.width(), size.height()))
}

/// Decodes an OpenEXR file on rayon threads.
///
/// It allocates at most [`RATIO`] values per byte of the file.
pub(super) fn exr(file: &Path, bytes: &[u8]) -> Result<Exr, ImportError> {
    let failed = |e: exr::error::Error| ImportError::unreadable(file, e, MEND_EXR);
    let reader = exr::block::read(Cursor::new(bytes), false).map_err(failed)?;
    let header = reader.headers()[0].clone();
    let plain = header.blocks == exr::meta::BlockDescription::ScanLines && !header.deep;
    if reader.headers().len() != 1 || !plain {
        let what = "expected one layer of scan lines";
        return Err(ImportError::unreadable(file, what, MEND_EXR));
    }
    let (width, height) = (header.layer_size.width(), header.layer_size.height());
    let count = header.channels.list.len().max(1);
    let values = width.saturating_mul(height).saturating_mul(count);
    if values > bytes.len().saturating_mul(RATIO) {
        let what = format!(
            "announces {count} channels of {width}x{height} pixels, more than {} bytes can hold",
            bytes.len()
        );
        return Err(ImportError::unreadable(file, what, MEND_EXR));
    }
    let mut chunks = reader.all_chunks(false).map_err(failed)?;
    let meta = exr::block::reader::ChunksReader::meta_data(&chunks).clone();
    let all: Vec<Chunk> = (&mut chunks).collect::<Result<_, _>>().map_err(failed)?;
    let lines = header.compression.scan_lines_per_block();
    let mut channels: Vec<Channel> = header
        .channels
        .list
        .iter()
        .map(|c| Channel {
            name: c.name.to_string(),
            stored: match c.sample_type {
                SampleType::F16 => "half",
                SampleType::F32 => "float",
                SampleType::U32 => "uint",
            },
            values: vec![0.0; width * height],
        })
        .collect();
    let mut targets: Vec<Vec<&mut [f32]>> = Vec::new();
    targets.resize_with(height.div_ceil(lines), Vec::new);
    for channel in &mut channels {
        for (slot, target) in targets
            .iter_mut()
            .zip(channel.values.chunks_mut(lines * width))
        {
            slot.push(target);
        }
    }
    if all.len() != targets.len() {
        let what = format!("expected {} blocks, found {}", targets.len(), all.len());
        return Err(ImportError::unreadable(file, what, MEND_EXR));
    }
    // The file may contain the blocks in any order.
    let mut slots: Vec<Option<Vec<&mut [f32]>>> = targets.into_iter().map(Some).collect();
    let mut work = Vec::with_capacity(all.len());
    for chunk in all {
        let block = match &chunk.compressed_block {
            exr::block::chunk::CompressedBlock::ScanLine(b) => {
                (i64::from(b.y_coordinate) - i64::from(header.own_attributes.layer_position.y()))
                    / lines as i64
            }
            _ => -1,
        };
        let slot = usize::try_from(block).ok().and_then(|b| slots.get_mut(b));
        let Some(target) = slot.and_then(Option::take) else {
            let what = "a block stands outside the image, or twice";
            return Err(ImportError::unreadable(file, what, MEND_EXR));
        };
        work.push((chunk, target));
    }
    work.into_par_iter().try_for_each(|(chunk, mut target)| {
        let block = UncompressedBlock::decompress_chunk(chunk, &meta, false).map_err(failed)?;
        let top = block.index.pixel_position.y();
        for line in block.lines(&header.channels) {
            let at = (line.location.position.y() - top) * width;
            let out = &mut target[line.location.channel][at..at + width];
            match header.channels.list[line.location.channel].sample_type {
                SampleType::F16 => fill(out, line.value, |raw: [u8; 2]| {
                    f16::from_ne_bytes(raw).to_f32()
                }),
                SampleType::F32 => fill(out, line.value, f32::from_ne_bytes),
                SampleType::U32 => fill(out, line.value, |raw: [u8; 4]| {
                    u32::from_ne_bytes(raw) as f32
                }),
            }
        }
        Ok::<_, ImportError>(())
    })?;
    Ok(Exr {
        width,
        height,
        compression: format!("{:?}", header.compression),
        channels,
    })
}

fn fill<const N: usize>(out: &mut [f32], raw: &[u8], value: impl Fn([u8; N]) -> f32) {
    for (out, raw) in out.iter_mut().zip(raw.chunks_exact(N)) {
        *out = value(raw.try_into().expect("chunks have this size"));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_exr_that_announces_more_than_it_can_hold_is_refused_before_room_is_made() {
        use exr::prelude::{Encoding, SpecificChannels, WritableImage};
        let mut bytes = Cursor::new(Vec::new());
        let channels = SpecificChannels::build()
            .with_channel("Y")
            .with_pixel_fn(|_| (0.5f32,));
        let image =
            exr::prelude::Image::from_encoded_channels((4, 4), Encoding::UNCOMPRESSED, channels);
        image.write().to_buffered(&mut bytes).unwrap();
        let whole = bytes.into_inner();
        assert_eq!(
            exr(Path::new("a.exr"), &whole).unwrap().channels[0].values,
            [0.5; 16]
        );
        // Both windows: their last corner is x and y, 4 bytes each.
        let mut bomb = whole.clone();
        for window in [&b"dataWindow\0box2i\0"[..], b"displayWindow\0box2i\0"] {
            let found = whole.windows(window.len()).position(|w| w == window);
            let corner = found.unwrap() + window.len() + 4 + 8;
            for at in [corner, corner + 4] {
                bomb[at..at + 4].copy_from_slice(&30_000i32.to_le_bytes());
            }
        }
        let said = exr(Path::new("a.exr"), &bomb).unwrap_err().to_string();
        assert!(said.contains("a.exr"), "{said}");
        // The library first notices that there are too few chunks for such an image.
        assert!(said.contains("chunk count"), "{said}");
    }
}
