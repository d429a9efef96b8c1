//! What figures show: one scene of a data set, decoded.

use std::path::Path;

use picofarm_dataset::{Dataset, Intrinsics, Quantity as Q, SingleRender, Spot};
use picofarm_figures::scene::View;
use picofarm_store::StorageError;

use super::needs_errors;
use crate::{
    args::Figure,
    commands::{dataset, rendered},
    error::{CliError, Result},
};

/// One scene.
pub(super) struct Source {
    /// Pictures and histograms.
    pub view: View,
    /// Distance along the ray, metres.
    pub range: Vec<f32>,
    /// Normals in units of 1/32767, camera frame, `[row][column][3]`.
    pub normal: Vec<i16>,
    /// Label + 1; 0 = nothing.
    pub label: Vec<u16>,
    /// Names of labels.
    pub names: Vec<String>,
    /// Spots in the camera frame.
    pub spots: Vec<Option<Spot>>,
    /// Of the camera.
    pub intrinsics: Intrinsics,
    /// Relative error of each pixel's histogram without one bounce; NaN without light.
    pub error: Option<Vec<f32>>,
}

impl Source {
    /// Reads the scene that the arguments name.
    ///
    /// # Errors
    /// Fails for a file, for what is no data set, and for a scene that is not there.
    pub async fn read(args: &Figure) -> Result<Self> {
        let place = &args.render;
        if Path::new(place).is_file() {
            return Err(
                CliError::input(format!("{place}: is a file, not a render")).hint(format!(
                    "render it first: picofarm scene render {place} --out render"
                )),
            );
        }
        let dataset = dataset::open(place).await.map_err(|e| {
            e.hint("expected a folder that `picofarm scene render FILE --out FOLDER` wrote, or a data set")
        })?;
        let scene = args.scene;
        let present = dataset.scenes_present().await.map_err(dataset::failed)?;
        if !present.contains(&scene) {
            let there = match (present.first(), present.last()) {
                (Some(first), Some(last)) => format!("scenes {first} to {last}"),
                _ => "no finished scene".into(),
            };
            return Err(CliError::input(format!(
                "--scene {scene}: {place} has no such scene; it has {there}"
            )));
        }
        let error = match needs_errors(&args.panels) {
            true => Some(errors(Path::new(place))?),
            false => None,
        };
        Self::decoded(&dataset, scene, error)
            .await
            .map_err(dataset::failed)
    }

    async fn decoded(
        dataset: &Dataset,
        scene: u64,
        error: Option<Vec<f32>>,
    ) -> Result<Self, StorageError> {
        let manifest = dataset.manifest(scene).await?;
        let names = manifest.provenance.plan["labels"].as_array();
        let names = names.into_iter().flatten();
        Ok(Self {
            view: dataset::view(dataset, scene).await?,
            range: dataset.read(scene, Q::Range).await?,
            normal: dataset.read(scene, Q::Normal).await?,
            label: dataset.read(scene, Q::Label).await?,
            names: names
                .map(|n| n.as_str().unwrap_or_default().to_owned())
                .collect(),
            spots: dataset.read_spots(scene).await?,
            intrinsics: dataset.read_intrinsics(scene).await?,
            error,
        })
    }

    /// Returns the surface point that a pixel's middle sees, camera frame; `None` for nothing.
    pub fn point(&self, [column, row]: [usize; 2]) -> Option<[f64; 3]> {
        let z = f64::from(self.view.depth[row * self.view.width + column]);
        let i = &self.intrinsics;
        let direction = |pixel: usize, centre: f32, focal: f32| {
            (pixel as f64 + 0.5 - f64::from(centre)) / f64::from(focal)
        };
        (z > 0.0).then(|| {
            [
                z * direction(column, i.cx, i.fx),
                z * direction(row, i.cy, i.fy),
                z,
            ]
        })
    }
}

/// Returns the relative error of each pixel of a render with its parts.
fn errors(dir: &Path) -> Result<Vec<f32>> {
    let needs = || {
        CliError::input(format!(
            "--panels error: {} has no standard errors of its bins",
            dir.display()
        ))
        .hint("only `picofarm scene render FILE --split --out FOLDER` writes them")
    };
    if !SingleRender::is_in(dir) {
        return Err(needs());
    }
    let rendered::Folder::Render(render) = rendered::Folder::open(dir)? else {
        return Err(needs());
    };
    if !render.group.has("two_se") {
        return Err(needs());
    }
    let spec = render.dataset.spec();
    let shape = [spec.height, spec.width, spec.gate.bins].map(u64::from);
    let read = |name: &str| rendered::array::<f32>(dir, &render.group, name, &shape);
    let (two, multi) = (read("two")?, read("multi")?);
    let (two_se, multi_se) = (read("two_se")?, read("multi_se")?);
    let bins = spec.gate.bins as usize;
    let square = |x: f32| f64::from(x) * f64::from(x);
    let pixel = |k: usize| {
        let at = k * bins..(k + 1) * bins;
        let norm: f64 = at.clone().map(|b| square(two[b] + multi[b])).sum();
        let error: f64 = at.map(|b| square(two_se[b]) + square(multi_se[b])).sum();
        (error / norm).sqrt() as f32
    };
    Ok((0..spec.pixels()).map(pixel).collect())
}
