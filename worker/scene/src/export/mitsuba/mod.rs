//! Writes a scene for Mitsuba 3: `scene.xml`, `meshes/*.ply` and `textures/*.png`, which both
//! `mitsuba.load_file` and [`crate::import`] read. Data that Mitsuba cannot represent (labels,
//! spots, provenance, exact BSDFs) is stored in a comment of the XML. Spectra are stored only
//! there: the `<bsdf>` of a material has its colour.

pub(crate) mod text;

use std::{collections::BTreeMap, fmt::Write as _, path::Path, sync::Arc};

use crate::{
    Material, Mesh, Scene, SceneError, Texture,
    extras::{FORMAT, SceneExtras},
};

use super::{ply, png, write_whole};
use text::{
    Extras, MaterialExtras, ObjectExtras, TextureExtras, beam_text, bsdf_text, matrix_text,
    sensor_text,
};

/// Writes the scene to `file` (an `.xml`), with its meshes and textures in folders next to it.
/// Returns the features that Mitsuba's model cannot represent, a sentence each; often none.
///
/// A mesh is written once per material that it uses. Colours are the materials' `rgb`, scaled so
/// that their mean is the reflectance at the laser's wavelength. Every beam is a `projector` of
/// 0.1°.
///
/// # Errors
/// [`SceneError::Invalid`] for a scene that fails [`Scene::validate`], [`SceneError::Write`] naming
/// the file.
pub fn write_mitsuba(scene: &Scene, file: &Path) -> Result<Vec<String>, SceneError> {
    scene.validate()?;
    let folder = file.parent().unwrap_or(Path::new(""));
    for name in ["meshes", "textures"] {
        let path = folder.join(name);
        std::fs::create_dir_all(&path).map_err(|source| SceneError::Write { path, source })?;
    }
    let mut writer = Writer {
        folder,
        materials: Vec::new(),
        textures: Vec::new(),
        text: String::new(),
        known: BTreeMap::new(),
        notes: Vec::new(),
    };
    let shapes = writer.shapes(scene)?;
    let i = &scene.camera.intrinsics;
    if i.fx != i.fy {
        let what = format!("pixels are not square (fx {}, fy {}): fx used", i.fx, i.fy);
        writer.notes.push(what);
    }
    let extras = Extras {
        scene: SceneExtras {
            format: FORMAT,
            name: scene.name.clone(),
            labels: scene.labels.clone(),
            camera: scene.camera,
            laser: scene.laser.clone(),
            provenance: scene.provenance.clone(),
        },
        objects: scene
            .objects
            .iter()
            .map(|o| ObjectExtras {
                name: o.name.clone(),
                label: scene.labels[usize::from(o.label)].clone(),
                mesh: o.mesh.name.clone(),
            })
            .collect(),
        materials: writer.known,
    };
    let json = serde_json::to_string(&extras).map_err(|e| SceneError::Invalid {
        scene: scene.name.clone(),
        field: "extras".into(),
        what: format!("cannot be written as JSON: {e}"),
    })?;
    let mut xml = String::from("<scene version=\"3.0.0\">\n");
    let mut line = |text: &str| {
        xml.push_str(text);
        xml.push('\n');
    };
    line(&format!("<!-- picofarm {} -->", for_comment(&json)));
    line("<integrator type=\"path\"/>");
    line(&sensor_text(&scene.camera));
    line(writer.text.trim_end());
    line(shapes.trim_end());
    for (k, beam) in scene.laser.beams.iter().enumerate() {
        line(&beam_text(k, scene.laser.origin, beam));
    }
    line("</scene>");
    write_whole(file, xml.as_bytes())?;
    Ok(writer.notes)
}

/// Converts JSON to a form that any XML comment can contain: plain ASCII without two consecutive
/// hyphens. All other characters are in strings, where they can be escaped.
fn for_comment(json: &str) -> String {
    let mut out = String::with_capacity(json.len());
    for c in json.chars() {
        if c.is_ascii() && !c.is_ascii_control() && !(c == '-' && out.ends_with('-')) {
            out.push(c);
        } else {
            for unit in c.encode_utf16(&mut [0; 2]) {
                write!(out, "\\u{unit:04x}").expect("strings take every text");
            }
        }
    }
    out
}

/// The (file, id of the material) of each part as which a mesh is written.
type Parts = Vec<(String, String)>;

struct Writer<'a> {
    folder: &'a Path,
    materials: Vec<Material>,
    textures: Vec<Arc<Texture>>,
    /// The BSDFs.
    text: String,
    known: BTreeMap<String, MaterialExtras>,
    notes: Vec<String>,
}

