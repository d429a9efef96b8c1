//! Folders in the formats of data sets, read as captures: the spots stay apart.

use super::super::{
    Captures, Format, ImportError, ImportOptions, ImportedScene, Source, import_scene,
};
use super::describe::{Described, Description};
use super::{Beam, Capture, DESCRIPTION, EXAMPLE, Origin, arrays};
use picofarm_files::Opener;
use std::path::Path;

/// Reads the captures of a folder as one scene.
pub(super) fn read(
    described: &Described,
    description: &Description,
    opener: &Opener,
) -> Result<Capture, ImportError> {
    let root = described.source.as_deref().unwrap_or(&described.folder);
    refuse_others(root, opener)?;
    // The format decides which options it takes.
    let bare = Source::open_within(root, None, ImportOptions::default(), None, opener);
    let options = match bare {
        Ok(source) => fitting(description.options(described)?, source.format()),
        Err(_) => {
            let options = description.options(described)?;
            fitting(options, Format::BfLidar)
        }
    };
    let source = Source::open_within(root, None, options, None, opener).map_err(described_how)?;
    let mut scenes: Vec<ImportedScene> = Vec::new();
    let apart = matches!(source.format(), Format::Platonerf | Format::BfLidar);
    if !apart && source.scenes() != 1 {
        return Err(ImportError::refused(
            root,
            "scenes",
            "one scene",
            source.scenes().to_string(),
            "name the folder of one scene, or import all with `picofarm dataset import`",
        ));
    }
    for index in 0..source.scenes() {
        scenes.push(import_scene(&source, index)?);
    }
    joined(&source, scenes, apart)
}

/// Refuses folders that hold no files of a laboratory.
fn refuse_others(root: &Path, opener: &Opener) -> Result<(), ImportError> {
    opener.check(root)?;
    let io = |e| ImportError::io("read", root, e);
    let expected = "a folder with a laboratory's histogram files";
    if root.join("zarr.json").is_file() {
        let hint = "use it as it is: `picofarm capture show FOLDER` and the other commands read it";
        let found = "already a data set";
        return Err(ImportError::refused(
            root, "contents", expected, found, hint,
        ));
    }
    if root.read_dir().map_err(io)?.next().is_none() {
        let hint = format!("put the histogram files and {DESCRIPTION} there");
        let found = "the folder is empty";
        return Err(ImportError::refused(
            root, "contents", expected, found, hint,
        ));
    }
    Ok(())
}

/// The error for a folder in no known layout, with the ways that a capture has.
fn described_how(error: ImportError) -> ImportError {
    match error {
        ImportError::Refused {
            file,
            field,
            expected,
            found,
            ..
        } if field == "contents" => ImportError::Refused {
            file,
            field,
            expected,
            found,
            hint: format!(
                "name the histogram files, or describe them in {DESCRIPTION} in the folder, for example\n{EXAMPLE}"
            ),
        },
        other => other,
    }
}

/// The options of the description that the format takes.
fn fitting(options: ImportOptions, format: Format) -> ImportOptions {
    let none = ImportOptions {
        captures: Captures::Separate,
        ..ImportOptions::default()
    };
    match format {
        Format::Npy => none,
        Format::Sb3d | Format::Platonerf => ImportOptions {
            bins: None,
            laser_m: None,
            t0_s: None,
            ..options
        },
        Format::BfLidar => ImportOptions {
            fov_deg: None,
            // The scan's axes are left, up, forward.
            laser_m: options.laser_m.map(|[x, y, z]| [-x, -y, z]),
            ..options
        },
    }
}

fn joined(
    source: &Source,
    mut scenes: Vec<ImportedScene>,
    apart: bool,
) -> Result<Capture, ImportError> {
    let first = scenes.remove(0);
    let shape = first.shape;
    let mut all = vec![first];
    all.append(&mut scenes);
    let mut values = Vec::new();
    let (mut beams, mut origin) = (Vec::new(), Origin::default());
    for scene in &mut all {
        beams.extend(scene.spots.iter().map(|spot| match spot {
            Some(s) => Beam::Spot {
                position: s.position,
                path_m: s.path_m,
            },
            None => Beam::Nothing,
        }));
        values.append(&mut scene.transient);
        origin.files.append(&mut scene.files);
        for note in scene.conversions.drain(..) {
            if !origin.conversions.contains(&note) {
                origin.conversions.push(note);
            }
        }
    }
    origin.files.sort();
    origin.files.dedup();
    origin.format = source.format().name().into();
    let first = &all[0];
    let (sum, per_spot) = match apart {
        true => (arrays::sum(&values, beams.len()), Some(values)),
        false => (values, None),
    };
    let depth = !first.missing.contains(&"depth");
    Ok(Capture {
        name: match source.name(0) {
            Some(".") | None => "capture".into(),
            Some(name) => name.split('/').next().unwrap_or(name).to_owned(),
        },
        height: shape.height,
        width: shape.width,
        gate: shape.gate,
        sum,
        per_spot,
        intrinsics: first.intrinsics,
        laser: first.laser,
        beams,
        depth: depth.then(|| first.depth.clone()),
        origin,
    })
}
