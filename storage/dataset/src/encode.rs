//! A scene's record to the bytes of its objects. Deterministic: the same record gives the same bytes, whatever
//! the number of threads.

use std::collections::BTreeMap;

use bytes::Bytes;
use rayon::prelude::*;

use crate::codec::ChunkCodec;
use crate::counts;
use crate::dataset::ArrayCodec;
use crate::error::DatasetError;
use crate::layout::{Layout, Quantity};
use crate::manifest::{
    ENCODER_VERSION, FORMAT_VERSION, Manifest, ObjectEntry, SubsetCoding, sha256_hex,
};
use crate::record::{Provenance, SceneRecord, SubsetRecord};
use crate::shard;
use crate::spec::{DatasetSpec, Profile};
use crate::squareroot::{ErrorSums, SATURATED, SquareRoot};

/// Saturated bins allowed in a scene: the few pixels that see a spot have them, more mean a wrong scale.
const MAX_OVERFLOW: usize = 1 << 16;

/// A scene ready to be published.
#[derive(Debug, Clone)]
pub struct EncodedScene {
    /// Its manifest.
    pub manifest: Manifest,
    /// Bytes of each of the manifest's objects, in the same order.
    pub(crate) bytes: Vec<Bytes>,
}

pub(crate) fn encode_scene(
    spec: &DatasetSpec,
    arrays: &[ArrayCodec],
    scene: u64,
    record: &SceneRecord<'_>,
    provenance: &Provenance,
) -> Result<EncodedScene, DatasetError> {
    record.check(spec)?;
    let content = Content {
        transient: record.transient,
        subsets: record.subsets,
        scale: record.scale,
    };
    assemble(spec, arrays, scene, &content, provenance, |quantity| {
        Ok(small_array(spec, quantity, record))
    })
}

/// A scene's histograms.
pub(crate) struct Content<'a> {
    pub transient: &'a [f32],
    pub subsets: &'a [SubsetRecord<'a>],
    pub scale: f32,
}

/// Codes the histograms, and the native-endian bytes that `small` gives for each other quantity.
pub(crate) fn assemble(
    spec: &DatasetSpec,
    arrays: &[ArrayCodec],
    scene: u64,
    content: &Content<'_>,
    provenance: &Provenance,
    small: impl Fn(Quantity) -> Result<Vec<u8>, DatasetError>,
) -> Result<EncodedScene, DatasetError> {
    let mut coded = None;
    let mut subsets = BTreeMap::new();
    let mut objects = Vec::with_capacity(arrays.len());
    let mut bytes = Vec::with_capacity(arrays.len());
    for array in arrays {
        let object = match array.layout.quantity {
            Quantity::Transient => {
                let planes = [content.transient];
                let transient = encode_transient(spec, array, &planes, content.scale)?;
                coded = Some((transient.error, transient.overflow));
                transient.shard
            }
            quantity if quantity.is_transient() => {
                let subset = content.subsets.iter().find(|s| s.quantity == quantity);
                let planes = &subset.expect("checked with the record").planes;
                let transient = encode_transient(spec, array, planes, content.scale)?;
                let coding = SubsetCoding {
                    error: transient.error.finish(),
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
        error: error.finish(),
        provenance: provenance.clone(),
        overflow,
        subsets,
        objects,
        checksum: None,
    }
    .sealed();
    Ok(EncodedScene { manifest, bytes })
}

struct CodedTransient {
    shard: Vec<u8>,
    error: ErrorSums,
    overflow: Vec<(u64, f32)>,
}

struct CodedTile {
    bytes: Vec<u8>,
    error: ErrorSums,
    overflow: Vec<(u64, f32)>,
}

fn encode_transient(
    spec: &DatasetSpec,
    array: &ArrayCodec,
    planes: &[&[f32]],
    scale: f32,
) -> Result<CodedTransient, DatasetError> {
    let tiles = Tiles::new(spec, &array.layout);
    let coded = (0..tiles.count())
        .into_par_iter()
        .map(|tile| {
            let source = Source {
                name: array.layout.quantity.name(),
                planes,
                plane_len: spec.transient_len(),
                scale,
            };
            encode_tile(spec, &tiles, &array.codec, tile, &source)
        })
        .collect::<Result<Vec<_>, _>>()?;
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
             choose a smaller scale, a larger delta or the plain-f32 profile",
            overflow.len(),
            scale
        );
        return Err(DatasetError::invalid("record.scale", what));
    }
    overflow.sort_unstable_by_key(|(index, _)| *index);
    Ok(CodedTransient {
        shard: shard::assemble(&chunks)?,
        error,
        overflow,
    })
}

/// The values of a transient: its planes one after the other.
struct Source<'a> {
    name: &'a str,
    planes: &'a [&'a [f32]],
    plane_len: usize,
    scale: f32,
}

