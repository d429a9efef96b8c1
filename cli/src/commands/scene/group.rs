//! The folder of one render: a data set of one scene.

use std::path::Path;

use picofarm_dataset::{
    Dataset, DatasetSpec, Profile, Quantity, RenderArray, SingleRenderParts, Subsets,
    write_single_render,
};
use picofarm_tasks::{By, encode_render, renderer_version};
use picofarm_transient::Rendered;
use serde_json::json;

use super::{
    order::Order,
    preview::{self, Preview},
};
use crate::{
    args::groups::Wanted,
    error::{CliError, Code, Result},
};

/// Returns the properties of the one-scene data set that a render is stored as.
///
/// # Errors
/// Returns the option at fault for sizes that no data set has.
pub fn spec(order: &Order) -> Result<DatasetSpec> {
    let has = |quantity| order.wanted.iter().any(|w| w.quantity == Some(quantity));
    let sizes = [(Quantity::Transient4, 4), (Quantity::Transient25, 25)];
    let sizes: Vec<u32> = sizes
        .into_iter()
        .filter(|s| has(s.0))
        .map(|s| s.1)
        .collect();
    let i = &order.scene.camera.intrinsics;
    let spec = DatasetSpec {
        scenes: 1,
        height: i.height,
        width: i.width,
        spots: order.scene.laser.beams.len() as u32,
        subsets: Subsets::of(&sizes).map_err(CliError::input)?,
        per_spot: has(Quantity::TransientSpots),
        wavelengths_nm: order.settings.optics.wavelengths_nm,
        two_bounce: false,
        gate: order.settings.gate,
        profile: Profile::LOSSLESS,
    };
    spec.check().map_err(|e| {
        CliError::input(e).hint("--resolution, --spots and --bins change these numbers")
    })?;
    Ok(spec)
}

/// Writes the render as a data set of one scene, with what data sets lack in its group `render`.
///
/// # Errors
/// Fails if a value is not finite, or if the folder cannot be written.
pub async fn write(out: &Path, order: &Order, spec: &DatasetSpec, r: &Rendered) -> Result<()> {
    let Order {
        scene,
        settings,
        wanted,
        ..
    } = order;
    let cube = [
        u64::from(r.height),
        u64::from(r.width),
        u64::from(r.gate.bins),
    ];
    let histogram = |name, data| RenderArray {
        name,
        shape: &cube,
        dimension_names: &["row", "column", "bin"],
        data,
    };
    let (standard, named): (Vec<&Wanted>, Vec<&Wanted>) =
        wanted.iter().partition(|w| w.quantity.is_some());
    let first: usize = standard.iter().map(|w| w.groups.len()).sum();
    let groups = r.groups.get(first..).unwrap_or_default();
    let mut arrays: Vec<RenderArray<'_>> = named
        .iter()
        .zip(groups)
        .map(|(wanted, data)| histogram(&wanted.array, data))
        .collect();
    if let Some(s) = &r.split {
        arrays.extend([
            histogram("two", &s.two),
            histogram("two_se", &s.two_se),
            histogram("two_noise", &s.two_noise),
            histogram("multi", &s.multi),
            histogram("multi_se", &s.multi_se),
            histogram("multi_noise", &s.multi_noise),
        ]);
    }
    check_finite(&scene.name, &histogram("transient", &r.transient))?;
    for array in &arrays {
        check_finite(&scene.name, array)?;
    }
    let beams: serde_json::Map<_, _> = wanted
        .iter()
        .map(|w| (w.array.clone(), json!(w.groups.concat())))
        .collect();
    let attributes = json!({
        "scene": scene.name,
        "provenance": scene.provenance,
        "value": "radiance reaching the pixel per unit pulse energy, averaged over its footprint, integrated over the bin; 1/(m2 sr)",
        "parts": "two: exactly two bounces; multi: three and more; *_se: standard errors; two_noise, multi_noise: draws of the errors of two and multi; the square of their sum over any pixels and bins estimates that sum's variance",
        "subsets": beams,
        "gate": r.gate,
        "settings": settings,
        "camera": scene.camera,
        "laser_origin": scene.laser.origin,
        "spots": r.spots,
        "error": r.error,
        "overflow": r.overflow,
        "plan": r.plan,
        "renderer": picofarm_transient::RENDERER_VERSION,
    });
    let attributes = attributes.as_object().expect("written as an object");
    let picture = preview::draw(&Preview {
        width: r.width as usize,
        height: r.height as usize,
        bins: r.gate.bins as usize,
        gate_start_m: r.gate.start_m,
        bin_width_m: r.gate.bin_width_m,
        transient: &r.transient,
        depth: Some(&r.truth.depth),
    });
    let parts = SingleRenderParts {
        arrays: &arrays,
        attributes,
        picture: &picture.png(),
    };
    // The scene's content is not hashed: its file and choices are in the provenance.
    let made_from = json!([
        scene.provenance,
        scene.camera,
        scene.laser.origin,
        r.spots,
        settings
    ]);
    let by = By {
        task_key: picofarm_store::sha256_hex(made_from.to_string().as_bytes()),
        renderer: renderer_version(),
    };
    let encode = |dataset: &Dataset| encode_render(dataset, 0, scene, settings, r, by);
    write_single_render(out, spec, encode, &parts)
        .await
        .map_err(|e| CliError::new(Code::Resource, e))
}

/// Checks that all values of a histogram are finite.
fn check_finite(scene: &str, array: &RenderArray<'_>) -> Result<()> {
    let Some(at) = array.data.iter().position(|x| !x.is_finite()) else {
        return Ok(());
    };
    let (x, bins) = (array.data[at], array.shape[2] as usize);
    let what = format!(
        "scene {scene:?}: {} is {x} at pixel {}, bin {}; nothing was written",
        array.name,
        at / bins,
        at % bins
    );
    Err(CliError::new(Code::Failed, what)
        .hint("the renderer is at fault: report it with the scene, or try another --seed"))
}
