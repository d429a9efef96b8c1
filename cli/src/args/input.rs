//! Arguments of commands that read a scene file.

use std::path::{Path, PathBuf};

use clap::Args;
use picofarm_scene::{
    Aim, Scene, SceneError, Vec3,
    import::{self, Bounds, ImportOptions, Unit, View},
};
use picofarm_settings::{Resolution, Spots};

use super::ranges;

/// How a scene file is read, and what replaces its camera, laser and unit.
#[derive(Args, Default)]
pub struct SceneInput {
    /// Folder that holds every mesh, buffer and texture the scene names [default: any folder]
    #[arg(long = "root", value_name = "DIR")]
    pub root: Option<PathBuf>,
    #[command(flatten)]
    pub view: ViewArgs,
    /// Laser spots in the camera's view, in place of the file's laser: a grid of 1, 4, 16, 25 or
    /// 100; random:N; or places as X,Y/X,Y (0 to 1, right and down) [default: the file's laser, or
    /// 25]
    #[arg(long, value_parser = ranges::spots)]
    pub spots: Option<Spots>,
    /// Unit of length of the file: m, cm, mm, in or ft [default: the format's; for formats without
    /// one m, or mm above 50 m]
    #[arg(long, value_name = "UNIT")]
    pub unit: Option<Unit>,
}

/// The camera.
#[derive(Args, Default, PartialEq)]
pub struct ViewArgs {
    /// Camera of the file, by name or number from 0 [default: the first]
    #[arg(long, value_name = "NAME")]
    pub camera: Option<String>,
    /// Position of the camera, metres [default: the file's camera; without one, inside a room or in
    /// front of the objects]
    #[arg(long, value_name = "X,Y,Z", value_parser = point, allow_hyphen_values = true)]
    pub look_from: Option<Vec3>,
    /// Point in the middle of the image, metres
    #[arg(long, value_name = "X,Y,Z", value_parser = point, allow_hyphen_values = true)]
    pub look_at: Option<Vec3>,
    /// Width of the view in degrees, 1 to 170
    #[arg(long, value_name = "DEG", value_parser = ranges::degrees)]
    pub fov: Option<f32>,
    /// Direction that is upwards in the image [default: 0,1,0]
    #[arg(long, value_name = "X,Y,Z", value_parser = point, allow_hyphen_values = true)]
    pub up: Option<Vec3>,
}

impl SceneInput {
    /// Reads a scene file.
    ///
    /// # Errors
    /// Those of [`import::read_scene_with`].
    pub fn read(&self, file: &Path) -> Result<Scene, SceneError> {
        self.read_sized(file, None)
    }

    /// Like [`Self::read`], with an image of the given size.
    ///
    /// # Errors
    /// Those of [`import::read_scene_with`].
    pub fn read_sized(&self, file: &Path, size: Option<Resolution>) -> Result<Scene, SceneError> {
        let view = &self.view;
        let options = ImportOptions {
            view: View {
                camera: view.camera.clone(),
                from: view.look_from,
                at: view.look_at,
                fov_deg: view.fov,
                up: view.up,
            },
            // The parser has checked the spots.
            laser: self.spots.as_ref().and_then(|s| Aim::of(s, 0).ok()),
            unit: self.unit,
            size,
            ..ImportOptions::default()
        };
        let bounds = Bounds {
            root: Some(self.root.clone().unwrap_or_else(|| "/".into())),
            ..Bounds::default()
        };
        import::read_scene_with(file, &options, &bounds)
    }
}

/// Parses a point or a direction.
fn point(text: &str) -> Result<Vec3, String> {
    let numbers: Vec<f32> = text
        .split(',')
        .map(|w| w.trim().parse::<f32>().ok().filter(|x| x.is_finite()))
        .collect::<Option<_>>()
        .unwrap_or_default();
    match numbers[..] {
        [x, y, z] => Ok(Vec3::new(x, y, z)),
        _ => Err("expected three numbers, such as 0,1.5,4".into()),
    }
}
