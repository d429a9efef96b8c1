//! The demo's first room in 3D from one flash: the histogram of all spots is taken apart by
//! physics, and its depth and shadows give a mesh. No ground truth is used, except for the printed
//! error.

use std::path::{Path, PathBuf};

use picofarm_dataset::{Dataset, Quantity};
use picofarm_demultiplex::{DepthScore, Settings, Truth, demultiplex, score as flash_score};
use picofarm_figures::{Canvas, TEXT};
use picofarm_proto::spec::kinds::demultiplex::Places;
use picofarm_reconstruct::{
    ReconstructError, Reconstructed, Settings as GridSettings, Surface, Unwatched, reconstruct,
    render::Renderer, score, source::from_flash, surface,
};
use picofarm_scene::Camera;
use picofarm_store::StorageError;
use picofarm_tasks::{
    demultiplex::Flash,
    reconstruct::{CELL, shaded},
};
use serde_json::{Value, json};

use crate::{
    commands::{dataset, reconstruct::orbit::orbit},
    error::{CliError, Code, Result, io},
    output::files::{save, write_atomically},
};

/// The scene.
const SCENE: u64 = 0;
/// Nodes per side of the grid: two thirds of the default, for half its time.
const NODES: u32 = 128;
/// Number of views on the circle, before those near a surface are removed.
const AROUND: usize = 24;
const GAP: usize = 8;
const BACKGROUND: [u8; 3] = [18, 18, 22];
const INK: [u8; 3] = [220, 220, 220];

/// A room in 3D, or the reason why there is none: very small images and few spots may have too
/// little light for the method.
pub struct Room(std::result::Result<Made, String>);

struct Made {
    folder: PathBuf,
    depth: DepthScore,
    triangles: usize,
    /// What makes the measurements doubtful, a sentence each.
    doubts: Vec<String>,
}

impl Room {
    /// Reconstructs the first room of the data set at `place`, and writes its mesh and pictures
    /// into `dir`.
    ///
    /// # Errors
    /// Fails if the data set cannot be read, or the folder cannot be written.
    pub async fn of(place: &str, dir: &Path) -> Result<Self> {
        let dataset = dataset::open(place).await?;
        let folder = dir.join("room-3d");
        let handle = tokio::runtime::Handle::current();
        tokio::task::spawn_blocking(move || {
            let read = handle
                .block_on(Seen::read(&dataset))
                .map_err(dataset::failed)?;
            make(&read, folder)
        })
        .await
        .map_err(|e| CliError::new(Code::Failed, format!("the reconstruction broke: {e}")))?
    }

    /// Returns the facts for JSON.
    pub fn facts(&self) -> Value {
        match &self.0 {
            Ok(made) => json!({
                "folder": made.folder, "scene": SCENE, "triangles": made.triangles,
                "depth_mae_m": made.depth.mae_m, "depth_median_m": made.depth.median_m,
                "doubts": made.doubts,
            }),
            Err(why) => json!({"scene": SCENE, "refused": why}),
        }
    }

    /// Describes where mesh and pictures are.
    pub fn told(&self) -> String {
        let made = match &self.0 {
            Ok(made) => made,
            Err(why) => return format!("room {SCENE} in 3D     refused: {why}\n"),
        };
        let mut text = format!(
            "room {SCENE} in 3D     {} (one flash, taken apart by physics; depth off by {:.1} mm in the median)\n\
             from behind      {}\n",
            made.folder.join("mesh.glb").display(),
            made.depth.median_m * 1e3,
            made.folder.join("views.png").display(),
        );
        for doubt in &made.doubts {
            text += &format!("  doubtful: {doubt}\n");
        }
        text
    }
}

/// What the data set has of the room.
struct Seen {
    flash: Flash,
    rgb: Vec<u8>,
    depth_m: Vec<f32>,
    specular: Vec<u8>,
}

