//! Encodes a scene's record into its objects. The encoding is deterministic: the same record gives
//! the same bytes for any number of threads.

use std::collections::BTreeMap;

use bytes::Bytes;
use rayon::prelude::*;

use crate::coding::shard;
use crate::coding::squareroot::ErrorSums;
use crate::coding::tiles::Tiles;
use crate::coding::values::{self, Source};
use crate::layout::manifest::{ENCODER_VERSION, FORMAT_VERSION, Manifest, SubsetCoding};
use crate::layout::quantity::Quantity;
use crate::layout::record::{Provenance, SceneRecord, SubsetRecord};
use crate::layout::spec::DatasetSpec;
use crate::scenes::dataset::{ArrayCodec, Dataset};
use picofarm_store::StorageError;
use picofarm_store::sealed::{ObjectEntry, sha256_hex};

/// Maximum number of saturated bins in a scene. The few pixels that see a spot saturate; more
/// indicate a wrong scale.
const MAX_OVERFLOW: usize = 1 << 16;

/// A scene ready to be published.
#[derive(Debug, Clone)]
pub struct EncodedScene {
    /// Its manifest.
    pub manifest: Manifest,
    /// Bytes of each object in the manifest, in the same order.
    pub(crate) bytes: Vec<Bytes>,
}

pub(crate) fn encode_scene(
    dataset: &Dataset,
    scene: u64,
    record: &SceneRecord<'_>,
    provenance: &Provenance,
) -> Result<EncodedScene, StorageError> {
    record.check(&dataset.spec)?;
    let content = Content {
        transient: record.transient,
        subsets: record.subsets,
        scale: record.scale,
    };
    assemble(dataset, scene, &content, provenance, |quantity| {
        Ok(small_array(&dataset.spec, quantity, record))
    })
}

/// A scene's histograms.
pub(crate) struct Content<'a> {
    pub transient: &'a [f32],
    pub subsets: &'a [SubsetRecord<'a>],
    pub scale: f32,
}

/// Encodes the histograms, and the native-endian bytes that `small` returns for each other
/// quantity.
pub(crate) fn assemble(
    dataset: &Dataset,
    scene: u64,
    content: &Content<'_>,
    provenance: &Provenance,
    small: impl Fn(Quantity) -> Result<Vec<u8>, StorageError>,
) -> Result<EncodedScene, StorageError> {
    let (spec, arrays) = (&dataset.spec, &dataset.arrays);
    let mut coded = None;
    let mut subsets = BTreeMap::new();
    let mut objects = Vec::with_capacity(arrays.len());
    let mut bytes = Vec::with_capacity(arrays.len());
    for array in arrays.iter() {
        let object = match array.layout.quantity {
            Quantity::Transient => {
                let planes = [content.transient];
                let transient = encode_transient(spec, array, &planes, content.scale)?;
                let error = transient.error.finish(transient.overflow.len());
                coded = Some((error, transient.overflow));
                transient.shard
            }
            quantity if quantity.is_transient() => {
                let subset = content.subsets.iter().find(|s| s.quantity == quantity);
                let planes = &subset.expect("checked with the record").planes;
                let transient = encode_transient(spec, array, planes, content.scale)?;
                let coding = SubsetCoding {
                    error: transient.error.finish(transient.overflow.len()),
                    overflow: transient.overflow,
                };
                subsets.insert(quantity.name().to_string(), coding);
                transient.shard
            }
            quantity => array.codec.encode(&small(quantity)?)?,
        };
        objects.push(ObjectEntry {
            key: array.layout.key(scene),
            size: object.len() as u64,
            sha256: sha256_hex(&object),
        });
        bytes.push(Bytes::from(object));
    }
    let (error, overflow) = coded.expect("every data set has a transient");
    let manifest = Manifest {
        format: FORMAT_VERSION,
        scene,
        profile: spec.profile,
        encoder: ENCODER_VERSION.into(),
        scale: content.scale,
        error,
        provenance: provenance.clone(),
        overflow,
        subsets,
        objects,
        checksum: None,
    }
    .sealed();
    Ok(EncodedScene { manifest, bytes })
}

pub(crate) struct CodedTransient {
    pub shard: Vec<u8>,
    pub error: ErrorSums,
    pub overflow: Vec<(u64, f32)>,
}

