//! Documentation of an export for people and tools: `README.md` (a Hugging Face data card),
//! `scenes.csv` (a line per scene) and `croissant.json` (MLCommons Croissant 1.0).

use std::fmt::Write as _;

use serde_json::{Value, json};

use super::{ExportFormat, plain::about};
use picofarm_dataset::DatasetSpec;
use picofarm_dataset::Manifest;
use picofarm_store::sealed::sha256_hex;

/// A line of `scenes.csv`.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Row {
    index: usize,
    source_scene: u64,
    file: String,
    photons_per_unit: f32,
    seed: u64,
    task_key: String,
    renderer: String,
    missing: Vec<String>,
}

/// Columns of `scenes.csv`: name, Croissant type, description.
const COLUMNS: [(&str, &str, &str); 8] = [
    ("index", "sc:Integer", "number of the scene in this export"),
    (
        "source_scene",
        "sc:Integer",
        "number of the scene in the data set that this was exported from",
    ),
    (
        "file",
        "sc:Text",
        "file or folder that holds the scene, or its histogram where arrays have files of their own",
    ),
    (
        "photons_per_unit",
        "sc:Float",
        "photons per unit of the histogram",
    ),
    ("seed", "sc:Text", "seed of the render"),
    (
        "task_key",
        "sc:Text",
        "name of the task that made the scene: equal key, equal bytes",
    ),
    (
        "renderer",
        "sc:Text",
        "versions of renderer, generators and encoder",
    ),
    (
        "missing",
        "sc:Text",
        "what is not known of the scene, between spaces: its values stand for nothing, and are left out of tar and HDF5 files",
    ),
];

impl Row {
    pub(super) fn new(index: usize, manifest: &Manifest, file: &str) -> Self {
        let provenance = &manifest.provenance;
        Self {
            index,
            source_scene: manifest.scene,
            file: file.into(),
            photons_per_unit: manifest.scale,
            seed: provenance.seed,
            task_key: provenance.task_key.clone(),
            renderer: provenance.renderer.clone(),
            missing: manifest.missing(),
        }
    }
}

/// The table of scenes, written after the scenes.
pub(super) const TABLE: &str = "scenes.csv";
/// The metadata of every export, written after the table.
pub(super) const CROISSANT: &str = "croissant.json";

/// Returns the files, in the order of writing.
pub(super) fn files(
    name: &str,
    format: ExportFormat,
    spec: &DatasetSpec,
    rows: &[Row],
) -> Vec<(&'static str, Vec<u8>)> {
    let table = table(rows);
    let croissant = croissant(name, format, spec, rows, &table);
    let mut croissant = serde_json::to_vec_pretty(&croissant).expect("plain data");
    croissant.push(b'\n');
    let card = readme(name, format, spec, rows);
    vec![
        (TABLE, table.into_bytes()),
        (CROISSANT, croissant),
        ("README.md", card.into_bytes()),
    ]
}

fn table(rows: &[Row]) -> String {
    let mut text = COLUMNS.map(|c| c.0).join(",");
    text.push('\n');
    for r in rows {
        // None of the texts can contain a comma: they are keys, versions and our own file names.
        writeln!(
            text,
            "{},{},{},{},{},{},{},{}",
            r.index,
            r.source_scene,
            r.file,
            r.photons_per_unit,
            r.seed,
            r.task_key,
            r.renderer,
            r.missing.join(" ")
        )
        .expect("a string takes everything");
    }
    text
}

/// Returns the pattern and the MIME type of a scene's files.
fn contents(format: ExportFormat) -> (&'static str, &'static str) {
    match format {
        ExportFormat::Zarr => ("**/c/**", "application/vnd+zarr"),
        ExportFormat::Sb3d => ("*/*", "image/x-exr"),
        ExportFormat::WebDataset => ("scenes-*.tar", "application/x-tar"),
        ExportFormat::Hdf5 => ("*.h5", "application/x-hdf5"),
    }
}

fn description(spec: &DatasetSpec, scenes: usize) -> String {
    let gate = &spec.gate;
    format!(
        "{scenes} indoor scenes seen by a simulated single-photon lidar: for each pixel of {}x{} a histogram of the optical path \
         length of laser light that came by way of {} illuminated spots in one, two, three and more bounces ({} bins of {} m of \
         path from {} m), with ground truth: depth, normals, labels, mirrors, and which spot lights what.",
        spec.width, spec.height, spec.spots, gate.bins, gate.bin_width_m, gate.start_m
    )
}

/// Returns Croissant 1.0 metadata
/// (<https://docs.mlcommons.org/croissant/docs/croissant-spec.html>).
fn croissant(
    name: &str,
    format: ExportFormat,
    spec: &DatasetSpec,
    rows: &[Row],
    table: &str,
) -> Value {
    let (pattern, mime) = contents(format);
    let fields: Vec<Value> = COLUMNS
        .iter()
        .map(|(column, kind, about)| {
            json!({
                "@type": "cr:Field",
                "@id": format!("scenes/{column}"),
                "name": column,
                "description": about,
                "dataType": kind,
                "source": {"fileObject": {"@id": "scenes.csv"}, "extract": {"column": column}},
            })
        })
        .collect();
    json!({
        "@context": context(),
        "@type": "sc:Dataset",
        "name": name,
        "description": description(spec, rows.len()),
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "version": "1.0.0",
        "keywords": ["transient imaging", "single-photon lidar", "time of flight", "multi-bounce light"],
        "distribution": [
            {
                "@type": "cr:FileObject",
                "@id": "scenes.csv",
                "name": "scenes.csv",
                "description": "a line a scene",
                "contentUrl": "scenes.csv",
                "contentSize": format!("{} B", table.len()),
                "encodingFormat": "text/csv",
                "sha256": sha256_hex(table.as_bytes()),
            },
            {
                "@type": "cr:FileSet",
                "@id": "scene-files",
                "name": "scene-files",
                "description": "histograms and ground truth",
                "encodingFormat": mime,
                "includes": pattern,
            },
        ],
        "recordSet": [{
            "@type": "cr:RecordSet",
            "@id": "scenes",
            "name": "scenes",
            "description": "the scenes",
            "key": {"@id": "scenes/index"},
            "field": fields,
        }],
    })
}

