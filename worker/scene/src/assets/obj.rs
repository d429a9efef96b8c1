//! One OBJ model of a furniture library as a mesh of ours: upright, front towards +z, of the catalogue's
//! size.

use std::io::Cursor;

use crate::{Material, Mesh, Vec3};

use super::catalogue::{Archive, Item};

/// Larger models are left out: they cost more than they show.
pub(super) const MAX_TRIANGLES: usize = 40_000;
/// An OBJ file of [`MAX_TRIANGLES`] is never larger than this.
pub(super) const MAX_BYTES: u64 = 8 << 20;
/// Triangles of less than this (twice the area, m²) are degenerate.
const MIN_DOUBLE_AREA: f32 = 1e-10;
/// Albedo of surfaces without a stated colour.
const GREY: f32 = 0.5;

/// A loaded model.
#[derive(Debug)]
pub(super) struct Loaded {
    pub(super) mesh: Mesh,
    /// A transparent material was made opaque.
    pub(super) made_opaque: bool,
    /// A texture was left out.
    pub(super) untextured: bool,
}

/// Reads, turns, stretches and cleans the model; `None` if it cannot be used.
pub(super) fn load(archive: &Archive, item: &Item) -> Option<Loaded> {
    let loaded = parse(archive, item);
    match &loaded {
        Err(why) => tracing::warn!(model = item.model, why, "furniture model left out"),
        Ok(l) => tracing::trace!(
            model = item.model,
            triangles = l.mesh.triangles.len(),
            "loaded"
        ),
    }
    loaded.ok()
}

fn parse(archive: &Archive, item: &Item) -> Result<Loaded, String> {
    let bytes = archive.read(&item.model).map_err(|e| e.to_string())?;
    let folder = item.model.rsplit_once('/').map_or("", |(folder, _)| folder);
    let options = tobj::LoadOptions {
        triangulate: true,
        ignore_points: true,
        ignore_lines: true,
        ..tobj::LoadOptions::default()
    };
    let (models, materials) = tobj::load_obj_buf(&mut Cursor::new(&bytes), &options, |mtl| {
        let name = mtl.file_name().unwrap_or_default().to_string_lossy();
        let text = archive
            .read(&format!("{folder}/{name}"))
            .map_err(|_| tobj::LoadError::OpenFileFailed)?;
        tobj::load_mtl_buf(&mut Cursor::new(text))
    })
    .map_err(|e| e.to_string())?;
    // Without a material file everything is grey.
    let materials = materials.unwrap_or_default();
    let mut loaded = Loaded {
        mesh: Mesh {
            name: item.name.clone(),
            ..Mesh::default()
        },
        made_opaque: materials
            .iter()
            .any(|m| m.dissolve.is_some_and(|d| d < 1.0)),
        untextured: materials.iter().any(|m| m.diffuse_texture.is_some()),
    };
    let mesh = &mut loaded.mesh;
    mesh.materials = materials.iter().map(material).collect();
    mesh.materials.push(Material::diffuse("unnamed", [GREY; 3]));
    for model in &models {
        let (base, part) = (mesh.positions.len() as u32, &model.mesh);
        let vertices = part.positions.chunks_exact(3);
        mesh.positions
            .extend(vertices.map(|p| turned(item, Vec3::new(p[0], p[1], p[2]))));
        let slot = part
            .material_id
            .unwrap_or(materials.len())
            .min(materials.len()) as u32;
        for t in part.indices.chunks_exact(3) {
            mesh.triangles.push([t[0] + base, t[1] + base, t[2] + base]);
            mesh.triangle_material.push(slot);
        }
    }
    if mesh.triangles.len() > MAX_TRIANGLES {
        return Err(format!(
            "{} triangles, more than {MAX_TRIANGLES}",
            mesh.triangles.len()
        ));
    }
    stretch(mesh, item.size)?;
    drop_degenerate(mesh);
    mesh.group_by_material();
    drop_unused_materials(mesh);
    Ok(loaded)
}

/// Catalogue rotations are rows of a 3×3 matrix.
fn turned(item: &Item, p: Vec3) -> Vec3 {
    item.rotation.map_or(p, |r| {
        let row = |k: usize| Vec3::new(r[k], r[k + 1], r[k + 2]).dot(p);
        Vec3::new(row(0), row(3), row(6))
    })
}

/// Scales the mesh's box to width × height × depth.
fn stretch(mesh: &mut Mesh, size: [f32; 3]) -> Result<(), String> {
    let (lo, hi) = mesh.bounds().ok_or("no vertices")?;
    let extent = hi - lo;
    if !extent.is_finite() {
        return Err("a vertex is not finite".into());
    }
    let scale = |k: usize| {
        if extent[k] > 0.0 {
            size[k] / extent[k]
        } else {
            1.0
        }
    };
    let (sx, sy, sz) = (scale(0), scale(1), scale(2));
    for p in &mut mesh.positions {
        let q = *p - lo;
        *p = Vec3::new(q.x * sx, q.y * sy, q.z * sz);
    }
    Ok(())
}

fn drop_degenerate(mesh: &mut Mesh) {
    let keep: Vec<bool> = mesh
        .triangles
        .iter()
        .map(|t| {
            let [a, b, c] = t.map(|v| mesh.positions[v as usize]);
            (b - a).cross(c - a).length() > MIN_DOUBLE_AREA
        })
        .collect();
    let mut k = keep.iter();
    mesh.triangles
        .retain(|_| *k.next().expect("one flag a triangle"));
    let mut k = keep.iter();
    mesh.triangle_material
        .retain(|_| *k.next().expect("one flag a triangle"));
}

/// Keeps the materials that triangles name, in their order.
fn drop_unused_materials(mesh: &mut Mesh) {
    let mut used = vec![false; mesh.materials.len()];
    for &m in &mesh.triangle_material {
        used[m as usize] = true;
    }
    let mut next = 0;
    let renumbered: Vec<u32> = used
        .iter()
        .map(|&u| {
            next += u32::from(u);
            next.saturating_sub(1)
        })
        .collect();
    for m in &mut mesh.triangle_material {
        *m = renumbered[*m as usize];
    }
    let mut flags = used.iter();
    mesh.materials
        .retain(|_| *flags.next().expect("one flag a material"));
}

/// Kd is a display colour: linear albedo by a 2.2 power, kept within what real surfaces have.
fn material(file: &tobj::Material) -> Material {
    let linear = |v: f32| libm::powf(v.clamp(0.0, 1.0), 2.2).clamp(0.04, 0.9);
    let rgb = match file.diffuse {
        // Black under a texture means that the texture has all the colour.
        Some([0.0, 0.0, 0.0]) if file.diffuse_texture.is_some() => [GREY; 3],
        Some(kd) => kd.map(linear),
        None => [GREY; 3],
    };
    Material::diffuse(file.name.clone(), rgb)
}
