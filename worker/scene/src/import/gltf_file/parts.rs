//! Materials, cameras and lasers of a glTF file.

use std::path::Path;

use gltf::camera::Projection;

use crate::{
    Affine, Beam, Bsdf, Camera, Distribution, Intrinsics, Laser, LaserGrid, Material, SceneError,
    Vec3,
    extras::{MaterialExtras, NodeExtras, metallic_roughness},
    import::format_error,
};

use super::{Walk, keyed};

/// Rows given to a camera whose file states no resolution; callers resize.
const DEFAULT_ROWS: u32 = 64;
/// Smallest roughness α of an imported conductor.
const MIN_ALPHA: f32 = 1e-3;
/// Standard parameters closer than this to those we would write leave our extras in force.
const SAME_FACTOR: f32 = 1e-3;

impl Walk<'_> {
    pub(super) fn material(&mut self, file: &gltf::Material<'_>) -> Result<Material, SceneError> {
        let pbr = file.pbr_metallic_roughness();
        let [r, g, b, alpha] = pbr.base_color_factor();
        let name = file.name().unwrap_or("material").to_owned();
        if pbr.base_color_texture().is_some() || pbr.metallic_roughness_texture().is_some() {
            self.notes.insert(
                "textures".into(),
                "ignored; base colour and roughness factors used".into(),
            );
        }
        if alpha < 1.0 || file.alpha_mode() == gltf::material::AlphaMode::Blend {
            self.notes.insert(
                "transparency".into(),
                "ignored; such materials are opaque".into(),
            );
        }
        let mut material = Material::diffuse(name, [r, g, b]);
        if pbr.metallic_factor() >= 0.5 {
            let alpha = pbr.roughness_factor() * pbr.roughness_factor();
            material.bsdf = Bsdf::RoughConductor {
                alpha: alpha.max(MIN_ALPHA),
                distribution: Distribution::Beckmann,
                reflectance: (r + g + b) / 3.0,
            };
        }
        let at = format!("materials[{}].extras.picofarm", file.index().unwrap_or(0));
        let ours: Option<MaterialExtras> =
            keyed(self.path, &at, file.extras().as_deref().map(|r| r.get()))?;
        if let Some(ours) = ours {
            let exact = Material {
                bsdf: ours.bsdf,
                two_sided: ours.two_sided,
                ..material.clone()
            };
            // Someone who edits the file in another program changes the standard factors: they win then.
            let (metallic, roughness) = metallic_roughness(&exact);
            let same = (metallic - pbr.metallic_factor()).abs() < SAME_FACTOR
                && (roughness - pbr.roughness_factor()).abs() < SAME_FACTOR;
            if same {
                return Ok(exact);
            }
            self.notes.insert(
                "materials".into(),
                "edited since export; standard factors used".into(),
            );
        }
        Ok(material)
    }

    pub(super) fn camera_of(
        &self,
        to_world: &Affine,
        file: &gltf::Camera<'_>,
    ) -> Result<Camera, SceneError> {
        let at = format!("cameras[{}]", file.index());
        let Projection::Perspective(lens) = file.projection() else {
            return Err(format_error(
                self.path,
                format!("{at}: is orthographic; use a perspective camera"),
            ));
        };
        let aspect = lens.aspect_ratio().unwrap_or(1.0);
        let half = libm::tan(f64::from(lens.yfov()) * 0.5) as f32;
        let width = (DEFAULT_ROWS as f32 * aspect).round();
        if !(half > 0.0 && half.is_finite() && (1.0..=65536.0).contains(&width)) {
            return Err(format_error(
                self.path,
                format!("{at}: yfov and aspectRatio must be positive"),
            ));
        }
        let column = |k: usize| {
            Vec3::new(
                to_world.linear[0][k],
                to_world.linear[1][k],
                to_world.linear[2][k],
            )
            .normalized()
        };
        let (height, width) = (DEFAULT_ROWS as f32, width as u32);
        let fx = width as f32 * 0.5 / (half * aspect);
        Ok(Camera {
            intrinsics: Intrinsics {
                fx,
                fy: height * 0.5 / half,
                cx: width as f32 * 0.5,
                cy: height * 0.5,
                width,
                height: DEFAULT_ROWS,
            },
            origin: to_world.translation,
            right: column(0),
            down: -column(1),
            forward: -column(2),
        })
    }
}

/// The laser that a node's extras state.
pub(super) fn laser_of(
    path: &Path,
    to_world: &Affine,
    extras: &NodeExtras,
    camera: &Camera,
) -> Result<Laser, SceneError> {
    if let Some(directions) = &extras.laser_directions {
        let beams = directions
            .iter()
            .map(|&d| Beam {
                direction: to_world.direction(d).normalized(),
                spot: None,
            })
            .collect();
        return Ok(Laser {
            origin: to_world.translation,
            beams,
        });
    }
    let spots = extras.laser_spots.unwrap_or_default();
    LaserGrid::new(spots)
        .map(|grid| grid.laser(camera))
        .ok_or_else(|| {
            format_error(
                path,
                format!("laser_spots: {spots} is no grid; use 1, 4, 16, 25 or 100"),
            )
        })
}