impl Writer<'_> {
    /// Writes every mesh, and returns the text of all shapes.
    fn shapes(&mut self, scene: &Scene) -> Result<String, SceneError> {
        // The written meshes, with the (file, material) of their parts.
        let mut written: Vec<(Arc<Mesh>, Parts)> = Vec::new();
        let mut out = String::new();
        for (k, object) in scene.objects.iter().enumerate() {
            let known = written.iter().position(|w| Arc::ptr_eq(&w.0, &object.mesh));
            let known = match known {
                Some(known) => known,
                None => {
                    let parts = self.mesh(written.len(), &object.mesh)?;
                    written.push((object.mesh.clone(), parts));
                    written.len() - 1
                }
            };
            let place = matrix_text(&object.to_world);
            for (p, (file, material)) in written[known].1.iter().enumerate() {
                writeln!(
                    out,
                    "<shape type=\"ply\" id=\"object{k}.{p}\"><string name=\"filename\" value=\"{file}\"/>\
                     <boolean name=\"face_normals\" value=\"true\"/>\
                     <transform name=\"to_world\"><matrix value=\"{place}\"/></transform>\
                     <ref id=\"{material}\"/></shape>"
                )
                .expect("strings take every text");
            }
        }
        Ok(out)
    }

    /// Writes one mesh, with a file for each material that it uses.
    fn mesh(&mut self, index: usize, mesh: &Mesh) -> Result<Parts, SceneError> {
        let mut out = Vec::new();
        for (m, material) in mesh.materials.iter().enumerate() {
            let Some(part) = part(mesh, m as u32) else {
                continue;
            };
            let file = format!("meshes/{index:04}-{m}.ply");
            write_whole(&self.folder.join(&file), &ply::mesh_bytes(&part))?;
            out.push((file, self.material(material)?));
        }
        Ok(out)
    }

    /// Returns the id of a material, and writes the material if it is new.
    fn material(&mut self, material: &Material) -> Result<String, SceneError> {
        if let Some(k) = self.materials.iter().position(|m| m == material) {
            return Ok(format!("material{k}"));
        }
        let id = format!("material{}", self.materials.len());
        self.materials.push(material.clone());
        let texture = match &material.texture {
            None => None,
            Some(texture) => Some(TextureExtras {
                file: self.texture(texture)?,
                name: texture.name().to_owned(),
                wrap: texture.wrap(),
            }),
        };
        let written = bsdf_text(&id, material, texture.as_ref());
        for (file, image) in &written.images {
            write_whole(&self.folder.join(file), &png(image))?;
        }
        if written.clamped {
            let what = format!("material {:?}: colours cut off at 1", material.name);
            self.notes.push(what);
        }
        if written.whole {
            let what = format!(
                "material {:?}: each face of the glass is a whole pane in Mitsuba, so less light passes and more is reflected",
                material.name
            );
            self.notes.push(what);
        }
        if !material.spectrum.is_empty() {
            let what = format!(
                "material {:?}: its spectrum stands in the comment alone, Mitsuba renders its colour",
                material.name
            );
            self.notes.push(what);
        }
        self.text.push_str(&written.text);
        self.text.push('\n');
        let extras = MaterialExtras {
            name: material.name.clone(),
            bsdf: material.bsdf,
            rgb: material.rgb,
            two_sided: material.two_sided,
            texture,
            spectrum: material.spectrum.clone(),
        };
        self.known.insert(id.clone(), extras);
        Ok(id)
    }

    /// Returns the file of a texture, and writes the texture if it is new.
    fn texture(&mut self, texture: &Arc<Texture>) -> Result<String, SceneError> {
        let known = self.textures.iter().position(|t| t == texture);
        let index = match known {
            Some(k) => k,
            None => {
                self.textures.push(texture.clone());
                let file = format!("textures/{}.png", self.textures.len() - 1);
                write_whole(&self.folder.join(file), &png(texture))?;
                self.textures.len() - 1
            }
        };
        Ok(format!("textures/{index}.png"))
    }
}

/// Returns the facets of one material with the vertices that they use, in their order, or `None`
/// without facets.
fn part(mesh: &Mesh, material: u32) -> Option<Mesh> {
    let facets = mesh.triangles.iter().zip(&mesh.triangle_material);
    let facets: Vec<[u32; 3]> = facets.filter(|f| *f.1 == material).map(|f| *f.0).collect();
    if facets.is_empty() {
        return None;
    }
    let mut used: Vec<u32> = facets.iter().flatten().copied().collect();
    used.sort_unstable();
    used.dedup();
    let slot = |v: u32| used.binary_search(&v).expect("used vertices are listed") as u32;
    Some(Mesh {
        name: mesh.name.clone(),
        triangles: facets.iter().map(|t| t.map(slot)).collect(),
        positions: used.iter().map(|&v| mesh.positions[v as usize]).collect(),
        uv: if mesh.uv.is_empty() {
            Vec::new()
        } else {
            used.iter().map(|&v| mesh.uv[v as usize]).collect()
        },
        ..Mesh::default()
    })
}
