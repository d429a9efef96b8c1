//! The reference scenes' JSON: exact meshes and BSDFs, a camera that looks along −z, and given
//! spots.

use std::{collections::BTreeMap, path::Path, sync::Arc};

use serde::Deserialize;

use crate::{
    Affine, Beam, Bsdf, Camera, Distribution, Intrinsics, Laser, Material, Mesh, Object,
    Provenance, Scene, SceneError, Spot, Vec3,
};

use super::{
    ImportOptions, Opener,
    complete::{Draft, FileLaser},
    format_error, read_file, validated,
};

/// The resolution of a camera if the file has none; callers resize it.
const DEFAULT_PIXELS: u32 = 64;

#[derive(Deserialize)]
struct File {
    name: String,
    camera: FileCamera,
    laser: FilePlace,
    spots: Vec<FileSpot>,
    meshes: Vec<FileMesh>,
}

#[derive(Deserialize)]
struct FileCamera {
    fov_x_deg: f32,
    origin: Vec3,
    right: Vec3,
    up: Vec3,
    forward: Vec3,
}

#[derive(Deserialize)]
struct FilePlace {
    origin: Vec3,
}

#[derive(Deserialize)]
struct FileSpot {
    dir: Vec3,
    p: Vec3,
    n: Vec3,
    laser_dist: f32,
    mesh_index: u32,
}

#[derive(Deserialize)]
struct FileMesh {
    name: String,
    bsdf: FileBsdf,
    vertices: Vec<Option<f32>>,
    faces: Vec<u32>,
}

#[derive(Deserialize)]
struct FileBsdf {
    r#type: String,
    reflectance: Option<f32>,
    distribution: Option<String>,
    alpha: Option<f32>,
    fresnel: Option<f32>,
    weight: Option<f32>,
}

/// Reads a reference scene. Its image has 64×64 pixels until resized. Every mesh is an object with
/// its own category. Materials are one-sided and grey, and the spots in the file become
/// [`Beam::spot`].
///
/// # Errors
/// [`SceneError::Read`] or [`SceneError::Format`] naming file and field.
pub fn read_reference_json(path: &Path) -> Result<Scene, SceneError> {
    let draft = parse(path, &read_file(&Opener::anywhere(), path)?)?;
    let scene = draft.complete(&ImportOptions::default());
    validated(path, scene.map_err(|what| format_error(path, what))?)
}

pub(super) fn parse(path: &Path, bytes: &[u8]) -> Result<Draft, SceneError> {
    let file: File = serde_json::from_slice(bytes)
        .map_err(|e| format_error(path, format!("is not a reference scene: {e}")))?;
    let c = &file.camera;
    if !(0.001..=179.0).contains(&c.fov_x_deg) {
        let what = format!(
            "camera.fov_x_deg: {} lies outside 0.001..=179 degrees from left to right",
            c.fov_x_deg
        );
        return Err(format_error(path, what));
    }
    let camera = Camera {
        intrinsics: Intrinsics::from_fov(c.fov_x_deg, DEFAULT_PIXELS, DEFAULT_PIXELS),
        origin: c.origin,
        right: c.right,
        down: -c.up,
        forward: c.forward,
    };
    let meshes = file
        .meshes
        .iter()
        .enumerate()
        .map(|(i, m)| {
            mesh(m).map_err(|what| format_error(path, format!("meshes[{i}] ({}): {what}", m.name)))
        })
        .collect::<Result<Vec<_>, _>>()?;
    let mut labels: Vec<String> = Vec::new();
    let mut known: BTreeMap<String, u16> = BTreeMap::new();
    let mut objects = Vec::with_capacity(meshes.len());
    for mesh in meshes {
        let label = match known.get(&mesh.name) {
            Some(label) => *label,
            None => {
                let label = u16::try_from(labels.len())
                    .map_err(|_| format_error(path, "meshes[].name: more than 65535 names"))?;
                labels.push(mesh.name.clone());
                known.insert(mesh.name.clone(), label);
                label
            }
        };
        objects.push(Object {
            name: mesh.name.clone(),
            mesh: Arc::new(mesh),
            to_world: Affine::IDENTITY,
            label,
        });
    }
    let beams = file
        .spots
        .iter()
        .enumerate()
        .map(|(i, s)| {
            beam(s, file.meshes.len())
                .map_err(|what| format_error(path, format!("spots[{i}].{what}")))
        })
        .collect::<Result<Vec<_>, _>>()?;
    Ok(Draft {
        name: file.name,
        objects,
        labels,
        cameras: vec![(String::new(), Ok(camera))],
        laser: Some(FileLaser::Beams(Laser {
            origin: file.laser.origin,
            beams,
        })),
        has_unit: true,
        provenance: Provenance {
            source: "reference-json".into(),
            seed: None,
            attribution: Vec::new(),
            notes: BTreeMap::from([(
                "resolution".into(),
                format!("not stated; {DEFAULT_PIXELS}x{DEFAULT_PIXELS} assumed"),
            )]),
        },
    })
}

