//! OBJ and STL files as scenes of one object, without camera, laser and unit.

use std::{
    collections::BTreeMap,
    io::Cursor,
    path::{Path, PathBuf},
    sync::Arc,
};

use crate::{Affine, Material, Mesh, Object, Provenance, SceneError, Vec3, Wrap};

use super::{
    ImportOptions, Opener,
    complete::Draft,
    far, format_error,
    image::{self, Images},
    mtl,
    obj::{self, Obj},
    read_file, stl,
};

/// The linear albedo of surfaces without a colour.
const GREY: f32 = 0.5;
/// The range of albedos of real surfaces.
const ALBEDO: [f32; 2] = [0.04, 0.9];

/// Returns whether a file is read as OBJ. The format has no signature.
pub(super) fn is_obj(path: &Path, bytes: &[u8]) -> bool {
    let extension = path
        .extension()
        .is_some_and(|e| e.eq_ignore_ascii_case("obj"));
    extension && !matches!(bytes.trim_ascii_start().first(), Some(b'{' | b'<'))
}

/// Reads an STL file. All its solids are one object.
pub(super) fn read_stl(
    path: &Path,
    bytes: &[u8],
    options: &ImportOptions,
) -> Result<Draft, SceneError> {
    let solid = stl::parse(bytes).map_err(|what| format_error(path, what))?;
    let mut notes = Notes::default();
    let positions = near_origin(&solid.positions, options, &mut notes);
    let mesh = Mesh {
        name: stem(path),
        positions,
        triangle_material: vec![0; solid.triangles.len()],
        triangles: solid.triangles,
        materials: vec![Material::diffuse("stl", [GREY; 3])],
        ..Mesh::default()
    };
    Ok(draft(path, "stl", mesh, notes))
}

/// Reads an OBJ file with its materials.
pub(super) fn read_obj(
    path: &Path,
    bytes: &[u8],
    options: &ImportOptions,
    files: &Opener,
) -> Result<Draft, SceneError> {
    let obj = obj::parse(bytes).map_err(|what| format_error(path, what))?;
    let mut notes = Notes::default();
    for (key, note) in &obj.notes {
        notes.add(key, note.clone());
    }
    let materials = materials(path, &obj, files, &mut notes)?;
    let positions = near_origin(&obj.positions, options, &mut notes);
    let textured = materials.iter().any(|m| m.texture.is_some());
    let mesh = Mesh {
        name: stem(path),
        positions,
        // In OBJ, v points upwards.
        uv: match textured {
            true => obj.uv.iter().map(|[u, v]| [*u, 1.0 - v]).collect(),
            false => Vec::new(),
        },
        triangles: obj.triangles,
        triangle_material: obj.triangle_material,
        materials,
    };
    Ok(draft(path, "obj", mesh, notes))
}

/// Returns the existing files that an OBJ file refers to.
pub(super) fn files(path: &Path, bytes: &[u8], opener: &Opener) -> Vec<PathBuf> {
    let mut all = Vec::new();
    for library in obj::parse(bytes).map_or_else(|_| Vec::new(), |obj| obj.libraries) {
        let Some(file) = existing(path, &library, opener) else {
            continue;
        };
        let known = read_library(&file, opener).unwrap_or_default();
        let textures = known.iter().filter_map(|m| m.diffuse_texture.as_deref());
        all.extend(textures.filter_map(|name| existing(path, name, opener)));
        all.push(file);
    }
    all.sort();
    all.dedup();
    all
}

fn existing(path: &Path, name: &str, opener: &Opener) -> Option<PathBuf> {
    // Exporters on Windows write backslashes.
    let name = name.replace('\\', "/");
    let file = Opener::named(path.parent().unwrap_or(Path::new("")), &name).ok()?;
    (opener.check(&file).is_ok() && file.is_file()).then_some(file)
}

fn read_library(file: &Path, opener: &Opener) -> Result<Vec<tobj::Material>, String> {
    let bytes = read_file(opener, file).map_err(|e| e.to_string())?;
    let text = mtl::complete_colours(&String::from_utf8_lossy(&bytes))
        .map_err(|what| format!("{}: {what}", file.display()))?;
    tobj::load_mtl_buf(&mut Cursor::new(text))
        .map(|(materials, _)| materials)
        .map_err(|e| format!("{}: {e}", file.display()))
}

