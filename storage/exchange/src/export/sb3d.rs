//! Exports a data set in the layout of the paper's release: a folder per scene, with histograms as
//! OpenEXR images.
//!
//! `lidar_<spots>.exr` has one half-precision channel "Y", with a line per pixel and a column per
//! bin. Halves have 11 bits of precision between 6·10⁻⁵ and 65,504, so the histograms are
//! multiplied by a power of two that scales the scene's brightest bin to between 16,384 and 32,768.
//! The factor is stored in `picofarm.json`, together with gate, intrinsics, spots and scale, which
//! are not part of the layout. Compression is lossless ZIP (the release uses lossy DWAA).

use std::io::{Cursor, Write};

use bytes::Bytes;
use half::f16;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

#[cfg(feature = "formats")]
use super::exr::image;
#[cfg(not(feature = "formats"))]
use super::without_formats::image;
use crate::import::npy;
use picofarm_dataset::Dataset;
use picofarm_dataset::Quantity;
use picofarm_dataset::{DatasetSpec, Gate};
use picofarm_dataset::{Intrinsics, Spot};
use picofarm_store::StorageError;

/// Values of an OpenEXR image.
#[derive(Debug)]
#[cfg_attr(
    not(feature = "formats"),
    expect(dead_code, reason = "nothing reads them")
)]
pub(super) enum Samples {
    /// 16-bit floats.
    Half(Vec<f16>),
    /// 32-bit floats.
    Float(Vec<f32>),
}

/// Name of the file with the data that the layout does not have.
pub(crate) const ASIDE: &str = "picofarm.json";
/// The maximum value of the brightest bin.
const BRIGHTEST: f32 = 32_768.0;

/// The data that the paper's layout does not have.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Aside {
    /// Always `picofarm-sb3d-1`.
    pub format: String,
    /// The factor of the histograms, a power of two.
    pub factor: f32,
    pub gate: Gate,
    /// fx, fy, cx, cy.
    pub intrinsics: [f32; 4],
    /// Camera-to-world matrix.
    pub camera: [[f32; 4]; 4],
    /// Laser origin, camera frame, metres.
    pub laser: [f32; 3],
    /// Position, normal and path from the laser of each spot; null if a beam hits nothing.
    pub spots: Vec<Option<[f32; 7]>>,
    /// Photons per unit of the histogram before multiplication.
    pub photons_per_unit: f32,
    /// Key of the task that produced the scene.
    pub task_key: String,
    /// The scene's missing quantities, from [`picofarm_dataset::Manifest::missing`].
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub missing: Vec<String>,
}

impl Aside {
    /// The only value of `format`.
    pub const FORMAT: &'static str = "picofarm-sb3d-1";

    pub fn intrinsics(&self) -> Intrinsics {
        let [fx, fy, cx, cy] = self.intrinsics;
        Intrinsics { fx, fy, cx, cy }
    }

    pub fn spots(&self) -> Vec<Option<Spot>> {
        let all = self.spots.iter();
        all.map(|row| row.as_ref().and_then(|r| Spot::from_row(r)))
            .collect()
    }
}

/// Returns a scene's files in the layout of the paper's release, for a separate folder. The
/// last one contains the data that the others do not have, and marks the folder as complete.
pub(super) async fn scene_files(
    dataset: &Dataset,
    scene: u64,
) -> Result<Vec<(String, Bytes)>, StorageError> {
    let spec = dataset.spec();
    let mut out = Out::default();
    let manifest = dataset.manifest(scene).await?;
    check_known(scene, &manifest.missing())?;
    let mut factor = None;
    let histograms = [
        Quantity::Transient,
        Quantity::Transient25,
        Quantity::Transient4,
    ];
    for quantity in histograms
        .into_iter()
        .filter(|q| spec.quantities().contains(q))
    {
        let spots = match quantity {
            Quantity::Transient => spec.spots as usize,
            subset => subset.spots_of_100().len(),
        };
        let h = dataset.read_histogram(scene, quantity).await?;
        // Fewer spots give less light, so the histogram of all spots is the brightest.
        let factor = *factor.get_or_insert_with(|| factor_of(&h));
        let halves: Vec<f16> = h.par_iter().map(|h| f16::from_f32(h * factor)).collect();
        drop(h);
        let size = (spec.gate.bins as usize, spec.pixels());
        out.put(
            &format!("lidar_{spots}.exr"),
            image(size, Samples::Half(halves))?,
        );
    }
    let (w, h) = (spec.width as usize, spec.height as usize);
    let depth: Vec<f32> = dataset.read(scene, Quantity::Depth).await?;
    out.put("depth.exr", image((w, h), Samples::Float(depth))?);
    let specular: Vec<u8> = dataset.read(scene, Quantity::Specular).await?;
    out.put("specular_mask.png", grey(w, h, &specular)?);
    let lit: Vec<f32> = dataset
        .read_visibility(scene)
        .await?
        .into_iter()
        .map(f32::from)
        .collect();
    let lit = npy::write("<f4", &[spec.spots as usize, h, w], &lit);
    out.put("shadows_v1.npz", zipped("shadows.npy", &lit)?);
    let spots = dataset.read_spots(scene).await?;
    let positions: Vec<f32> = spots
        .iter()
        .flat_map(|s| s.map_or([f32::NAN; 3], |s| s.position))
        .collect();
    out.put(
        "lights_camera_frame.npy",
        npy::write("<f4", &[spots.len(), 3], &positions),
    );
    let i = dataset.read_intrinsics(scene).await?;
    let camera: Vec<f32> = dataset.read(scene, Quantity::Camera).await?;
    let laser: Vec<f32> = dataset.read(scene, Quantity::Laser).await?;
    let mut pose = [[0.0; 4]; 4];
    pose.as_flattened_mut().copy_from_slice(&camera);
    let aside = Aside {
        format: Aside::FORMAT.into(),
        factor: factor.expect("every data set has a transient"),
        gate: spec.gate,
        intrinsics: [i.fx, i.fy, i.cx, i.cy],
        camera: pose,
        laser: [laser[0], laser[1], laser[2]],
        spots: spots.iter().map(|s| s.map(|s| s.row())).collect(),
        photons_per_unit: manifest.scale,
        missing: manifest.missing(),
        task_key: manifest.provenance.task_key,
    };
    let mut text = serde_json::to_vec_pretty(&aside).expect("plain data");
    text.push(b'\n');
    out.put(ASIDE, text);
    Ok(out.0)
}