impl Source<'_> {
    /// Values of a run, which lies in one plane.
    fn run(&self, run: &Run) -> &[f32] {
        let plane = self.planes[run.image / self.plane_len];
        &plane[run.image % self.plane_len..][..run.len]
    }
}

fn encode_tile(
    spec: &DatasetSpec,
    tiles: &Tiles,
    codec: &ChunkCodec,
    tile: usize,
    source: &Source<'_>,
) -> Result<CodedTile, DatasetError> {
    let mut error = ErrorSums::default();
    let mut overflow = Vec::new();
    let bytes = match spec.profile {
        Profile::SqrtU16 { delta } => {
            let code = SquareRoot::new(delta, source.scale);
            let mut q = vec![0u16; tiles.tile_len()];
            for run in tiles.runs(tile) {
                let h = source.run(&run);
                let q = &mut q[run.tile..run.tile + run.len];
                let facts = code.encode_run(h, q, &mut error);
                if facts.invalid {
                    return Err(invalid_value(source.name, h, run.image));
                }
                if facts.saturated {
                    let saturated = q.iter().enumerate().filter(|(_, q)| **q == SATURATED);
                    overflow.extend(saturated.map(|(i, _)| ((run.image + i) as u64, h[i])));
                }
            }
            codec.encode(bytemuck::cast_slice(&q))?
        }
        Profile::CountsU16 => {
            let mut q = vec![0u16; tiles.tile_len()];
            for run in tiles.runs(tile) {
                let h = source.run(&run);
                let q = &mut q[run.tile..run.tile + run.len];
                match counts::encode_run(source.scale, h, q, &mut error) {
                    Ok(false) => {}
                    Ok(true) => {
                        let saturated = q.iter().enumerate().filter(|(_, q)| **q == SATURATED);
                        overflow.extend(saturated.map(|(i, _)| ((run.image + i) as u64, h[i])));
                    }
                    Err(at) => return Err(invalid_count(source, h[at], run.image + at)),
                }
            }
            codec.encode(bytemuck::cast_slice(&q))?
        }
        Profile::PlainF32 => {
            let mut values = vec![0f32; tiles.tile_len()];
            for run in tiles.runs(tile) {
                let h = source.run(&run);
                if !h.iter().all(|h| (0.0..=f32::MAX).contains(h)) {
                    return Err(invalid_value(source.name, h, run.image));
                }
                values[run.tile..run.tile + run.len].copy_from_slice(h);
            }
            codec.encode(bytemuck::cast_slice(&values))?
        }
    };
    Ok(CodedTile {
        bytes,
        error,
        overflow,
    })
}

fn invalid_value(name: &str, h: &[f32], start: usize) -> DatasetError {
    let at = h
        .iter()
        .position(|h| !(0.0..=f32::MAX).contains(h))
        .unwrap_or(0);
    DatasetError::invalid(
        format!("record.{name}[{}]", start + at),
        format!("expected a finite value of at least 0, found {}", h[at]),
    )
}

fn invalid_count(source: &Source<'_>, h: f32, at: usize) -> DatasetError {
    if !(0.0..=f32::MAX).contains(&h) {
        return invalid_value(source.name, &[h], at);
    }
    DatasetError::invalid(
        format!("record.{}[{at}]", source.name),
        format!(
            "expected a whole number of photons, found {}; counts-u16 holds counts, other values need sqrt-u16 or plain-f32",
            h * source.scale
        ),
    )
}

/// The inner chunks of a transient, plane by plane and row by row.
pub(crate) struct Tiles {
    /// Images, one below the other: row r of plane p counts as row p·rows + r.
    planes: usize,
    /// Size of one in pixels (rows, columns).
    image: [usize; 2],
    /// Tile size in pixels.
    side: [usize; 2],
    /// Number of tiles down and across.
    grid: [usize; 2],
    bins: usize,
}

