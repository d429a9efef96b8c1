//! `picofarm scene sense`: passes a rendered scene through a sensor.

use std::{path::Path, time::Instant};

use futures::executor::block_on;
use picofarm_dataset::{RenderArray, RenderGroup, write_render_group};
use picofarm_sensor::{
    Frame, Histograms, PS_PER_M, SENSOR_VERSION, Scale, Sensed, Sensor, SensorError, Values,
    narrow, sense_image,
};
use picofarm_tasks::counts;
use picofarm_transient::Gate;
use serde_json::{Map, Value, json};

use super::sensor;
use crate::{
    args::SceneSense,
    commands::rendered::{self, Folder, unreadable},
    error::{CliError, Code, Result},
    output::{Output, duration, files},
};

pub async fn run(args: SceneSense, output: Output) -> Result<()> {
    let sensor = sensor::settings(&args.sensor)?;
    files::free_folder(&args.out)?;
    let threads = args.threads.unwrap_or_else(picofarm_tasks::cores).max(1);
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(threads)
        .build()
        .map_err(|e| {
            CliError::new(
                Code::Resource,
                format!("cannot start {threads} threads: {e}"),
            )
        })?;
    let start = Instant::now();
    let report = tokio::task::spawn_blocking(move || pool.install(|| sense(&args, &sensor)))
        .await
        .map_err(|e| CliError::new(Code::Failed, format!("the sensor model broke: {e}")))??;
    let seconds = start.elapsed().as_secs_f64();
    let mut document = report.facts;
    document.insert("seconds".into(), json!(seconds));
    output.result(&document, || {
        format!("{} in {}\n", report.text, duration(seconds))
    });
    Ok(())
}

struct Report {
    facts: Map<String, Value>,
    text: String,
}

fn sense(args: &SceneSense, sensor: &Sensor) -> Result<Report> {
    let dir = &args.render;
    let Folder::Render(render) = Folder::open(dir)? else {
        return Err(CliError::input(format!("{}: is no render", dir.display()))
            .hint("expected a folder that `picofarm scene render FILE --out FOLDER` wrote"));
    };
    let group = &render.group;
    let spec = render.dataset.spec();
    let gate = spec.gate;
    let shape = vec![
        u64::from(spec.height),
        u64::from(spec.width),
        u64::from(gate.bins),
    ];
    let bins = gate.bins as usize;
    let transient = rendered::transient(dir, &render)?;
    let manifest = block_on(render.dataset.manifest(0)).map_err(|e| unreadable(dir, e))?;
    let counted = counts::are_counts(&transient, manifest.scale, &manifest.provenance.plan);
    if let Some(field) = sensor.disturbs().filter(|_| counted && !args.on_counts) {
        let what = format!("{}: {}", dir.display(), counts::refusal(field));
        return Err(CliError::input(what).hint(
            "to sum bins or zones only: --pulse none --jitter-ps 0 --photons-per-unit 1 --no-poisson; to add the \
             sensor's noise all the same: --on-counts",
        ));
    }
    // Only a scale by peak depends on the two-bounce part, and zones see the spots as well.
    let by_peak = !matches!(sensor.scale, Scale::Fixed { .. });
    let two = match by_peak && sensor.zones.is_none() && group.has("two") {
        true => Some(rendered::array(dir, group, "two", &shape)?),
        false => None,
    };
    let input = Histograms {
        transient: &transient,
        two_bounce: two.as_deref(),
        bins,
        bin_width_ps: gate.bin_width_m * PS_PER_M,
    };
    let frame = Frame {
        width: spec.width as usize,
        start_ps: gate.start_m * PS_PER_M,
    };
    let sensed = sense_image(sensor, &input, &frame, args.seed, args.scene)
        .map_err(|e: SensorError| CliError::input(format!("{}: {e}", args.render.display())))?;
    let scale_from = match (by_peak, &two) {
        (false, _) => "settings",
        (true, Some(_)) => "two",
        (true, None) => "transient",
    };
    let attributes = attributes(group, gate, sensor, &sensed, args, scale_from);
    let [rows, columns] = match sensor.zones {
        Some(zones) => [zones.rows, zones.columns],
        None => [spec.height, spec.width],
    };
    let shape = vec![u64::from(rows), u64::from(columns), sensed.bins as u64];
    let (array, data_type, photons) = write(&args.out, &shape, &sensed.values, &attributes)?;
    let mut facts = Map::new();
    for name in [
        "scale",
        "scale_from",
        "peak_photons",
        "shift_bins",
        "dropped",
        "gate",
    ] {
        facts.insert(name.into(), attributes[name].clone());
    }
    for (name, value) in [
        ("out", json!(args.out)),
        ("array", json!(array)),
        ("data_type", json!(data_type)),
        ("shape", json!(shape)),
        ("photons", json!(photons)),
    ] {
        facts.insert(name.into(), value);
    }
    let mut text = format!(
        "{}: {array} ({data_type}, {} bins of {:.1} ps), {photons:.4e} photons",
        args.out.display(),
        sensed.bins,
        sensed.bin_width_ps
    );
    if let Some(peak) = sensed.peak_photons {
        text += &format!(", {peak:.1} in the median peak");
    }
    let dropped = &sensed.dropped;
    text += &format!(
        ", {:.2e} ({:.3} %) pushed out of the gate",
        dropped.outside_photons,
        dropped.outside_share * 100.0
    );
    if dropped.bins > 0 {
        text += &format!(
            ", last {} bin(s) left over and dropped ({:.2e} photons)",
            dropped.bins, dropped.bins_photons
        );
    }
    if dropped.pile_up_photons > 0.0 {
        text += &format!(", {:.2e} lost to pile-up", dropped.pile_up_photons);
    }
    let mut notes = notes(args, sensor, gate, spec.spots);
    if counted && sensor.disturbs().is_some() {
        notes.push(
            "the histograms are photon counts: they have their own pulse and noise, and the sensor's come on top (--on-counts)"
                .into(),
        );
    }
    if spec.per_spot {
        notes.push(
            "the result has the histogram of all spots alone; the histograms of each spot are not measured"
                .into(),
        );
    }
    for note in &notes {
        text += &format!("\n  note: {note}");
    }
    facts.insert("notes".into(), json!(notes));
    Ok(Report { facts, text })
}