#[derive(Default)]
struct Out(Vec<(String, Bytes)>);

impl Out {
    fn put(&mut self, name: &str, bytes: Vec<u8>) {
        self.0.push((name.into(), bytes.into()));
    }
}

/// Checks that the layout supports the data set.
pub(super) fn check(spec: &DatasetSpec) -> Result<(), StorageError> {
    if [4, 25, 100].contains(&spec.spots) {
        return Ok(());
    }
    let what = format!(
        "the paper's layout has 4, 25 or 100 spots, the data set {}; reprocess it into one with as many",
        spec.spots
    );
    Err(StorageError::invalid("spec.spots", what))
}

/// Checks that the scene has the layout's quantities, because a file of fill values could not be
/// distinguished from the truth.
fn check_known(scene: u64, missing: &[String]) -> Result<(), StorageError> {
    let filed = ["depth", "specular", "visibility"];
    let lacking: Vec<&str> = filed
        .into_iter()
        .filter(|name| missing.iter().any(|m| m == name))
        .collect();
    if lacking.is_empty() {
        return Ok(());
    }
    let what = format!(
        "the paper's layout has files of depth, mirrors and shadows, but of scene {scene} these were not imported: {}; leave \
         the scene out, import it with them, or choose zarr, webdataset or hdf5",
        lacking.join(", ")
    );
    Err(StorageError::invalid("scenes", what))
}

/// Returns the power of two that scales the brightest value to [BRIGHTEST/2, BRIGHTEST).
fn factor_of(h: &[f32]) -> f32 {
    let brightest = h.iter().fold(0.0f32, |m, x| m.max(*x));
    if brightest == 0.0 {
        return 1.0;
    }
    let (_, exponent) = libm::frexpf(brightest);
    // 2^(exponent - 1) ≤ brightest < 2^exponent.
    let (_, most) = libm::frexpf(BRIGHTEST);
    libm::ldexpf(1.0, (most - 1 - exponent).clamp(-100, 100))
}

/// Encodes a grey PNG, 255 where the mask is 1.
fn grey(width: usize, height: usize, mask: &[u8]) -> Result<Vec<u8>, StorageError> {
    let failed = |e: png::EncodingError| StorageError::codec("cannot encode a PNG", e);
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, width as u32, height as u32);
    encoder.set_color(png::ColorType::Grayscale);
    encoder.set_depth(png::BitDepth::Eight);
    let values: Vec<u8> = mask.iter().map(|m| m * 255).collect();
    let mut writer = encoder.write_header().map_err(failed)?;
    writer.write_image_data(&values).map_err(failed)?;
    writer.finish().map_err(failed)?;
    Ok(bytes)
}

/// Encodes a `.npz` with one array. The bytes are reproducible, because entries have no current
/// date.
fn zipped(name: &str, array: &[u8]) -> Result<Vec<u8>, StorageError> {
    let failed = |e: String| StorageError::codec("cannot encode a .npz file", e);
    let mut writer = zip::ZipWriter::new(Cursor::new(Vec::new()));
    let options = zip::write::SimpleFileOptions::default()
        .compression_method(zip::CompressionMethod::Deflated)
        .last_modified_time(zip::DateTime::default());
    writer
        .start_file(name, options)
        .map_err(|e| failed(e.to_string()))?;
    writer.write_all(array).map_err(|e| failed(e.to_string()))?;
    let done = writer.finish().map_err(|e| failed(e.to_string()))?;
    Ok(done.into_inner())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_scene_without_what_the_layout_has_files_of_is_refused() {
        let missing = ["normal", "depth", "spots.path", "visibility"].map(str::to_owned);
        let said = check_known(7, &missing).unwrap_err().to_string();
        assert!(
            said.contains("scene 7") && said.contains(": depth, visibility;"),
            "{said}"
        );
        assert!(check_known(7, &["rgb".to_owned()]).is_ok());
    }

    #[test]
    fn the_brightest_bin_comes_close_to_the_top_by_a_power_of_two() {
        for x in [1e-9f32, 0.3, 0.5, 1.0, 1.5, 65_504.0, 3e7] {
            let factor = factor_of(&[0.0, x]);
            let scaled = x * factor;
            assert!(
                (BRIGHTEST / 2.0..=BRIGHTEST).contains(&scaled),
                "{x}: {scaled}"
            );
            assert_eq!(factor.to_bits() & 0x7f_ffff, 0);
        }
    }
}
