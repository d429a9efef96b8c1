//! What a reconstruction looks like: novel views beside the truth, and a walk around as an animation.

use picofarm_reconstruct::{Reconstructed, World, render::Renderer};
use picofarm_scene::{Camera, Vec3};
use rayon::prelude::*;

use crate::{
    error::{CliError, Code, Result},
    picture::{
        canvas::{Canvas, TEXT},
        colour::{inferno, viridis},
    },
};

/// Side of a picture in pixels.
const CELL: usize = 160;
/// Room between pictures.
const GAP: usize = 8;
/// Novel views that are shown.
const SHOWN: usize = 3;
/// The error at which its colour map ends, metres.
const WORST_M: f32 = 0.3;
/// Frames of the animation.
const FRAMES: usize = 24;
/// Hundredths of a second a frame.
const DELAY: u16 = 12;

/// True distance, reconstructed distance, their difference, and the shaded surface, in rows of novel views.
pub fn views(made: &Reconstructed, world: &World, cameras: &[Camera]) -> Canvas {
    let columns = [
        "true distance".to_owned(),
        "reconstructed".to_owned(),
        format!("error, 0-{:.0} cm", 100.0 * WORST_M),
        "surface".to_owned(),
    ];
    let shown: Vec<&Camera> = (0..SHOWN.min(cameras.len()))
        .map(|k| &cameras[(2 * k + 1) * cameras.len() / (2 * SHOWN)])
        .collect();
    let (step, top) = (CELL + GAP, GAP + TEXT + GAP);
    let mut canvas = Canvas::new(
        GAP + columns.len() * step,
        top + shown.len() * step,
        [18, 18, 22],
    );
    for (k, title) in columns.iter().enumerate() {
        canvas.text(GAP + k * step, GAP, title, [220, 220, 220]);
    }
    let renderer = Renderer::new(&made.field);
    for (row, camera) in shown.iter().enumerate() {
        let camera = Camera {
            intrinsics: camera.intrinsics.resized(CELL as u32, CELL as u32),
            ..**camera
        };
        let truth = distances(world, &camera);
        let found = renderer.view(&camera);
        let far = truth.iter().flatten().copied().fold(1e-3, f32::max);
        let depth = |d: Option<f32>| d.map_or([40, 40, 46], |d| viridis(1.0 - d / far));
        let error = |p: usize| match (truth[p], found[p]) {
            (Some(t), Some(f)) => inferno((t - f).abs() / WORST_M),
            (None, _) => [40, 40, 46],
            (Some(_), None) => inferno(1.0),
        };
        let shade = shaded(&found, &camera);
        let grey = |p: usize| [(255.0 * shade[p]) as u8; 3];
        let size = (CELL, CELL);
        let y = top + row * step;
        canvas.image((GAP, y), CELL, size, |p| depth(truth[p]));
        canvas.image((GAP + step, y), CELL, size, |p| depth(found[p]));
        canvas.image((GAP + 2 * step, y), CELL, size, error);
        canvas.image((GAP + 3 * step, y), CELL, size, grey);
    }
    canvas
}

/// The surface from views all around, as a GIF.
///
/// # Errors
/// The animation cannot be coded.
pub fn orbit(made: &Reconstructed, cameras: &[Camera]) -> Result<Vec<u8>> {
    let palette: Vec<u8> = (0..=255u8).flat_map(|i| [i; 3]).collect();
    let failed = |e: gif::EncodingError| CliError::new(Code::Failed, format!("orbit.gif: {e}"));
    let mut bytes = Vec::new();
    let side = CELL as u16;
    {
        let mut encoder = gif::Encoder::new(&mut bytes, side, side, &palette).map_err(failed)?;
        encoder.set_repeat(gif::Repeat::Infinite).map_err(failed)?;
        let renderer = Renderer::new(&made.field);
        let frames = FRAMES.min(cameras.len());
        for k in 0..frames {
            let camera = &cameras[k * cameras.len() / frames];
            let camera = Camera {
                intrinsics: camera.intrinsics.resized(CELL as u32, CELL as u32),
                ..*camera
            };
            let shade = shaded(&renderer.view(&camera), &camera);
            let frame = gif::Frame {
                width: side,
                height: side,
                delay: DELAY,
                buffer: shade.iter().map(|s| (255.0 * s) as u8).collect(),
                ..gif::Frame::default()
            };
            encoder.write_frame(&frame).map_err(failed)?;
        }
    }
    Ok(bytes)
}

/// True distance along each pixel's ray.
fn distances(world: &World, camera: &Camera) -> Vec<Option<f32>> {
    let width = camera.intrinsics.width as usize;
    let pixels = width * camera.intrinsics.height as usize;
    (0..pixels)
        .into_par_iter()
        .map_init(
            || world.stack(),
            |stack, p| {
                let ray = ray(camera, p % width, p / width);
                world
                    .closest(stack, camera.origin, ray)
                    .map(|hit| hit.range)
            },
        )
        .collect()
}

fn ray(camera: &Camera, x: usize, y: usize) -> Vec3 {
    camera.ray(x as f32 + 0.5, y as f32 + 0.5).normalized()
}

/// Lambertian shading in [0, 1] by a lamp at the camera; normals from neighbouring distances.
fn shaded(distance: &[Option<f32>], camera: &Camera) -> Vec<f32> {
    let (w, h) = (
        camera.intrinsics.width as usize,
        camera.intrinsics.height as usize,
    );
    let point = |x: usize, y: usize| {
        let d = distance[y * w + x]?;
        Some(ray(camera, x, y) * d)
    };
    let shade = |p: usize| {
        let (x, y) = (p % w, p / w);
        let (right, below) = ((x + 1).min(w - 1), (y + 1).min(h - 1));
        let (left, above) = (right - 1, below - 1);
        let normal = (point(right, y)? - point(left, y)?)
            .cross(point(x, below)? - point(x, above)?)
            .normalized();
        let facing = normal.dot(ray(camera, x, y)).abs();
        Some(0.15 + 0.8 * if facing.is_finite() { facing } else { 0.0 })
    };
    (0..w * h).map(|p| shade(p).unwrap_or(0.08)).collect()
}
