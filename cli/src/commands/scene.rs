//! `picofarm scene …`: single scenes without a farm.

mod gate;
mod generate;
mod group;
mod order;
mod plan;
pub(super) mod preview;
mod render;
mod sense;
pub mod sensor;

use std::collections::BTreeMap;

use picofarm_proto::show;
use picofarm_scene::{Scene, export};
use serde_json::json;

use crate::{
    args::{FormatArg, Scene as Command, SceneExport},
    error::{CliError, Result, io},
    output::Output,
    settings::Settings,
};

pub async fn run(command: Command, settings: &Settings, output: Output) -> Result<()> {
    match command {
        Command::Generate(args) => generate::run(&args, settings, output),
        Command::Show { file, input } => {
            let scene = input.read(&file)?;
            scene.validate()?;
            let facts = facts(&scene);
            output.result(&facts, || describe(&scene));
            Ok(())
        }
        Command::Export(args) => export_scene(&args, output),
        Command::Render(args) => render::run(args, output).await,
        Command::Plan(args) => plan::run(args, output).await,
        Command::Sense(args) => sense::run(args, output).await,
    }
}

/// `scene export`.
fn export_scene(args: &SceneExport, output: Output) -> Result<()> {
    let extension = args.out.extension().and_then(|e| e.to_str());
    let (format, name) = match (args.format, extension) {
        (Some(FormatArg::Glb), _) | (None, Some("glb")) => (FormatArg::Glb, "scene.glb"),
        (Some(FormatArg::Mitsuba), _) | (None, Some("xml")) => (FormatArg::Mitsuba, "scene.xml"),
        (Some(FormatArg::Ply), _) | (None, Some("ply")) => (FormatArg::Ply, "scene.ply"),
        _ => {
            return Err(
                CliError::input(format!("--out {}: names no format", args.out.display()))
                    .hint("end it in .glb, .xml or .ply, or state --format glb, mitsuba or ply"),
            );
        }
    };
    let scene = args.input.read(&args.file)?;
    let mut out = args.out.clone();
    if extension.is_none() || out.is_dir() {
        std::fs::create_dir_all(&out)
            .map_err(|e| io(format!("cannot make {}", out.display()), &e))?;
        out.push(name);
    }
    let mut notes = Vec::new();
    match format {
        FormatArg::Glb => export::write_glb(&scene, &out)?,
        FormatArg::Mitsuba => notes = export::write_mitsuba(&scene, &out)?,
        FormatArg::Ply => {
            export::write_ply(&scene, &out)?;
            notes.push("camera, laser, BSDFs and textures have no place in a PLY".into());
        }
    }
    output.result(
        &json!({"file": out, "name": scene.name, "objects": scene.objects.len(), "triangles": scene.triangle_count(), "notes": notes}),
        || {
            let mut text = format!("wrote {}: {} objects, {} triangles", out.display(), scene.objects.len(), scene.triangle_count());
            for note in &notes {
                text += &format!("\n  {}", show::line(note));
            }
            text + "\n" + order::notes(&scene).trim_end()
        },
    );
    Ok(())
}

fn facts(scene: &Scene) -> serde_json::Value {
    let mut labels = BTreeMap::<&str, u32>::new();
    for o in &scene.objects {
        *labels
            .entry(scene.labels[usize::from(o.label)].as_str())
            .or_default() += 1;
    }
    let materials = || scene.objects.iter().flat_map(|o| &o.mesh.materials);
    let mirrors = materials().filter(|m| m.is_specular()).count();
    let mut kinds = BTreeMap::<&str, u32>::new();
    for material in materials() {
        *kinds.entry(material.bsdf.name()).or_default() += 1;
    }
    let textured = materials().filter(|m| m.texture.is_some()).count();
    json!({
        "name": scene.name,
        "objects": scene.objects.len(),
        "triangles": scene.triangle_count(),
        "labels": labels,
        "mirror_materials": mirrors,
        "materials": kinds,
        "textured_materials": textured,
        "camera": scene.camera,
        "laser_origin": scene.laser.origin,
        "beams": scene.laser.beams.len(),
        "provenance": scene.provenance,
    })
}

fn describe(scene: &Scene) -> String {
    let f = facts(scene);
    let counts = |field: &str| {
        let counts = f[field].as_object().into_iter().flatten();
        let counts = counts.map(|(name, n)| format!("{} {n}", show::line(name)));
        counts.collect::<Vec<String>>().join(", ")
    };
    let i = &scene.camera.intrinsics;
    let mut text = format!(
        "{}: {} objects, {} triangles\nmaterials: {}; of them {} mirror, {} textured\nlabels: {}\ncamera: {}x{} pixels, focal length {} px, at {:?}\nlaser: {} beams from {:?}\nsource: {}\n",
        show::line(&scene.name),
        scene.objects.len(),
        scene.triangle_count(),
        counts("materials"),
        f["mirror_materials"],
        f["textured_materials"],
        counts("labels"),
        i.width,
        i.height,
        i.fx,
        <[f32; 3]>::from(scene.camera.origin),
        scene.laser.beams.len(),
        <[f32; 3]>::from(scene.laser.origin),
        show::line(&scene.provenance.source),
    );
    for (key, value) in &scene.provenance.notes {
        text += &format!("  {}\n", show::line(&format!("{key}: {value}")));
    }
    for line in &scene.provenance.attribution {
        text += &format!("  {}\n", show::line(line));
    }
    text
}
