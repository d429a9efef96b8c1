//! The scenes of a benchmark: presets by name, or files.

use std::path::Path;

use picofarm_scene::{
    Aim, AssetLibrary, Scene,
    furnished::{self, FurnishedSettings},
    import,
    primitive::{self, PrimitiveSettings},
};

use crate::args::Render as RenderArgs;
use picofarm_cli::error::{CliError, Result};

use super::tessellate::tessellate;

/// Default image width and height.
const PIXELS: u32 = 32;

/// Returns the scene called `name`, at the size that the arguments request.
///
/// # Errors
/// Fails if the name is neither a preset nor a readable scene file, or if a size is out of range.
pub fn load(name: &str, args: &RenderArgs) -> Result<Scene> {
    let pixels = args.resolution.unwrap_or(PIXELS);
    let mut scene = match preset(name)? {
        Some((kind, seed)) => generate(kind, seed, args.spots, pixels)?,
        None => import::read_scene(Path::new(name)).map_err(|e| {
            CliError::from(e).hint("name a scene file, or one of the presets furnished, primitive")
        })?,
    };
    resize(&mut scene, pixels);
    if let Some(n) = args.triangles {
        tessellate(&mut scene, n)?;
    }
    Ok(scene)
}

/// Sets another resolution with the same view.
pub fn resize(scene: &mut Scene, pixels: u32) {
    let i = &mut scene.camera.intrinsics;
    *i = i.resized(pixels, pixels);
}

/// Sets another grid of spots in the same room.
///
/// # Errors
/// Fails if there is no such grid.
pub fn with_spots(scene: &mut Scene, spots: u32) -> Result<()> {
    let aim = Aim::grid(spots).ok_or_else(|| {
        CliError::input(format!(
            "{spots} spots: there are grids of 1, 4, 16, 25 and 100 spots"
        ))
    })?;
    scene.laser = aim.laser(&scene.camera);
    Ok(())
}

#[derive(Clone, Copy)]
enum Preset {
    Furnished,
    Primitive,
}

/// Parses `furnished` or `primitive`, with an optional `:SEED` (default 1).
fn preset(name: &str) -> Result<Option<(Preset, u64)>> {
    let (kind, seed) = match name.split_once(':') {
        Some((kind, seed)) => (kind, Some(seed)),
        None => (name, None),
    };
    let kind = match kind {
        "furnished" => Preset::Furnished,
        "primitive" => Preset::Primitive,
        _ => return Ok(None),
    };
    let seed = seed.map_or(Ok(1), str::parse).map_err(|_| {
        CliError::input(format!("{name}: expected a number after the colon"))
            .hint("write for example furnished:7")
    })?;
    Ok(Some((kind, seed)))
}

/// Generates a scene with parametric furniture, which is the same on every machine.
fn generate(kind: Preset, seed: u64, spots: u32, pixels: u32) -> Result<Scene> {
    let mut scene = match kind {
        Preset::Furnished => {
            let library = AssetLibrary::parametric();
            let settings = FurnishedSettings {
                assets: library.name().to_owned(),
                specular_at_least: 1,
                width: pixels,
                height: pixels,
                ..Default::default()
            };
            furnished::generate(seed, &settings, &library)?
        }
        Preset::Primitive => {
            let settings = PrimitiveSettings {
                width: pixels,
                height: pixels,
                ..Default::default()
            };
            primitive::generate(seed, &settings)?
        }
    };
    with_spots(&mut scene, spots)?;
    Ok(scene)
}
