//! Increases the number of triangles of a surface: every triangle is divided into four at the
//! midpoints of its edges.

use std::{collections::BTreeMap, sync::Arc};

use picofarm_scene::{Mesh, Scene};

use picofarm_cli::error::{CliError, Result};

/// Maximum number of triangles; a larger number is a mistake.
const MOST: usize = 1 << 26;

/// Divides all triangles until the scene has at least `wanted`.
///
/// # Errors
/// Fails if the scene has no triangles, or if the number is too large.
pub fn tessellate(scene: &mut Scene, wanted: usize) -> Result<()> {
    let found = scene.triangle_count();
    if found == 0 || wanted > MOST {
        return Err(CliError::input(format!(
            "--triangles {wanted}: expected at most {MOST}, and a scene with triangles (it has {found})"
        )));
    }
    while scene.triangle_count() < wanted {
        quadruple(scene);
    }
    Ok(())
}

/// Divides each triangle into four. Shared meshes stay shared, and shared edges are divided at the
/// same point.
pub fn quadruple(scene: &mut Scene) {
    let mut done = BTreeMap::<*const Mesh, Arc<Mesh>>::new();
    for object in &mut scene.objects {
        object.mesh = done
            .entry(Arc::as_ptr(&object.mesh))
            .or_insert_with(|| Arc::new(cut(&object.mesh)))
            .clone();
    }
}

fn cut(mesh: &Mesh) -> Mesh {
    let mut positions = mesh.positions.clone();
    let mut uv = mesh.uv.clone();
    let mut middles = BTreeMap::<(u32, u32), u32>::new();
    let mut middle = |a: u32, b: u32| {
        *middles.entry((a.min(b), a.max(b))).or_insert_with(|| {
            positions.push((positions[a as usize] + positions[b as usize]) * 0.5);
            if !uv.is_empty() {
                let (s, t) = (uv[a as usize], uv[b as usize]);
                uv.push([0, 1].map(|k| (s[k] + t[k]) * 0.5));
            }
            positions.len() as u32 - 1
        })
    };
    let mut triangles = Vec::with_capacity(mesh.triangles.len() * 4);
    for &[a, b, c] in &mesh.triangles {
        let (ab, bc, ca) = (middle(a, b), middle(b, c), middle(c, a));
        triangles.extend([[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]);
    }
    Mesh {
        name: mesh.name.clone(),
        positions,
        uv,
        triangles,
        triangle_material: mesh
            .triangle_material
            .iter()
            .flat_map(|&m| [m; 4])
            .collect(),
        materials: mesh.materials.clone(),
    }
}

#[cfg(test)]
mod tests {
    use picofarm_scene::primitive;

    use super::*;

    fn area(scene: &Scene) -> f64 {
        let triangle = |mesh: &Mesh, t: &[u32; 3]| {
            let [a, b, c] = t.map(|i| mesh.positions[i as usize]);
            f64::from((b - a).cross(c - a).length()) / 2.0
        };
        scene
            .objects
            .iter()
            .map(|o| {
                o.mesh
                    .triangles
                    .iter()
                    .map(|t| triangle(&o.mesh, t))
                    .sum::<f64>()
            })
            .sum()
    }

    #[test]
    fn cutting_keeps_the_surface_and_its_validity() {
        let mut scene = primitive::generate(1, &Default::default()).expect("a room");
        let (count, before) = (scene.triangle_count(), area(&scene));
        tessellate(&mut scene, count * 5).expect("a few triangles");
        assert_eq!(scene.triangle_count(), count * 16);
        assert!((area(&scene) / before - 1.0).abs() < 1e-5);
        scene.validate().expect("still a scene");
    }

    #[test]
    fn a_scene_with_triangles_enough_stays_as_it_is() {
        let mut scene = primitive::generate(1, &Default::default()).expect("a room");
        let count = scene.triangle_count();
        tessellate(&mut scene, 1).expect("nothing to do");
        assert_eq!(scene.triangle_count(), count);
    }
}
