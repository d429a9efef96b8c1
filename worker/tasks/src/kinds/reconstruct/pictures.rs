//! Pictures of a reconstruction from novel views, next to the ground truth.

use picofarm_figures::{Canvas, TEXT, inferno, viridis};
use picofarm_reconstruct::{Reconstructed, World, render::Renderer};
use picofarm_scene::{Camera, Vec3};
use rayon::prelude::*;

/// Width and height of a picture, in pixels.
pub const CELL: usize = 160;
/// Gap between pictures, in pixels.
const GAP: usize = 8;
/// Top edge of the first row of pictures.
const TOP: usize = GAP + TEXT + GAP;
/// Number of novel views in the picture.
const SHOWN: usize = 3;
/// Upper end of the colour map for errors, in metres.
const WORST_M: f32 = 0.3;
const BACKGROUND: [u8; 3] = [18, 18, 22];
/// Colour of pixels without a value.
const NOTHING: [u8; 3] = [40, 40, 46];

/// Returns the headings of the columns of [`views`].
pub fn columns() -> [String; 4] {
    [
        "true distance".to_owned(),
        "reconstructed".to_owned(),
        format!("error, 0-{:.0} cm", 100.0 * WORST_M),
        "surface".to_owned(),
    ]
}

/// Distance between the left edges of two columns, in pixels.
pub const STEP: usize = CELL + GAP;

/// Draws true distance, reconstructed distance, their difference and the shaded surface, one novel
/// view per row. The first row shows the view most similar to that of the measuring camera. The
/// difference is that of the metrics: pixels without a reconstructed surface have the distance to
/// the end of the grid.
pub fn views(made: &Reconstructed, world: &World, cameras: &[Camera]) -> Canvas {
    let mut shown: Vec<&Camera> = (0..SHOWN.min(cameras.len()))
        .map(|k| &cameras[(2 * k + 1) * cameras.len() / (2 * SHOWN)])
        .collect();
    let ahead = made.measured.camera.forward;
    shown.sort_by(|a, b| b.forward.dot(ahead).total_cmp(&a.forward.dot(ahead)));
    let columns = columns();
    let size = (GAP + columns.len() * STEP, TOP + shown.len() * STEP);
    let mut canvas = Canvas::new(size.0, size.1, BACKGROUND);
    for (k, title) in columns.iter().enumerate() {
        canvas.text(GAP + k * STEP, GAP, title, [220, 220, 220]);
    }
    let renderer = Renderer::new(&made.field);
    for (row, camera) in shown.iter().enumerate() {
        let camera = resized(camera);
        let truth = distances(world, &camera);
        let found = renderer.view(&camera);
        let far = truth.iter().flatten().copied().fold(1e-3, f32::max);
        let depth = |d: Option<f32>| d.map_or(NOTHING, |d| viridis(1.0 - d / far));
        let or_end = |p: usize| {
            let ray = ray(&camera, p % CELL, p / CELL);
            found[p].unwrap_or_else(|| renderer.depth_or_end(camera.origin, ray))
        };
        let error = |p: usize| match truth[p] {
            Some(t) => inferno((t - or_end(p)).abs() / WORST_M),
            None => NOTHING,
        };
        let shade = shading(&found, &camera);
        let size = (CELL, CELL);
        let y = TOP + row * STEP;
        canvas.image((GAP, y), CELL, size, |p| depth(truth[p]));
        canvas.image((GAP + STEP, y), CELL, size, |p| depth(found[p]));
        canvas.image((GAP + 2 * STEP, y), CELL, size, error);
        canvas.image((GAP + 3 * STEP, y), CELL, size, |p| [shade[p]; 3]);
    }
    canvas
}

/// Returns the first row of a picture drawn by [`views`]; `None` if it shows no view.
pub fn first_row(drawn: &Canvas) -> Option<Canvas> {
    drawn.part((GAP, TOP), (columns().len() * STEP, CELL))
}

/// Renders the surface from a view as grey values, [`CELL`] pixels on each side.
pub fn shaded(renderer: &Renderer<'_>, camera: &Camera) -> Vec<u8> {
    let camera = resized(camera);
    shading(&renderer.view(&camera), &camera)
}

fn resized(camera: &Camera) -> Camera {
    Camera {
        intrinsics: camera.intrinsics.resized(CELL as u32, CELL as u32),
        ..*camera
    }
}

/// Returns the true distance along each pixel's ray.
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

/// Returns Lambertian shading by a lamp at the camera. Normals are estimated from neighbouring
/// distances.
fn shading(distance: &[Option<f32>], camera: &Camera) -> Vec<u8> {
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
    let grey = |p| (255.0 * shade(p).unwrap_or(0.08)) as u8;
    (0..w * h).map(grey).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_view_is_cut_out_of_a_picture_of_views() {
        let drawn = |rows: usize| {
            let mut canvas = Canvas::new(GAP + 4 * STEP, TOP + rows * STEP, BACKGROUND);
            for row in 0..rows {
                let grey = [row as u8 + 100; 3];
                canvas.image((GAP, TOP + row * STEP), CELL, (1, 1), |_| grey);
            }
            canvas
        };
        let mut expected = Canvas::new(4 * STEP, CELL, BACKGROUND);
        expected.image((0, 0), CELL, (1, 1), |_| [100; 3]);
        for rows in [1, 2, 3] {
            assert_eq!(first_row(&drawn(rows)).as_ref(), Some(&expected));
        }
        assert_eq!(first_row(&drawn(0)), None);
        assert_eq!(first_row(&Canvas::new(10, 10, [0; 3])), None);
    }
}
