//! Converts an OBJ model of a furniture library to a mesh: upright, with its front towards +z and
//! the catalogue's size.

use std::io::Cursor;

use crate::{
    Bsdf, Material, Mesh, Vec3,
    import::{mtl::complete_colours, polygon::Triangulation},
};

use super::catalogue::{Archive, Item};

/// Models with more triangles are omitted: they cost more than they show.
pub(super) const MAX_TRIANGLES: usize = 40_000;
/// The greatest size of an OBJ file with [`MAX_TRIANGLES`], bytes.
pub(super) const MAX_BYTES: u64 = 8 << 20;
/// Triangles of less than this (twice the area, m²) are degenerate.
const MIN_DOUBLE_AREA: f32 = 1e-10;
/// The albedo of surfaces without a colour.
const GREY: f32 = 0.5;

/// A loaded model.
#[derive(Debug)]
pub(super) struct Loaded {
    pub(super) mesh: Mesh,
    /// Whether a transparent material was made opaque.
    pub(super) made_opaque: bool,
    /// Whether a texture was omitted.
    pub(super) untextured: bool,
}

/// Reads, turns, stretches and cleans the model. Returns `None` if it cannot be used.
pub(super) fn load(archive: &Archive, item: &Item) -> Option<Loaded> {
    let loaded = parse(archive, item);
    match &loaded {
        Err(why) => tracing::debug!(model = item.model, why, "furniture model left out"),
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
        triangulate: false,
        ignore_points: true,
        ignore_lines: true,
        ..tobj::LoadOptions::default()
    };
    let (models, materials) = tobj::load_obj_buf(&mut Cursor::new(&bytes), &options, |mtl| {
        let name = mtl.file_name().unwrap_or_default().to_string_lossy();
        let text = archive
            .read(&format!("{folder}/{name}"))
            .map_err(|_| tobj::LoadError::OpenFileFailed)?;
        let text = String::from_utf8(text).map_err(|_| tobj::LoadError::ReadError)?;
        let text = complete_colours(&text).map_err(|_| tobj::LoadError::MaterialParseError)?;
        tobj::load_mtl_buf(&mut Cursor::new(text))
    })
    .map_err(|e| e.to_string())?;
    // Without a material file, everything is grey.
    let materials = materials.unwrap_or_default();
    let mut loaded = Loaded {
        mesh: Mesh {
            name: item.name.clone(),
            ..Mesh::default()
        },
        made_opaque: materials
            .iter()
            .any(|m| m.dissolve.is_some_and(|d| d < 1.0) && glass(m).is_none()),
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
        for t in triangles(part) {
            mesh.triangles.push(t.map(|v| v + base));
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
    for slot in 0..mesh.materials.len() {
        let closed = mesh.materials[slot].is_glass() && mesh.is_closed(slot as u32);
        if let Bsdf::ThinDielectric { face, .. } = &mut mesh.materials[slot].bsdf {
            *face = closed;
        }
    }
    mesh.make_canonical();
    Ok(loaded)
}

/// Splits the polygons of a part into triangles. A polygon with crossing edges becomes a fan,
/// because models of a library are not corrected.
fn triangles(part: &tobj::Mesh) -> Vec<[u32; 3]> {
    if part.face_arities.is_empty() {
        return part.indices.as_chunks::<3>().0.to_vec();
    }
    let place = |v: u32| {
        let at = 3 * v as usize;
        std::array::from_fn(|k| f64::from(part.positions.get(at + k).copied().unwrap_or(f32::NAN)))
    };
    let (mut all, mut rest) = (Vec::new(), part.indices.as_slice());
    let (mut split, mut parts) = (Triangulation::default(), Vec::new());
    for &arity in &part.face_arities {
        let (face, after) = rest.split_at(rest.len().min(arity as usize));
        rest = after;
        let corners: Vec<[f64; 3]> = face.iter().map(|v| place(*v)).collect();
        parts.clear();
        if split.split(&corners, &mut parts).is_err() {
            parts = (2..face.len() as u32).map(|k| [0, k - 1, k]).collect();
        }
        all.extend(parts.iter().map(|t| t.map(|c| face[c as usize])));
    }
    all
}

/// Catalogue rotations are rows of a 3×3 matrix.
fn turned(item: &Item, p: Vec3) -> Vec3 {
    item.rotation.map_or(p, |r| {
        let row = |k: usize| Vec3::new(r[k], r[k + 1], r[k + 2]).dot(p);
        Vec3::new(row(0), row(3), row(6))
    })
}

/// Scales the mesh's bounding box to width × height × depth.
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

pub(super) fn drop_degenerate(mesh: &mut Mesh) {
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

/// Returns glass for materials that transmit at least half of the light. Most programs write an
/// index of 1 if they know none.
fn glass(file: &tobj::Material) -> Option<Bsdf> {
    Material::by_opacity(file.dissolve?, file.optical_density, false)
}

/// Converts a material. Kd is a display colour; the linear albedo is its 2.2 power, limited to the
/// range of real surfaces.
fn material(file: &tobj::Material) -> Material {
    let linear = |v: f32| libm::powf(v.clamp(0.0, 1.0), 2.2).clamp(0.04, 0.9);
    let rgb = match file.diffuse {
        // With a texture, black means that the texture contains the whole colour.
        Some([0.0, 0.0, 0.0]) if file.diffuse_texture.is_some() => [GREY; 3],
        Some(kd) => kd.map(linear),
        None => [GREY; 3],
    };
    match (glass(file), file.dissolve) {
        (Some(bsdf), Some(opacity)) => Material {
            bsdf,
            rgb: [(1.0 - opacity).clamp(0.0, 1.0); 3],
            ..Material::glass(file.name.clone())
        },
        _ => Material::diffuse(file.name.clone(), rgb),
    }
}

#[cfg(test)]
mod tests {
    use std::{io::Write, path::Path};

    use zip::{ZipWriter, write::SimpleFileOptions};

    use crate::AssetLibrary;

    const PROPERTIES: &str = "version=1.8\nlicense=Public domain\n\
        name#1=Armchair\ncategory#1=Office\nwidth#1=60\ndepth#1=80\nheight#1=100\nmodel#1=/a/chair.obj\n\
        creator#1=Someone\nmodelRotation#1=1 0 0 0 0 1 0 -1 0\n\
        name#2=Sofa\ncategory#2=Office\nwidth#2=60\ndepth#2=80\nheight#2=100\nmodel#2=/a/broken.obj\n\
        name#3=Bed\ncategory#3=Bedroom\nwidth#3=60\ndepth#3=80\nheight#3=100\nmodel#3=/a/absent.obj\n";

    // A tetrahedron (z up) with a degenerate facet.
    const OBJ: &str = "mtllib chair.mtl\nv 0 0 0\nv 2 0 0\nv 0 4 0\nv 0 0 8\nusemtl glass\n\
        f 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\nf 1 1 2\n";

    fn library(dir: &Path) -> AssetLibrary {
        let file = std::fs::File::create(dir.join("test.sh3f")).expect("creates");
        let mut zip = ZipWriter::new(file);
        for (name, text) in [
            ("PluginFurnitureCatalog.properties", PROPERTIES),
            ("a/chair.obj", OBJ),
            (
                "a/chair.mtl",
                "newmtl wood\nKd 1 0 0\nd 0.9\nnewmtl glass\nKd 0.5 0.5 0.5\nNi 1\nd 0.25\n",
            ),
            ("a/broken.obj", "v NaN 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"),
        ] {
            zip.start_file(name, SimpleFileOptions::default())
                .expect("starts");
            zip.write_all(text.as_bytes()).expect("writes");
        }
        zip.finish().expect("finishes");
        AssetLibrary::sweethome3d(dir).expect("opens")
    }

    #[test]
    fn models_are_upright_of_catalogue_size_and_clean_and_thin_glass_where_transparent() {
        let folder = tempfile::tempdir().expect("a folder");
        let library = library(folder.path());
        assert_eq!(library.len(), 2, "an item without its model is left out");
        let asset = &library.assets[0];
        let model = asset.model().expect("loads");
        for (got, want) in model.size().into_iter().zip([0.6, 1.0, 0.8]) {
            assert!((got - want).abs() < 1e-5, "{:?}", model.size());
        }
        assert_eq!(
            model.mesh.triangles.len(),
            4,
            "the degenerate facet is gone"
        );
        assert_eq!(
            model.mesh.materials.len(),
            1,
            "only the used material stays"
        );
        // The apex pointed along z; after turning, it is the highest vertex.
        assert!(
            model
                .mesh
                .positions
                .iter()
                .any(|p| (p.y - 1.0).abs() < 1e-6)
        );
        // A closed surface has two faces for each pane; an index of 1 is ignored.
        let face = crate::Bsdf::ThinDielectric {
            ior: 1.5,
            transmittance: 0.75,
            face: true,
        };
        assert_eq!(model.mesh.materials[0].bsdf, face);
        let changes: Vec<_> = asset.changes().collect();
        assert_eq!(changes, ["transparent materials made opaque"]);
    }

    #[test]
    fn concave_faces_keep_their_notch() {
        let text = "v 0 0 0\nv 2 0 0\nv 2 1 0\nv 1 1 0\nv 1 2 0\nv 0 2 0\nf 2 3 4 5 6 1\nf 1 2 3\n";
        let (models, _) = tobj::load_obj_buf(
            &mut std::io::Cursor::new(text),
            &tobj::LoadOptions::default(),
            |_| Err(tobj::LoadError::OpenFileFailed),
        )
        .expect("reads");
        let part = &models[0].mesh;
        let at = |v: u32| [0, 1].map(|k| part.positions[3 * v as usize + k]);
        let area = |t: &[u32; 3]| {
            let [a, b, c] = t.map(at);
            0.5 * ((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])).abs()
        };
        let found: f32 = super::triangles(part).iter().map(area).sum();
        assert_eq!(found, 4.0);
    }

    #[test]
    fn a_model_that_is_not_finite_is_left_out() {
        let folder = tempfile::tempdir().expect("a folder");
        assert!(library(folder.path()).assets[1].model().is_none());
    }

    #[test]
    fn the_fingerprint_follows_the_content() {
        let (a, b) = (
            tempfile::tempdir().expect("a folder"),
            tempfile::tempdir().expect("a folder"),
        );
        assert_eq!(
            library(a.path()).fingerprint(),
            library(b.path()).fingerprint()
        );
        assert!(
            library(a.path())
                .fingerprint()
                .starts_with("sweethome3d-1.8:")
        );
    }
}