/// A run of contiguous values: one row of a tile's pixels inside the image.
pub(crate) struct Run {
    /// Where it starts in the image's values.
    pub image: usize,
    /// Where it starts in the tile's values.
    pub tile: usize,
    pub len: usize,
    /// Image row, first column and number of columns.
    pub row: usize,
    pub column: usize,
    pub columns: usize,
}

impl Tiles {
    pub fn new(spec: &DatasetSpec, layout: &Layout) -> Self {
        let inner = layout.inner.as_ref().expect("transients are sharded");
        let image = [spec.height as usize, spec.width as usize];
        let [.., down, across, _] = inner[..] else {
            unreachable!("transients have rows, columns and bins");
        };
        let side = [down as usize, across as usize];
        Self {
            planes: layout.planes(),
            image,
            side,
            grid: [image[0].div_ceil(side[0]), image[1].div_ceil(side[1])],
            bins: spec.gate.bins as usize,
        }
    }

    pub fn count(&self) -> usize {
        self.planes * self.grid[0] * self.grid[1]
    }

    pub fn tile_len(&self) -> usize {
        self.side[0] * self.side[1] * self.bins
    }

    /// Whether the tile has pixels in the window.
    pub fn touches(
        &self,
        tile: usize,
        rows: &std::ops::Range<usize>,
        columns: &std::ops::Range<usize>,
    ) -> bool {
        let left = self.corner(tile).1;
        let band = self.rows_of(tile);
        band.start < rows.end
            && band.end > rows.start
            && left < columns.end
            && left + self.side[1] > columns.start
    }

    fn corner(&self, tile: usize) -> (usize, usize) {
        let (plane, band) = (
            self.row_of(tile) / self.grid[0],
            self.row_of(tile) % self.grid[0],
        );
        (
            plane * self.image[0] + band * self.side[0],
            tile % self.grid[1] * self.side[1],
        )
    }

    /// Which row of tiles a tile is in, counted through all planes.
    pub fn row_of(&self, tile: usize) -> usize {
        tile / self.grid[1]
    }

    /// The image rows of a tile, cut at the image's edge.
    pub fn rows_of(&self, tile: usize) -> std::ops::Range<usize> {
        let top = self.corner(tile).0;
        let end = (self.row_of(tile) / self.grid[0] + 1) * self.image[0];
        top..(top + self.side[0]).min(end)
    }

    pub fn runs(&self, tile: usize) -> impl Iterator<Item = Run> + '_ {
        let (top, left) = self.corner(tile);
        let columns = self.side[1].min(self.image[1] - left);
        let rows = self.rows_of(tile).len();
        (0..rows).map(move |r| Run {
            image: ((top + r) * self.image[1] + left) * self.bins,
            tile: r * self.side[1] * self.bins,
            len: columns * self.bins,
            row: top + r,
            column: left,
            columns,
        })
    }
}

/// Native-endian bytes of a quantity other than the transient.
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
        Quantity::Rgb => record.rgb.iter().map(|x| srgb_u8(*x)).collect(),
        Quantity::Spots => {
            let row = |spot: &Option<crate::record::Spot>| spot.map_or([f32::NAN; 7], |s| s.row());
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

/// Native-endian bytes of Σ_b h.
pub(crate) fn intensity(transient: &[f32], bins: u32) -> Vec<u8> {
    let sums: Vec<f32> = transient
        .par_chunks(bins as usize)
        .map(|h| h.iter().map(|h| f64::from(*h)).sum::<f64>() as f32)
        .collect();
    bytemuck::cast_slice(&sums).to_vec()
}

/// Linear value, clamped to [0, 1], to 8-bit sRGB (IEC 61966-2-1).
fn srgb_u8(linear: f32) -> u8 {
    let c = f64::from(linear.clamp(0.0, 1.0));
    let s = if c <= 0.003_130_8 {
        12.92 * c
    } else {
        1.055 * libm::pow(c, 1.0 / 2.4) - 0.055
    };
    libm::floor(s * 255.0 + 0.5) as u8
}