/// Returns the materials of an OBJ file in the order of its names.
fn materials(
    path: &Path,
    obj: &Obj,
    files: &Opener,
    notes: &mut Notes,
) -> Result<Vec<Material>, SceneError> {
    let mut known: BTreeMap<String, tobj::Material> = BTreeMap::new();
    for library in &obj.libraries {
        let Some(file) = existing(path, library, files) else {
            notes.add(
                "materials",
                "a material file is missing; its surfaces are grey".into(),
            );
            continue;
        };
        match read_library(&file, files) {
            Ok(all) => known.extend(all.into_iter().map(|m| (m.name.clone(), m))),
            Err(what) => return Err(format_error(path, what)),
        }
    }
    let mut images = Images::default();
    let mut convert = |name: &String| {
        let Some(file) = known.get(name) else {
            return Ok(Material::diffuse("grey", [GREY; 3]));
        };
        let mut material = material(file);
        let textured = !obj.uv.is_empty() && !material.is_glass();
        let texture = file.diffuse_texture.as_deref().filter(|_| textured);
        if let Some(name) = texture {
            match existing(path, name, files) {
                None => notes.add("textures", "of a missing image left out".into()),
                Some(file) => {
                    let decode = || {
                        let bytes = read_file(files, &file).map_err(|e| e.to_string())?;
                        image::decode(name, &bytes, Wrap::Repeat)
                    };
                    let texture = images
                        .get(file.clone(), decode)
                        .map_err(|what| format_error(path, what))?;
                    material.texture = Some(texture);
                }
            }
        }
        if material.is_glass() {
            notes.add(
                "glass",
                "opacity of one half and less: thin glass, light goes straight on or is reflected"
                    .into(),
            );
        } else if file.dissolve.is_some_and(|d| d < 1.0) {
            notes.add("opacity", "of partly transparent materials left out".into());
        }
        Ok(material)
    };
    obj.materials.iter().map(&mut convert).collect()
}

/// Converts a material. `Kd` is a display colour: the albedo is its linear value.
fn material(file: &tobj::Material) -> Material {
    let linear = |v: f32| libm::powf(v.clamp(0.0, 1.0), 2.2).clamp(ALBEDO[0], ALBEDO[1]);
    let rgb = match file.diffuse {
        // With a texture, the image contains the colour.
        _ if file.diffuse_texture.is_some() => [1.0; 3],
        Some(kd) => kd.map(linear),
        None => [GREY; 3],
    };
    let glass = file
        .dissolve
        .and_then(|opacity| Material::by_opacity(opacity, file.optical_density, false));
    match glass {
        Some(bsdf) => Material {
            bsdf,
            rgb: [(1.0 - file.dissolve.unwrap_or(0.0)).clamp(0.0, 1.0); 3],
            ..Material::glass(file.name.clone())
        },
        None => Material {
            two_sided: true,
            ..Material::diffuse(file.name.clone(), rgb)
        },
    }
}

#[derive(Default)]
struct Notes(BTreeMap<String, String>);

impl Notes {
    fn add(&mut self, key: &str, what: String) {
        super::add_note(&mut self.0, &format!("import.{key}"), what);
    }
}

/// Rounds positions. A mesh far from its origin is moved first.
fn near_origin(positions: &[[f64; 3]], options: &ImportOptions, notes: &mut Notes) -> Vec<Vec3> {
    let mut origin = [0.0; 3];
    if options.camera.is_none()
        && options.view.from.is_none()
        && let Some((centre, size)) = far::centre(positions)
        && far::is_lossy(centre, size)
    {
        origin = centre;
        notes.add("origin", far::note(centre));
    }
    far::relative(positions, origin)
}

fn stem(path: &Path) -> String {
    path.file_stem()
        .unwrap_or_default()
        .to_string_lossy()
        .into_owned()
}

fn draft(path: &Path, source: &str, mesh: Mesh, notes: Notes) -> Draft {
    Draft {
        name: stem(path),
        objects: vec![Object {
            mesh: Arc::new(mesh),
            to_world: Affine::IDENTITY,
            label: 0,
            name: stem(path),
        }],
        labels: vec!["unlabelled".into()],
        cameras: Vec::new(),
        laser: None,
        has_unit: false,
        provenance: Provenance {
            source: source.into(),
            notes: notes.0,
            ..Provenance::default()
        },
    }
}