pub(crate) fn encode_transient(
    spec: &DatasetSpec,
    array: &ArrayCodec,
    planes: &[&[f32]],
    scale: f32,
) -> Result<CodedTransient, StorageError> {
    let tiles = Tiles::new(spec, &array.layout);
    let source = Source {
        name: array.layout.quantity.name(),
        planes,
        pixels: spec.pixels(),
        bins: spec.gate.bins as usize,
        scale,
    };
    let coded = (0..tiles.count())
        .into_par_iter()
        .map(|tile| {
            let mut coded = values::code(spec.profile, &tiles, tile, &source)?;
            coded.bytes = array.codec.encode(&coded.bytes)?;
            Ok(coded)
        })
        .collect::<Result<Vec<_>, StorageError>>()?;
    let mut error = ErrorSums::default();
    let mut overflow = Vec::new();
    let mut chunks = Vec::with_capacity(coded.len());
    for tile in coded {
        error.add(&tile.error);
        overflow.extend(tile.overflow);
        chunks.push(tile.bytes);
    }
    if overflow.len() > MAX_OVERFLOW {
        let what = format!(
            "{} bins exceed what 16 bits hold at {} photons per unit (at most {MAX_OVERFLOW} may); \
             choose a smaller scale, or the profile coarse or lossless",
            overflow.len(),
            scale
        );
        return Err(StorageError::invalid("record.scale", what));
    }
    overflow.sort_unstable_by_key(|(index, _)| *index);
    Ok(CodedTransient {
        shard: shard::assemble(
            chunks.len(),
            chunks
                .iter()
                .enumerate()
                .map(|(tile, chunk)| (tiles.place(tile), &chunk[..])),
        )?,
        error,
        overflow,
    })
}

/// Returns the native-endian bytes of a quantity other than the transient.
fn small_array(spec: &DatasetSpec, quantity: Quantity, record: &SceneRecord<'_>) -> Vec<u8> {
    match quantity {
        Quantity::Transient
        | Quantity::Transient4
        | Quantity::Transient25
        | Quantity::TransientSpots => unreachable!("transients are coded by tiles"),
        Quantity::Intensity => intensity(record.transient, spec.gate.bins),
        Quantity::Depth => bytemuck::cast_slice(record.depth).to_vec(),
        Quantity::Range => bytemuck::cast_slice(record.range).to_vec(),
        Quantity::Normal => {
            let code = |x: &f32| (libm::rintf(x.clamp(-1.0, 1.0) * 32767.0)) as i16;
            let codes: Vec<i16> = record.normal.iter().map(code).collect();
            bytemuck::cast_slice(&codes).to_vec()
        }
        Quantity::Instance => bytemuck::cast_slice(record.instance).to_vec(),
        Quantity::Label => bytemuck::cast_slice(record.label).to_vec(),
        Quantity::Specular => record.specular.to_vec(),
        Quantity::Visibility => {
            let pixels = spec.pixels();
            let mut packed = vec![0u8; (spec.spots as usize).div_ceil(8) * pixels];
            for (spot, lit) in record.visibility.chunks_exact(pixels).enumerate() {
                let plane = &mut packed[spot / 8 * pixels..][..pixels];
                for (byte, lit) in plane.iter_mut().zip(lit) {
                    *byte |= lit << (spot % 8);
                }
            }
            packed
        }
        Quantity::TwoBouncePath => bytemuck::cast_slice(record.two_bounce).to_vec(),
        Quantity::Rgb => record.rgb.iter().map(|x| srgb_u8(*x)).collect(),
        Quantity::Spots => {
            let row = |spot: &Option<crate::layout::record::Spot>| {
                spot.map_or([f32::NAN; 7], |s| s.row())
            };
            let rows: Vec<f32> = record.spots.iter().flat_map(row).collect();
            bytemuck::cast_slice(&rows).to_vec()
        }
        Quantity::Intrinsics => {
            let i = record.intrinsics;
            bytemuck::cast_slice(&[i.fx, i.fy, i.cx, i.cy]).to_vec()
        }
        Quantity::Camera => bytemuck::cast_slice(record.camera.as_flattened()).to_vec(),
        Quantity::Laser => bytemuck::cast_slice(&record.laser).to_vec(),
        Quantity::Scale => record.scale.to_ne_bytes().to_vec(),
    }
}

/// Returns the native-endian bytes of Σ_b h.
pub(crate) fn intensity(transient: &[f32], bins: u32) -> Vec<u8> {
    let sums: Vec<f32> = transient
        .par_chunks(bins as usize)
        .map(|h| h.iter().map(|h| f64::from(*h)).sum::<f64>() as f32)
        .collect();
    bytemuck::cast_slice(&sums).to_vec()
}

/// Converts a linear value, clamped to [0, 1], to 8-bit sRGB (IEC 61966-2-1).
fn srgb_u8(linear: f32) -> u8 {
    let c = f64::from(linear.clamp(0.0, 1.0));
    let s = if c <= 0.003_130_8 {
        12.92 * c
    } else {
        1.055 * libm::pow(c, 1.0 / 2.4) - 0.055
    };
    libm::floor(s * 255.0 + 0.5) as u8
}
