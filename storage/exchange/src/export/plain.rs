//! A scene as plain decoded arrays, with the names, shapes, units and descriptions for files of
//! other tools.

use picofarm_dataset::Dataset;
use picofarm_dataset::Manifest;
use picofarm_dataset::Quantity;
use picofarm_store::StorageError;

/// Values of an array.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Values {
    F32(Vec<f32>),
    U32(Vec<u32>),
    U16(Vec<u16>),
    U8(Vec<u8>),
}

/// An array of a scene, in row-major order.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Plain {
    pub name: &'static str,
    pub shape: Vec<usize>,
    pub values: Values,
    pub about: &'static str,
}

/// A scene's arrays and its manifest.
#[derive(Debug, Clone)]
pub(super) struct PlainScene {
    pub manifest: Manifest,
    pub arrays: Vec<Plain>,
}

/// Returns a description of the array.
pub(super) fn about(quantity: Quantity) -> &'static str {
    match quantity {
        Quantity::Transient => {
            "histogram h, radiance per pulse energy [row][column][bin]; times photons_per_unit: photons"
        }
        Quantity::Transient4 => "h of the 4 spots of the 10x10 grid at rows and columns 2 and 7",
        Quantity::Transient25 => "h of the 25 spots of the 10x10 grid at even rows and odd columns",
        Quantity::TransientSpots => "h of each spot alone [spot][row][column][bin]",
        Quantity::Intensity => "sum of h over the bins, before coding",
        Quantity::Depth => "z-depth, metres; 0 = nothing",
        Quantity::Range => "distance along the ray, metres; 0 = nothing",
        Quantity::Normal => "unit normals, camera frame (x right, y down, z forward)",
        Quantity::Instance => "instance, 0 = nothing",
        Quantity::Label => {
            "label, 0 = nothing; the names stand in the manifest, provenance.plan.labels"
        }
        Quantity::Specular => "1 = mirror",
        Quantity::Visibility => "[spot][row][column]: 1 = the spot lights the point",
        Quantity::TwoBouncePath => {
            "[spot][row][column]: measured optical path of the spot's two-bounce light, metres; 0 = not measured"
        }
        Quantity::Rgb => {
            "colour, sRGB: of rendered scenes a preview under a lamp at the ceiling, shadows and mirrors but no indirect light; not radiometric"
        }
        Quantity::Spots => {
            "[spot]: position and normal (camera frame, metres), path from the laser; NaN = the beam meets nothing"
        }
        Quantity::Intrinsics => "fx, fy, cx, cy, pixels",
        Quantity::Camera => "camera to world",
        Quantity::Laser => "origin of the laser, camera frame, metres",
        Quantity::Scale => "photons per unit of h",
    }
}

/// Decodes all arrays of a scene of a data set. Arrays that the scene's source did not have are
/// omitted, and its unknown values for spots are NaN.
pub(super) async fn decode(dataset: &Dataset, scene: u64) -> Result<PlainScene, StorageError> {
    let manifest = dataset.manifest(scene).await?;
    let spec = *dataset.spec();
    let (h, w, s) = (
        spec.height as usize,
        spec.width as usize,
        spec.spots as usize,
    );
    let bins = spec.gate.bins as usize;
    let (mut arrays, missing) = (Vec::new(), manifest.missing());
    let lacks = |name: &str| missing.iter().any(|m| m == name);
    for quantity in spec.quantities() {
        if lacks(quantity.name()) {
            continue;
        }
        let (shape, values) = match quantity {
            q if q.is_transient() => {
                let values = dataset.read_histogram(scene, q).await?;
                (vec![h, w, bins], Values::F32(values))
            }
            Quantity::Normal => (
                vec![h, w, 3],
                Values::F32(dataset.read_normal(scene).await?),
            ),
            Quantity::Visibility => (
                vec![s, h, w],
                Values::U8(dataset.read_visibility(scene).await?),
            ),
            Quantity::TwoBouncePath => (
                vec![s, h, w],
                Values::F32(dataset.read(scene, quantity).await?),
            ),
            Quantity::Rgb => (
                vec![h, w, 3],
                Values::U8(dataset.read(scene, quantity).await?),
            ),
            Quantity::Specular => (vec![h, w], Values::U8(dataset.read(scene, quantity).await?)),
            Quantity::Label => (
                vec![h, w],
                Values::U16(dataset.read(scene, quantity).await?),
            ),
            Quantity::Instance => (
                vec![h, w],
                Values::U32(dataset.read(scene, quantity).await?),
            ),
            Quantity::Spots => {
                let mut rows = dataset.read::<f32>(scene, quantity).await?;
                for row in rows.chunks_exact_mut(7) {
                    if lacks("spots.normal") {
                        row[3..6].fill(f32::NAN);
                    }
                    if lacks("spots.path") {
                        row[6] = f32::NAN;
                    }
                }
                (vec![s, 7], Values::F32(rows))
            }
            Quantity::Intrinsics => (vec![4], Values::F32(dataset.read(scene, quantity).await?)),
            Quantity::Camera => (
                vec![4, 4],
                Values::F32(dataset.read(scene, quantity).await?),
            ),
            Quantity::Laser => (vec![3], Values::F32(dataset.read(scene, quantity).await?)),
            Quantity::Scale => (vec![], Values::F32(dataset.read(scene, quantity).await?)),
            _ => (
                vec![h, w],
                Values::F32(dataset.read(scene, quantity).await?),
            ),
        };
        let (name, about) = (quantity.name(), about(quantity));
        let name = match quantity {
            Quantity::Scale => "photons_per_unit",
            _ => name,
        };
        arrays.push(Plain {
            name,
            shape,
            values,
            about,
        });
    }
    Ok(PlainScene { manifest, arrays })
}
