//! The Zarr group of one render.

use std::path::Path;

use picofarm_dataset::{RenderArray, write_render_group};
use picofarm_transient::Rendered;
use serde_json::json;

use super::{
    order::Order,
    preview::{self, Preview},
};
use crate::{
    args::groups::Wanted,
    error::{CliError, Code, Result, io},
};

/// The picture in the folder of a render.
pub const PREVIEW: &str = "preview.png";

/// The histograms of a subset of the beams.
pub struct Subset {
    array: String,
    per_spot: bool,
    data: Vec<f32>,
}

/// Takes the subsets' histograms out of the render. Each is freed as soon as it is copied, so that
/// the histograms of a hundred spots are never in memory twice.
pub fn take_subsets(rendered: &mut Rendered, order: &Order) -> Vec<Subset> {
    let one = rendered.transient.len();
    let mut groups = std::mem::take(&mut rendered.groups).into_iter();
    let join = move |wanted: &Wanted| Subset {
        array: wanted.array.clone(),
        per_spot: wanted.per_spot,
        data: if wanted.per_spot {
            let count = wanted.groups.len();
            let mut all = Vec::with_capacity(count * one);
            groups.by_ref().take(count).for_each(|g| all.extend(g));
            all
        } else {
            groups.next().unwrap_or_default()
        },
    };
    order.wanted.iter().map(join).collect()
}

/// Writes the render as a Zarr group.
///
/// # Errors
/// Fails if a value is not finite, or if the group cannot be written.
pub fn write(out: &Path, order: &Order, r: &Rendered, subsets: &[Subset]) -> Result<()> {
    let Order {
        scene,
        settings,
        wanted,
        ..
    } = order;
    let (h, w, b) = (
        u64::from(r.height),
        u64::from(r.width),
        u64::from(r.gate.bins),
    );
    let cube = [h, w, b];
    let each = [scene.laser.beams.len() as u64, h, w, b];
    let histogram = |name, data| RenderArray {
        name,
        shape: &cube,
        dimension_names: &["row", "column", "bin"],
        data,
    };
    let masks = [scene.laser.beams.len() as u64, h, w];
    let flags = |all: &[u8]| all.iter().map(|x| f32::from(*x)).collect::<Vec<_>>();
    let (specular, visibility) = (flags(&r.truth.specular), flags(&r.truth.visibility));
    let mut arrays = vec![
        histogram("transient", &r.transient),
        RenderArray {
            name: "depth",
            shape: &cube[..2],
            dimension_names: &["row", "column"],
            data: &r.truth.depth,
        },
        RenderArray {
            name: "specular",
            shape: &cube[..2],
            dimension_names: &["row", "column"],
            data: &specular,
        },
    ];
    if !visibility.is_empty() {
        arrays.push(RenderArray {
            name: "visibility",
            shape: &masks,
            dimension_names: &["spot", "row", "column"],
            data: &visibility,
        });
    }
    for s in subsets {
        arrays.push(match s.per_spot {
            false => histogram(&s.array, &s.data),
            true => RenderArray {
                name: &s.array,
                shape: &each,
                dimension_names: &["spot", "row", "column", "bin"],
                data: &s.data,
            },
        });
    }
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
    let beams: serde_json::Map<_, _> = wanted
        .iter()
        .map(|w| (w.array.clone(), json!(w.groups.concat())))
        .collect();
    let arrays_of_all = subsets.iter().map(|s| s.array.clone());
    let wavelengths: serde_json::Map<_, _> = settings
        .optics
        .wavelengths_nm
        .nm()
        .into_iter()
        .flat_map(|nm| {
            let names = ["transient".to_owned()].into_iter();
            names
                .chain(arrays_of_all.clone())
                .map(move |name| (name, json!(nm)))
        })
        .collect();
    let mut attributes = json!({
        "scene": scene.name,
        "provenance": scene.provenance,
        "value": "radiance reaching the pixel per unit pulse energy, averaged over its footprint, integrated over the bin; 1/(m2 sr)",
        "transient": "all bounces; two: exactly two; multi: three and more; *_se: standard errors; two_noise, multi_noise: draws of the errors of two and multi; the square of their sum over any pixels and bins estimates that sum's variance",
        "specular": "1 where the first surface is a mirror",
        "visibility": "1 where the spot of a beam lights what a pixel's middle sees",
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
    if !wavelengths.is_empty() {
        attributes["wavelengths_nm"] = json!(wavelengths);
    }
    let attributes = attributes.as_object().expect("written as an object");
    for array in arrays
        .iter()
        .filter(|array| array.dimension_names.contains(&"bin"))
    {
        if let Some(at) = array.data.iter().position(|x| !x.is_finite()) {
            let (x, bins) = (array.data[at], r.gate.bins as usize);
            let what = format!(
                "scene {:?}: {} is {x} at pixel {}, bin {}; nothing was written",
                scene.name,
                array.name,
                at / bins,
                at % bins
            );
            return Err(CliError::new(Code::Failed, what).hint(
                "the renderer is at fault: report it with the scene, or try another --seed",
            ));
        }
    }
    write_render_group(out, &arrays, attributes).map_err(|e| CliError::new(Code::Resource, e))?;
    let picture = preview::draw(&Preview {
        width: r.width as usize,
        height: r.height as usize,
        bins: r.gate.bins as usize,
        gate_start_m: r.gate.start_m,
        bin_width_m: r.gate.bin_width_m,
        transient: &r.transient,
        depth: &r.truth.depth,
    });
    let path = out.join(PREVIEW);
    std::fs::write(&path, picture.png())
        .map_err(|e| io(format!("cannot write {}", path.display()), &e))
}
