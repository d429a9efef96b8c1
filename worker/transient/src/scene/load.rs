//! Converts a scene to render units.

use picofarm_scene::{Material, Scene, Vec3};

use crate::{
    api::{RenderError, Stop},
    numeric::double::{Point, wide},
    scene::{
        bvh::{normal::normal, tree::Bvh},
        cut::Cut,
        extent,
        fresnel::Body,
        panes::Panes,
        spectra,
        surface::Surface,
        world::World,
    },
};

/// The largest distance of vertices and laser from the camera, and the smallest reach of a scene,
/// metres. Within these limits every product of lengths fits an f32.
const WIDEST_M: f64 = 1e9;
const NARROWEST_M: f64 = 1e-6;

impl World {
    /// Returns a world in which light counts that travels up to `horizon_m`.
    ///
    /// # Errors
    /// Returns [`RenderError::Invalid`] if the scene is too wide or too small to be represented in
    /// f32.
    pub fn new(scene: &Scene, horizon_m: f64, stop: Stop) -> Result<Self, RenderError> {
        Self::at(scene, None, horizon_m, stop)
    }

    /// The same at a wavelength, nanometres; without one, at that of the scene's reflectances.
    ///
    /// # Errors
    /// Those of [`World::new`].
    pub fn at(
        scene: &Scene,
        wavelength_nm: Option<f64>,
        horizon_m: f64,
        stop: Stop,
    ) -> Result<Self, RenderError> {
        let mut texels = vec![];
        let origin = scene.camera.origin;
        let centre = wide(origin);
        let count: usize = scene.objects.iter().map(|o| o.mesh.triangles.len()).sum();
        let mut points = Vec::with_capacity(count);
        let (mut surface, mut object) = (Vec::with_capacity(count), Vec::with_capacity(count));
        // The glass triangles and their materials.
        let (mut panes, mut glass): (Vec<[Point; 3]>, Vec<&Material>) = (vec![], vec![]);
        let (mut surfaces, mut material, mut rgb) = (vec![], vec![], vec![]);
        let mut bodies = vec![];
        let textured = |m: &Material| m.texture.is_some();
        let textured = scene
            .objects
            .iter()
            .any(|o| o.mesh.materials.iter().any(textured));
        let (mut textures, mut uv, mut first_surface) = (vec![], vec![], vec![]);
        for (index, o) in scene.objects.iter().enumerate() {
            stop.check()?;
            let first = surfaces.len() as u32;
            first_surface.push(first);
            for (k, m) in o.mesh.materials.iter().enumerate() {
                surfaces.push(match wavelength_nm {
                    None => Surface::new(m),
                    Some(nm) => {
                        let (surface, of_texels) = spectra::at(m, nm);
                        texels.push(of_texels);
                        surface
                    }
                });
                bodies.push(Body::new(m));
                material.push(k as u32);
                rgb.push(m.rgb);
                textures.push(m.texture.clone());
            }
            let rows = o.to_world.linear.map(wide);
            let shift = wide(o.to_world.translation);
            // Positions are f64 until the camera position is subtracted, which keeps precision in
            // scenes far from the origin.
            let place = |p: Vec3| {
                let p = wide(p);
                std::array::from_fn(|r| {
                    rows[r][0] * p[0] + rows[r][1] * p[1] + rows[r][2] * p[2] + shift[r] - centre[r]
                })
            };
            let placed: Vec<[f64; 3]> = o.mesh.positions.iter().map(|&p| place(p)).collect();
            for (t, &m) in o.mesh.triangles.iter().zip(&o.mesh.triangle_material) {
                let material = &o.mesh.materials[m as usize];
                if material.is_glass() {
                    panes.push(t.map(|v| placed[v as usize]));
                    glass.push(material);
                    continue;
                }
                points.push(t.map(|v| placed[v as usize]));
                if textured {
                    uv.push(t.map(|v| o.mesh.uv.get(v as usize).copied().unwrap_or_default()));
                }
                surface.push(first + m);
                object.push(index as u32);
            }
        }
        let widest = points
            .iter()
            .chain(&panes)
            .flatten()
            .flatten()
            .fold(0.0f64, |a, x| a.max(x.abs()));
        let laser = wide(scene.laser.origin - origin);
        let reach = laser.iter().fold(widest, |a, x| a.max(x.abs()));
        if reach > WIDEST_M || (widest > 0.0 && widest < NARROWEST_M) {
            return Err(RenderError::Invalid {
                field: "objects".into(),
                what: format!(
                    "reach {reach:e} m from the camera, expected {NARROWEST_M:e} to {WIDEST_M:e}; check the scene's unit and remove stray vertices"
                ),
            });
        }
        let reach = extent::reach(scene, &points, (widest, horizon_m), stop)?;
        // The camera may almost touch a surface. The pieces of a far wider scene would then
        // overflow an f32.
        let reach = reach.max(NARROWEST_M.min(widest));
        let scale = scale_for(reach);
        let mut normals = None;
        if reach < widest {
            let cut = Cut::of(&points, &uv, (reach, widest, scale), stop)?;
            let of = |all: &[u32]| cut.of.iter().map(|&k| all[k]).collect();
            (surface, object) = (of(&surface), of(&object));
            (points, uv, normals) = (cut.points, cut.uv, Some(cut.normals));
            let cut = Cut::of(&panes, &[], (reach, widest, scale), stop)?;
            glass = cut.of.iter().map(|&k| glass[k]).collect();
            panes = cut.points;
        }
        let unit = |p: Point| Vec3::from(p.map(|x| (x * f64::from(scale)) as f32));
        let triangles: Vec<[Vec3; 3]> = points.iter().map(|t| t.map(unit)).collect();
        // Free the points before the tree is built, because the tree takes as much memory again.
        drop(points);
        let panes: Vec<[Vec3; 3]> = panes.iter().map(|t| t.map(unit)).collect();
        let normals = normals.unwrap_or_else(|| {
            let each = triangles.iter();
            each.map(|t| normal(t).unwrap_or_default()).collect()
        });
        let edge = (reach * f64::from(scale)) as f32;
        let inside = |p: &Vec3| p.x.abs().max(p.y.abs()).max(p.z.abs()) <= edge;
        let corners = || triangles.iter().flatten().copied().filter(inside);
        let low = corners().fold(Vec3::ZERO, Vec3::min);
        let high = corners().fold(Vec3::ZERO, Vec3::max);
        Ok(Self {
            bvh: Bvh::build_unless(&triangles, stop)?,
            triangles,
            normals,
            surface,
            object,
            surfaces,
            first_surface,
            material,
            rgb,
            textures: if textured { textures } else { vec![] },
            uv,
            laser: (scene.laser.origin - origin) * scale,
            scale,
            diagonal: (high - low).length().max(edge),
            horizon: (horizon_m * f64::from(scale)) as f32,
            camera: scene.camera,
            sensitive: 1.0,
            panes: Panes::new(&panes, &glass, stop)?,
            bodies: match bodies.iter().any(Option::is_some) {
                true => bodies,
                false => vec![],
            },
            texels,
        })
    }
}

/// Returns the power of two that scales `widest` into [4, 8).
fn scale_for(widest: f64) -> f32 {
    if widest == 0.0 {
        return 1.0;
    }
    let mut scale = 1.0f64;
    while widest * scale >= 8.0 {
        scale *= 0.5;
    }
    while widest * scale < 4.0 {
        scale *= 2.0;
    }
    scale as f32
}