fn beam(spot: &FileSpot, meshes: usize) -> Result<Beam, String> {
    if spot.mesh_index as usize >= meshes {
        return Err(format!(
            "mesh_index: {} points past {meshes} meshes",
            spot.mesh_index
        ));
    }
    Ok(Beam {
        direction: spot.dir,
        spot: Some(Spot {
            point: spot.p,
            normal: spot.n,
            arriving: spot.dir,
            path_m: spot.laser_dist,
            object: spot.mesh_index,
            material: 0,
        }),
    })
}

fn mesh(file: &FileMesh) -> Result<Mesh, String> {
    if !file.vertices.len().is_multiple_of(3) || !file.faces.len().is_multiple_of(3) {
        return Err(format!(
            "vertices ({}) and faces ({}) must come in threes; write x, y, z and a, b, c for each",
            file.vertices.len(),
            file.faces.len()
        ));
    }
    let mut positions = Vec::with_capacity(file.vertices.len() / 3);
    for (i, p) in file.vertices.chunks_exact(3).enumerate() {
        match p {
            // JSON has no NaN: writers use null for it.
            &[Some(x), Some(y), Some(z)] => positions.push(Vec3::new(x, y, z)),
            _ => {
                return Err(format!(
                    "vertices[{}..]: null is not a number; repair vertex {i}",
                    i * 3
                ));
            }
        }
    }
    let triangles: Vec<[u32; 3]> = file
        .faces
        .chunks_exact(3)
        .map(|t| [t[0], t[1], t[2]])
        .collect();
    Ok(Mesh {
        name: file.name.clone(),
        triangle_material: vec![0; triangles.len()],
        positions,
        uv: Vec::new(),
        triangles,
        materials: vec![material(&file.name, &file.bsdf)?],
    })
}

fn material(name: &str, file: &FileBsdf) -> Result<Material, String> {
    let needs = |field: &str| format!("bsdf.{field}: missing; a {} needs it", file.r#type);
    let reflectance = || file.reflectance.ok_or_else(|| needs("reflectance"));
    let alpha = || file.alpha.ok_or_else(|| needs("alpha"));
    let distribution = || match file.distribution.as_deref() {
        Some("beckmann") => Ok(Distribution::Beckmann),
        Some("ggx") => Ok(Distribution::Ggx),
        other => Err(format!(
            "bsdf.distribution: {} is not known; use \"beckmann\" or \"ggx\"",
            other.map_or("none".into(), |d| format!("{d:?}"))
        )),
    };
    let fresnel = file.fresnel.unwrap_or(1.0);
    let (bsdf, grey) = match file.r#type.as_str() {
        "diffuse" => {
            let reflectance = reflectance()?;
            (Bsdf::Diffuse { reflectance }, reflectance)
        }
        "roughconductor" => {
            let bsdf = Bsdf::RoughConductor {
                distribution: distribution()?,
                alpha: alpha()?,
                reflectance: fresnel,
            };
            (bsdf, fresnel)
        }
        // A Lambertian, blended with the share `weight` of a rough conductor.
        "mixed" => {
            let (reflectance, weight) =
                (reflectance()?, file.weight.ok_or_else(|| needs("weight"))?);
            let bsdf = Bsdf::Mixed {
                reflectance,
                distribution: distribution()?,
                alpha: alpha()?,
                specular_reflectance: fresnel,
                weight,
            };
            (bsdf, (1.0 - weight) * reflectance + weight * fresnel)
        }
        other => {
            return Err(format!(
                "bsdf.type: {other:?} is not known; use \"diffuse\", \"roughconductor\" or \"mixed\""
            ));
        }
    };
    Ok(Material {
        name: name.to_owned(),
        bsdf,
        rgb: [grey; 3],
        texture: None,
        two_sided: false,
        spectrum: vec![],
    })
}