impl Seen {
    async fn read(dataset: &Dataset) -> std::result::Result<Self, StorageError> {
        let (flash, rgb, depth_m, specular) = futures::try_join!(
            Flash::of(dataset, SCENE, Quantity::Transient, Places::Given),
            dataset.read::<u8>(SCENE, Quantity::Rgb),
            dataset.read::<f32>(SCENE, Quantity::Depth),
            dataset.read::<u8>(SCENE, Quantity::Specular),
        )?;
        Ok(Self {
            flash,
            rgb,
            depth_m,
            specular,
        })
    }
}

/// A capture taken apart and reconstructed.
struct Fitted {
    depth: DepthScore,
    made: Reconstructed,
    mesh: Surface,
    glb: Vec<u8>,
}

/// Computes the room.
///
/// # Errors
/// Returns the method's reason to refuse the capture.
fn fit(seen: &Seen) -> std::result::Result<Fitted, String> {
    let capture = seen.flash.capture();
    let found = demultiplex(&capture, &Settings::default()).map_err(|e| e.to_string())?;
    let truth = Truth {
        depth_m: &seen.depth_m,
        specular: &seen.specular,
        visibility: &[],
    };
    let refused = |e: ReconstructError| e.to_string();
    let measured = from_flash(&capture, &found, seen.flash.beams()).map_err(refused)?;
    let settings = GridSettings {
        nodes: NODES,
        accept_inconsistent: true,
        ..GridSettings::default()
    };
    let made = reconstruct(measured, settings, &Unwatched).map_err(refused)?;
    let mesh = surface(&made.field);
    Ok(Fitted {
        depth: flash_score::depth(&found.depth_m, &truth),
        glb: mesh.glb(&made.measured).map_err(refused)?,
        mesh,
        made,
    })
}

fn make(seen: &Seen, folder: PathBuf) -> Result<Room> {
    let fitted = match fit(seen) {
        Ok(fitted) => fitted,
        Err(why) => return Ok(Room(Err(why))),
    };
    let made = &fitted.made;
    std::fs::create_dir_all(&folder).map_err(|e| io(folder.display(), &e))?;
    write_atomically(&folder.join("mesh.glb"), &fitted.glb)?;
    let renderer = Renderer::new(&made.field);
    let side = CELL as u32;
    let views = score::around_unseen(&made.measured, &made.depth.range, &renderer, AROUND, side);
    save(&picture(seen, made, &views), &folder.join("views.png"))?;
    if !views.is_empty() {
        write_atomically(&folder.join("orbit.gif"), &orbit(made, &views))?;
    }
    Ok(Room(Ok(Made {
        folder,
        depth: fitted.depth,
        triangles: fitted.mesh.triangles.len(),
        doubts: made.agreement.reasons.clone(),
    })))
}

/// Draws what the camera sees next to the surface: from the camera, from the side, and from behind.
fn picture(seen: &Seen, made: &Reconstructed, views: &[Camera]) -> Canvas {
    let camera = made.measured.camera;
    let ahead = camera.forward;
    let by = |wanted: f32| {
        let off = |v: &Camera| (v.forward.dot(ahead) - wanted).abs();
        views.iter().min_by(|a, b| off(a).total_cmp(&off(b)))
    };
    let mut shown = vec![("3D, from the camera", &camera)];
    shown.extend(by(0.0).map(|v| ("from the side", v)));
    // Straight back, the view would be of what is behind the camera.
    shown.extend(by(-0.6).map(|v| ("from behind", v)));
    let step = CELL + GAP;
    let top = GAP + TEXT + GAP;
    let mut canvas = Canvas::new(GAP + (1 + shown.len()) * step, top + CELL + GAP, BACKGROUND);
    canvas.text(GAP, GAP, "what the camera sees", INK);
    let i = &camera.intrinsics;
    let size = (i.width as usize, i.height as usize);
    canvas.image((GAP, top), CELL, size, |p| {
        [seen.rgb[3 * p], seen.rgb[3 * p + 1], seen.rgb[3 * p + 2]]
    });
    let renderer = Renderer::new(&made.field);
    for (k, (title, view)) in shown.into_iter().enumerate() {
        let at = GAP + (k + 1) * step;
        canvas.text(at, GAP, title, INK);
        let shade = shaded(&renderer, view);
        canvas.image((at, top), CELL, (CELL, CELL), |p| [shade[p]; 3]);
    }
    canvas
}