fn context() -> Value {
    json!({
        "@language": "en",
        "@vocab": "https://schema.org/",
        "citeAs": "cr:citeAs",
        "column": "cr:column",
        "conformsTo": "dct:conformsTo",
        "cr": "http://mlcommons.org/croissant/",
        "rai": "http://mlcommons.org/croissant/RAI/",
        "data": {"@id": "cr:data", "@type": "@json"},
        "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
        "dct": "http://purl.org/dc/terms/",
        "equivalentProperty": "cr:equivalentProperty",
        "examples": {"@id": "cr:examples", "@type": "@json"},
        "extract": "cr:extract",
        "field": "cr:field",
        "fileProperty": "cr:fileProperty",
        "fileObject": "cr:fileObject",
        "fileSet": "cr:fileSet",
        "format": "cr:format",
        "includes": "cr:includes",
        "isLiveDataset": "cr:isLiveDataset",
        "jsonPath": "cr:jsonPath",
        "key": "cr:key",
        "md5": "cr:md5",
        "parentField": "cr:parentField",
        "path": "cr:path",
        "recordSet": "cr:recordSet",
        "references": "cr:references",
        "regex": "cr:regex",
        "repeated": "cr:repeated",
        "replace": "cr:replace",
        "samplingRate": "cr:samplingRate",
        "sc": "https://schema.org/",
        "separator": "cr:separator",
        "source": "cr:source",
        "subField": "cr:subField",
        "transform": "cr:transform",
    })
}

/// Returns instructions for opening the export.
fn open(format: ExportFormat) -> &'static str {
    match format {
        ExportFormat::Zarr => {
            "import numpy, xarray\nlocation, i = \".\", 0\n# the lines that decode a histogram stand in the group's attribute `decode`:\n\
             for line in xarray.open_zarr(location).attrs[\"decode\"]:\n    exec(line)\nprint(h.shape)  # bin, row, column"
        }
        ExportFormat::Sb3d => {
            "import OpenEXR, json\nfolder = \"000000\"\naside = json.load(open(f\"{folder}/picofarm.json\"))\n\
             y = OpenEXR.File(f\"{folder}/lidar_25.exr\").channels()[\"Y\"].pixels  # pixels x bins\n\
             h = y.astype(\"float32\") / aside[\"factor\"]"
        }
        ExportFormat::WebDataset => {
            "import webdataset\nfor sample in webdataset.WebDataset(\"scenes-000000.tar\").decode():\n\
             \x20   h = sample[\"npz\"][\"transient\"]  # row, column, bin"
        }
        ExportFormat::Hdf5 => {
            "import h5py\nwith h5py.File(\"000000.h5\") as f:\n    h = f[\"transient\"][:]  # row, column, bin\n\
             \x20   print(f.attrs[\"bin_width_m\"], f[\"transient\"].attrs[\"long_name\"])"
        }
    }
}

fn readme(name: &str, format: ExportFormat, spec: &DatasetSpec, rows: &[Row]) -> String {
    let size = match rows.len() {
        0..1_000 => "n<1K",
        1_000..10_000 => "1K<n<10K",
        10_000..100_000 => "10K<n<100K",
        _ => "100K<n<1M",
    };
    let mut arrays = String::new();
    for quantity in spec.quantities() {
        writeln!(arrays, "| `{}` | {} |", quantity.name(), about(quantity))
            .expect("a string takes everything");
    }
    let mut made: Vec<&str> = rows.iter().map(|r| &*r.renderer).collect();
    made.sort_unstable();
    made.dedup();
    let lacking = rows.iter().filter(|r| !r.missing.is_empty()).count();
    let unknown = match lacking {
        0 => String::new(),
        n => format!(
            "Of {n} of the scenes not everything is known: the column `missing` of `scenes.csv` lists what. Do not read \
             values of it.\n\n"
        ),
    };
    format!(
        "---\npretty_name: {name}\nlicense: unknown\ntags:\n- transient-imaging\n- single-photon-lidar\n- time-of-flight\n\
         size_categories:\n- {size}\nconfigs:\n- config_name: scenes\n  data_files: scenes.csv\n---\n\n\
         # {name}\n\n{}\n\n`scenes.csv` lists the scenes with the seeds and task keys that they were made of; `croissant.json` says the \
         same to machines. Bin b holds optical path lengths from {} + b·{} m on; light goes 299,792,458 m in a second. \
         No one set a licence here: say which before you publish.\n\n\
         ## Open it\n\n```python\n{}\n```\n\n## Arrays\n\n| name | what it holds |\n| --- | --- |\n{arrays}\n{unknown}\
         In tar and HDF5 files, `scale` is called `photons_per_unit`, normals are floats, and `visibility` has a byte a pixel and spot.\n\n\
         ## Made by\n\n{}\n",
        description(spec, rows.len()),
        spec.gate.start_m,
        spec.gate.bin_width_m,
        open(format),
        made.join("\n")
    )
}
