//! OpenEXR images.

use std::io::Cursor;

use exr::prelude::{
    AnyChannel, AnyChannels, Compression, Encoding, FlatSamples, Image, Layer, LayerAttributes,
    SmallVec, WritableImage,
};

use super::sb3d::Samples;
use picofarm_store::StorageError;

/// Encodes an OpenEXR file with one channel, Y.
pub(super) fn image(size: (usize, usize), samples: Samples) -> Result<Vec<u8>, StorageError> {
    let samples = match samples {
        Samples::Half(values) => FlatSamples::F16(values),
        Samples::Float(values) => FlatSamples::F32(values),
    };
    let mut channels = SmallVec::new();
    channels.push(AnyChannel::new("Y", samples));
    let encoding = Encoding {
        compression: Compression::ZIP16,
        ..Encoding::default()
    };
    let encoding = Encoding {
        blocks: exr::image::Blocks::ScanLines,
        line_order: exr::meta::attribute::LineOrder::Increasing,
        ..encoding
    };
    let layer = Layer::new(
        size,
        LayerAttributes::default(),
        encoding,
        AnyChannels::sort(channels),
    );
    let mut bytes = Cursor::new(Vec::new());
    let written = Image::from_layer(layer)
        .write()
        .non_parallel()
        .to_buffered(&mut bytes);
    written.map_err(|e| StorageError::codec("cannot encode an OpenEXR image", e))?;
    Ok(bytes.into_inner())
}
