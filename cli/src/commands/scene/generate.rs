//! `picofarm scene generate`.

use picofarm_proto::show;
use picofarm_scene::{
    AssetLibrary, Scene, export,
    furnished::{self, FurnishedSettings},
    plato::{self, PlatoObject, PlatoSettings},
    primitive::{self, PrimitiveSettings},
};
use picofarm_settings::{FloorPlan, Spots};
use serde_json::json;

use crate::{
    args::{FloorPlanArg, GeneratorArg, PlatoArg, SceneGenerate},
    error::{CliError, Result},
    output::Output,
    settings::Settings,
};

/// `scene generate`.
///
/// # Errors
/// Settings out of range, missing furniture, or a file that cannot be written.
pub fn run(args: &SceneGenerate, settings: &Settings, output: Output) -> Result<()> {
    let scene = generate(args, settings)?;
    let out = &args.out;
    let bytes = export::glb_bytes(&scene)?;
    let replaced = out.is_file() && std::fs::read(out).is_ok_and(|there| there != bytes);
    export::write_glb(&scene, out)?;
    output.result(
        &json!({"file": out, "name": scene.name, "objects": scene.objects.len(), "triangles": scene.triangle_count(), "replaced": replaced}),
        || format!(
            "wrote {}{}: {} objects, {} triangles; next: picofarm scene render {} --out render",
            out.display(), if replaced { " over another file" } else { "" }, scene.objects.len(), scene.triangle_count(), show::path(out)
        ),
    );
    Ok(())
}

fn generate(args: &SceneGenerate, settings: &Settings) -> Result<Scene> {
    let spots = args.spots.clone();
    match args.kind {
        GeneratorArg::Furnished => {
            let library =
                AssetLibrary::named(&args.assets, std::slice::from_ref(&settings.assets))?;
            let settings = FurnishedSettings {
                assets: library.name().to_owned(),
                specular_at_least: 1,
                floor_plan: match args.floor_plan {
                    FloorPlanArg::Box => FloorPlan::Box,
                    FloorPlanArg::Varied => FloorPlan::Varied,
                },
                spots: spots.unwrap_or(Spots::Grid(25)),
                width: args.resolution,
                height: args.resolution,
                ..Default::default()
            };
            Ok(furnished::generate(args.seed, &settings, &library)?)
        }
        GeneratorArg::Primitive | GeneratorArg::Desktop => {
            let preset = match args.kind {
                GeneratorArg::Desktop => PrimitiveSettings::desktop(),
                _ => PrimitiveSettings::default(),
            };
            let settings = PrimitiveSettings {
                spots: spots.unwrap_or(preset.spots),
                width: args.resolution,
                height: args.resolution,
                ..preset
            };
            Ok(primitive::generate(args.seed, &settings)?)
        }
        GeneratorArg::Plato => {
            let object = match args.object {
                PlatoArg::Chair => PlatoObject::Chair,
                PlatoArg::Armchair => PlatoObject::Armchair,
                PlatoArg::HiddenBox => PlatoObject::HiddenBox,
                PlatoArg::Empty => PlatoObject::Empty,
            };
            let spots = spots.unwrap_or(Spots::Grid(16));
            if !spots.is_grid() {
                let what = format!(
                    "--spots {spots}: plato rooms have spots of their own; give a number of them, up to 16"
                );
                return Err(CliError::input(what));
            }
            let spots = spots.count() as usize;
            Ok(plato::generate(&PlatoSettings {
                object,
                spots,
                resolution: args.resolution,
            })?)
        }
    }
}
