//! The reference scenes and transients in a folder next to the workspace, and the comparison with
//! them.

use std::path::PathBuf;

use picofarm_scene::{Beam, Bsdf, Distribution, Material, Scene, Spot, Vec3};
use serde_json::Value;

use super::{npz, object, scene};

/// Mean and standard error, `[row][col][bin]`.
pub struct Part {
    pub mean: Vec<f32>,
    pub se: Vec<f32>,
}

fn folder() -> PathBuf {
    PathBuf::from(std::env::var("CARGO_MANIFEST_DIR").unwrap())
        .join("../../../shared/reference/transients")
}

/// Returns the scene `name`, or prints a message and returns `None` if the references are not next
/// to the workspace.
pub fn load(name: &str) -> Option<(Scene, Value)> {
    let path = folder().join(format!("{name}.json"));
    let Ok(text) = std::fs::read_to_string(&path) else {
        println!("skipped: no reference scene at {}", path.display());
        return None;
    };
    let json: Value = serde_json::from_str(&text).unwrap();
    Some((build(&json), json))
}

/// Returns part `two` or `multi` of the reference.
pub fn part(name: &str, which: &str) -> Part {
    let path = folder().join(format!("{name}_64.npz"));
    let scale = npz::read(&path, &format!("{which}_se_scale"))[0];
    let mut se = npz::read(&path, &format!("{which}_se"));
    for s in &mut se {
        *s *= scale;
    }
    Part {
        mean: npz::read(&path, &format!("{which}_mean")),
        se,
    }
}

fn vec3(v: &Value) -> Vec3 {
    let x = |i: usize| v[i].as_f64().unwrap() as f32;
    Vec3::new(x(0), x(1), x(2))
}

fn bsdf(b: &Value) -> Bsdf {
    match b["type"].as_str().unwrap() {
        "diffuse" => Bsdf::Diffuse {
            reflectance: b["reflectance"].as_f64().unwrap() as f32,
        },
        _ => Bsdf::RoughConductor {
            alpha: b["alpha"].as_f64().unwrap() as f32,
            distribution: Distribution::Beckmann,
            reflectance: 1.0,
        },
    }
}

fn build(json: &Value) -> Scene {
    let mut objects = vec![];
    for m in json["meshes"].as_array().unwrap() {
        let numbers = m["vertices"].as_array().unwrap();
        let positions = numbers
            .chunks(3)
            .map(|c| {
                let x = |i: usize| c[i].as_f64().unwrap() as f32;
                Vec3::new(x(0), x(1), x(2))
            })
            .collect();
        let faces = m["faces"].as_array().unwrap();
        let triangles = faces
            .chunks(3)
            .map(|c| [0, 1, 2].map(|i| c[i].as_u64().unwrap() as u32))
            .collect();
        let material = Material {
            name: "reference".into(),
            bsdf: bsdf(&m["bsdf"]),
            rgb: [0.5; 3],
            texture: None,
            two_sided: false,
            spectrum: vec![],
        };
        objects.push(object(
            m["name"].as_str().unwrap(),
            positions,
            triangles,
            material,
        ));
    }
    let mut scene = scene(objects, 64, &[]);
    for s in json["spots"].as_array().unwrap() {
        let direction = vec3(&s["dir"]).normalized();
        scene.laser.beams.push(Beam {
            direction,
            spot: Some(Spot {
                point: vec3(&s["p"]),
                normal: vec3(&s["n"]).normalized(),
                arriving: direction,
                path_m: s["laser_dist"].as_f64().unwrap() as f32,
                object: s["mesh_index"].as_u64().unwrap() as u32,
                material: 0,
            }),
        });
    }
    scene
}

/// The comparison of a part with its reference.
#[derive(Debug)]
pub struct Report {
    /// Median over pixels of ‖h − r‖/‖r‖.
    pub median: f64,
    /// Median over pixels of the reference's own standard error, relative like `median`.
    pub reference_median: f64,
    /// Σh/Σr.
    pub ratio: f64,
    /// Standard error of the ratio, including both sides' errors.
    pub ratio_se: f64,
    /// Root mean square of the deviation over groups of 8×8 pixels × 13 bins, in units of its
    /// expected value, including both variances.
    pub z_rms: f64,
    /// Largest deviation in units of the reference's standard error.
    pub z_max: f64,
}

/// Compares a 64×64×637 part and a draw of its error with the reference. `None` means that the
/// error is small compared to the reference's.
pub fn compare(h: &[f32], noise: Option<&[f32]>, r: &Part) -> Report {
    let bins = 637;
    let (mut errors, mut noises) = (vec![], vec![]);
    for k in 0..64 * 64 {
        let (mut e, mut n, mut s) = (0.0f64, 0.0f64, 0.0f64);
        let range = k * bins..(k + 1) * bins;
        let theirs = r.mean[range.clone()].iter().zip(&r.se[range.clone()]);
        for (&h, (&mean, &se)) in h[range].iter().zip(theirs) {
            e += f64::from(h - mean).powi(2);
            n += f64::from(mean).powi(2);
            s += f64::from(se).powi(2);
        }
        if n > 0.0 {
            errors.push((e / n).sqrt());
            noises.push((s / n).sqrt());
        }
    }
    let median = |v: &mut Vec<f64>| {
        v.sort_by(f64::total_cmp);
        v[v.len() / 2]
    };
    let (mut z2, mut expected, mut z_max) = (0.0, 0.0, 0.0f64);
    let (mut sum, mut reference, mut variance) = (0.0, 0.0, 0.0);
    for row in 0..8 {
        for col in 0..8 {
            for block in 0..49 {
                let (mut d, mut own, mut theirs) = (0.0, 0.0, 0.0);
                for pixel in 0..64 {
                    let (y, x) = (row * 8 + pixel / 8, col * 8 + pixel % 8);
                    let at = (y * 64 + x) * bins + block * 13;
                    for i in at..at + 13 {
                        d += f64::from(h[i]) - f64::from(r.mean[i]);
                        own += noise.map_or(0.0, |n| f64::from(n[i]));
                        theirs += f64::from(r.se[i]).powi(2);
                        sum += f64::from(h[i]);
                        reference += f64::from(r.mean[i]);
                    }
                }
                // Groups have little in common, so their errors are added as independent.
                variance += own * own + theirs;
                if theirs > 0.0 {
                    let z2_here = d * d / theirs;
                    z2 += z2_here;
                    expected += 1.0 + own * own / theirs;
                    z_max = z_max.max(z2_here.sqrt());
                }
            }
        }
    }
    Report {
        median: median(&mut errors),
        reference_median: median(&mut noises),
        ratio: sum / reference,
        ratio_se: variance.sqrt() / reference,
        z_rms: (z2 / expected).sqrt(),
        z_max,
    }
}