/// Returns what the render cannot give the sensor.
fn notes(args: &SceneSense, sensor: &Sensor, gate: Gate, spots: u32) -> Vec<String> {
    let mut notes = Vec::new();
    if let Some(preset) = args.sensor.preset.map(|p| p.0) {
        notes.push(format!(
            "the field of view of the {} is {}; the render's camera must have it too",
            preset.device(),
            preset.view()
        ));
        if preset.floods() && spots < 100 {
            notes.push(format!(
                "it lights the whole view with one flash, which the renderer does not do: the render's {spots} spots \
                 stand for it, and zones between them see no direct light; use 100 spots with wide beams"
            ));
        }
        notes.push(format!("assumed, not published: {}", preset.assumed()));
    }
    if let Some(own) = sensor.gate {
        let (from, to) = (gate.bin_width_m * PS_PER_M, own.bin_width_ps);
        if from > 0.5 * to {
            notes.push(format!(
                "the render's bins of {from:.0} ps are wide for the sensor's of {to:.0} ps: light is spread evenly over \
                 a bin of the render; render with bins of at most {:.0} ps",
                0.25 * to
            ));
        }
    }
    notes
}

/// Returns the camera with the pixels of the zones.
fn zoned(camera: &Value, sensor: &Sensor) -> Value {
    let mut camera = camera.clone();
    let Some(zones) = sensor.zones else {
        return camera;
    };
    if let Some(pinhole) = camera.get_mut("intrinsics").and_then(Value::as_object_mut) {
        let axes = [
            ("width", zones.columns, ["fx", "cx"]),
            ("height", zones.rows, ["fy", "cy"]),
        ];
        for (size, to, fields) in axes {
            let Some(from) = pinhole.get(size).and_then(Value::as_f64) else {
                continue;
            };
            for field in fields {
                if let Some(x) = pinhole.get(field).and_then(Value::as_f64) {
                    pinhole.insert(field.into(), json!(x * f64::from(to) / from));
                }
            }
            pinhole.insert(size.into(), json!(to));
        }
    }
    camera
}

/// Returns the attributes that are needed to interpret the counts, and to reproduce them.
fn attributes(
    group: &RenderGroup,
    gate: Gate,
    sensor: &Sensor,
    sensed: &Sensed,
    args: &SceneSense,
    scale_from: &str,
) -> Map<String, Value> {
    let render = group.attributes();
    let mut all = Map::new();
    for name in ["scene", "provenance", "camera", "laser_origin", "spots"] {
        if let Some(value) = render.get(name) {
            let value = match name {
                "camera" => zoned(value, sensor),
                _ => value.clone(),
            };
            all.insert(name.into(), value);
        }
    }
    let mut of_render = Map::new();
    for name in ["gate", "settings", "error", "overflow", "plan", "renderer"] {
        if let Some(value) = render.get(name) {
            of_render.insert(name.into(), value.clone());
        }
    }
    let (start_m, width_m) = match sensor.gate {
        Some(own) => (own.start_ps / PS_PER_M, own.bin_width_ps / PS_PER_M),
        None => (gate.start_m, gate.bin_width_m),
    };
    let sensed_gate = Gate {
        start_m,
        bin_width_m: width_m * f64::from(sensor.rebin),
        bins: sensed.bins as u32,
    };
    let value = match sensed.values {
        Values::Counts(_) => "counts: photons counted in the bin",
        Values::Rate(_) => "rate: photons expected in the bin",
    };
    for (name, value) in [
        ("value", json!(value)),
        ("gate", json!(sensed_gate)),
        ("sensor", json!(sensor)),
        ("sensor_version", json!(SENSOR_VERSION)),
        ("seed", json!(args.seed)),
        ("scene_number", json!(args.scene)),
        ("scale", json!(sensed.scale)),
        ("scale_from", json!(scale_from)),
        ("peak_photons", json!(sensed.peak_photons)),
        ("shift_bins", json!(sensed.shift_bins)),
        ("dropped", json!(sensed.dropped)),
        ("render", Value::Object(of_render)),
    ] {
        all.insert(name.into(), value);
    }
    all
}

/// Writes the array in the narrowest type. Returns its name, type and sum.
fn write(
    out: &Path,
    shape: &[u64],
    values: &Values,
    attributes: &Map<String, Value>,
) -> Result<(&'static str, &'static str, f64)> {
    let names = ["row", "column", "bin"];
    let dimension_names = &names[..shape.len().min(3)];
    macro_rules! array {
        ($name:literal, $data:expr) => {
            write_render_group(
                out,
                &[RenderArray {
                    name: $name,
                    shape,
                    dimension_names,
                    data: $data,
                }],
                attributes,
            )
        };
    }
    let (name, data_type, written) = match values {
        Values::Rate(rate) => ("rate", "float32", array!("rate", rate)),
        Values::Counts(counts) => match narrow(counts) {
            Some(narrow) => ("counts", "uint16", array!("counts", &narrow)),
            None => ("counts", "uint32", array!("counts", counts)),
        },
    };
    written.map_err(|e| CliError::new(Code::Resource, e))?;
    Ok((name, data_type, values.sum()))
}

#[cfg(test)]
mod tests;
