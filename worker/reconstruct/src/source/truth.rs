//! Measurements from a rendered scene's ground truth, exact or with known errors. For tests and
//! tables.

use picofarm_scene::{Scene, Vec3};
use picofarm_transient::Rendered;

use crate::{
    LeftOut, Measured, MeasuredSpot, NEAR_SPOT_SINE, ReconstructError,
    rng::{Rng, Stream},
};

/// The errors that are added to the truth.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Disturbed {
    /// The width of bins, metres: times and paths to spots are rounded to the middles of such bins;
    /// 0 = exact.
    pub bin_width_m: f32,
    /// The standard deviation of normal noise on every time, metres.
    pub noise_m: f32,
    /// The amplitude of a depth error that varies smoothly over the image, as in a network's
    /// predictions, metres.
    pub smooth_m: f32,
    /// The share of mask pixels that are wrong, drawn independently.
    pub flipped: f32,
    /// The seed of noise and flips.
    pub seed: u64,
}

/// Returns the measurements of a rendered scene: times by geometry from its depth, masks from its
/// visibility. Pixels that see nothing or a mirror are not used. A beam that was reflected by a
/// mirror has its folded path.
///
/// # Errors
/// [`ReconstructError::Invalid`] if `rendered` does not belong to this scene.
pub fn from_truth(
    scene: &Scene,
    rendered: &Rendered,
    how: &Disturbed,
) -> Result<Measured, ReconstructError> {
    let camera = scene.camera;
    let truth = &rendered.truth;
    let mut measured = Measured {
        camera,
        laser: scene.laser.origin,
        spots: Vec::new(),
        tau: Vec::new(),
        lit: Vec::new(),
        used: Vec::new(),
        bin_width_m: how.bin_width_m,
        mirror: truth.specular.clone(),
        computed: false,
        confidence: Vec::new(),
        unlit_range_m: Vec::new(),
        left_out: Vec::new(),
    };
    let pixels = measured.pixels();
    let beams = scene.laser.beams.len();
    if truth.range.len() != pixels || truth.visibility.len() != beams * pixels {
        let what =
            format!("expected the truth of {pixels} pixels and {beams} beams; render this scene");
        return Err(ReconstructError::invalid("rendered", what));
    }
    let middle = |x: f32| match how.bin_width_m > 0.0 {
        true => ((x / how.bin_width_m).floor() + 0.5) * how.bin_width_m,
        false => x,
    };
    let error: Vec<f32> = (0..pixels)
        .map(|p| how.smooth_m * wave(&camera, p))
        .collect();
    for (beam, spot) in rendered.spots.iter().enumerate() {
        let Some(spot) = spot else {
            let why = "it meets no surface".to_owned();
            measured.left_out.push(LeftOut { beam, why });
            continue;
        };
        let material = &scene.objects[spot.object as usize].mesh.materials[spot.material as usize];
        if material.is_specular() {
            let why = "its spot lies on a mirror".to_owned();
            measured.left_out.push(LeftOut { beam, why });
            continue;
        }
        let straight = (spot.point - scene.laser.origin).length();
        let folded = (straight - spot.path_m).abs() > 1e-2;
        let direction = scene.laser.beams[beam].direction;
        // A lidar measures twice the distance, there and back.
        let path_m = if folded {
            spot.path_m
        } else {
            0.5 * middle(2.0 * spot.path_m)
        };
        let point = if folded {
            spot.point
        } else {
            scene.laser.origin + direction * path_m
        };
        let to_spot = (spot.point - camera.origin).normalized();
        for (p, &wrong) in error.iter().enumerate() {
            let (ray, range) = (measured.ray(p), truth.range[p]);
            let mut rng = Rng::new(how.seed, Stream::Noise, (beam * pixels + p) as u64);
            let near = ray.cross(to_spot).length() < NEAR_SPOT_SINE;
            let mut lit = truth.visibility[beam * pixels + p] != 0;
            let depth = range + wrong;
            let x = camera.origin + ray * depth;
            let mut tau =
                spot.path_m + (x - spot.point).length() + depth + how.noise_m * rng.normal();
            if rng.unit() < how.flipped {
                lit = !lit;
                // A false return comes late, from three bounces.
                tau += if lit { 0.1 + 1.5 * rng.unit() } else { 0.0 };
            }
            let usable = range > 0.0 && truth.specular[p] == 0 && !near && middle(tau) > path_m;
            measured.tau.push(if lit { middle(tau) } else { 0.0 });
            measured.lit.push(u8::from(lit));
            measured.used.push(u8::from(usable));
        }
        measured.spots.push(MeasuredSpot {
            beam,
            direction,
            point,
            path_m,
            folded,
        });
    }
    Ok(measured)
}

/// Returns a smooth pattern over the image with values in about [−1.6, 1.6].
fn wave(camera: &picofarm_scene::Camera, pixel: usize) -> f32 {
    let width = camera.intrinsics.width as usize;
    let a = (pixel % width) as f32 / width as f32;
    let b = (pixel / width) as f32 / width as f32;
    libm::sinf(a * 31.0 + 1.0) * libm::cosf(b * 27.0) + 0.6 * libm::sinf(a * 83.0 + b * 71.0)
}

/// Returns the truth's normals in world axes, `[row][column]`, facing the camera; zero if a pixel
/// sees nothing.
pub fn surface_normals(scene: &Scene, rendered: &Rendered) -> Vec<Vec3> {
    let c = &scene.camera;
    let world = |n: &[f32]| c.right * n[0] + c.down * n[1] + c.forward * n[2];
    rendered.truth.normal.chunks_exact(3).map(world).collect()
}
