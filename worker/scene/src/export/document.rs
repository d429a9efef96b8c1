//! The glTF document of a scene: a flat list of nodes over shared meshes, in a fixed order.

use std::sync::Arc;

use serde::Serialize;

use crate::{
    Affine, Bsdf, Camera, Material, Mesh, Scene, Vec3,
    extras::{FORMAT, Keyed, MaterialExtras, NodeExtras, SceneExtras, metallic_roughness},
};

use super::{
    binary::{Accessor, Binary, BufferView},
    normals::Normals,
    textures::{ImageEntry, SamplerEntry, TextureEntry, TextureInfo, Textures},
};

/// The top level of glTF 2.0, as far as we write it. The field order is the order on disk.
#[derive(Debug, Serialize)]
#[serde(rename_all = "camelCase")]
pub(super) struct Document {
    asset: Asset,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    extensions_used: Vec<&'static str>,
    scene: u32,
    scenes: [SceneEntry; 1],
    nodes: Vec<Node>,
    cameras: [CameraEntry; 1],
    #[serde(skip_serializing_if = "Vec::is_empty")]
    meshes: Vec<MeshEntry>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    materials: Vec<MaterialEntry>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    textures: Vec<TextureEntry>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    samplers: Vec<SamplerEntry>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    images: Vec<ImageEntry>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    accessors: Vec<Accessor>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    buffer_views: Vec<BufferView>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    buffers: Vec<Buffer>,
}

#[derive(Debug, Serialize)]
struct Asset {
    version: &'static str,
    generator: &'static str,
    #[serde(skip_serializing_if = "String::is_empty")]
    copyright: String,
}

#[derive(Debug, Serialize)]
struct SceneEntry {
    name: String,
    nodes: Vec<usize>,
    extras: Keyed<SceneExtras>,
}

#[derive(Debug, Serialize)]
struct Node {
    name: String,
    matrix: [f32; 16],
    #[serde(skip_serializing_if = "Option::is_none")]
    mesh: Option<usize>,
    #[serde(skip_serializing_if = "Option::is_none")]
    camera: Option<usize>,
    #[serde(skip_serializing_if = "Option::is_none")]
    extras: Option<NodeExtras>,
}

#[derive(Debug, Serialize)]
struct CameraEntry {
    r#type: &'static str,
    perspective: Perspective,
}

#[derive(Debug, Serialize)]
#[serde(rename_all = "camelCase")]
struct Perspective {
    aspect_ratio: f32,
    yfov: f32,
    znear: f32,
}

#[derive(Debug, Serialize)]
struct MeshEntry {
    name: String,
    primitives: Vec<Primitive>,
}

#[derive(Debug, Serialize)]
struct Primitive {
    attributes: Attributes,
    indices: usize,
    material: usize,
}

#[derive(Debug, Serialize)]
struct Attributes {
    #[serde(rename = "POSITION")]
    position: usize,
    #[serde(rename = "NORMAL", skip_serializing_if = "Option::is_none")]
    normal: Option<usize>,
    #[serde(rename = "TEXCOORD_0", skip_serializing_if = "Option::is_none")]
    coordinates: Option<usize>,
}

#[derive(Debug, Serialize)]
#[serde(rename_all = "camelCase")]
struct MaterialEntry {
    name: String,
    double_sided: bool,
    pbr_metallic_roughness: Pbr,
    #[serde(skip_serializing_if = "Option::is_none")]
    extensions: Option<Glass>,
    extras: Keyed<MaterialExtras>,
}

/// The glass extensions that other programs render.
#[derive(Debug, Serialize)]
struct Glass {
    #[serde(rename = "KHR_materials_transmission")]
    transmission: Transmission,
    #[serde(rename = "KHR_materials_ior")]
    ior: Ior,
    #[serde(
        rename = "KHR_materials_volume",
        skip_serializing_if = "Option::is_none"
    )]
    volume: Option<Volume>,
}

#[derive(Debug, Serialize)]
#[serde(rename_all = "camelCase")]
struct Transmission {
    transmission_factor: f32,
}

#[derive(Debug, Serialize)]
struct Ior {
    ior: f32,
}

#[derive(Debug, Serialize)]
#[serde(rename_all = "camelCase")]
struct Volume {
    thickness_factor: f32,
}

/// A value above 0: the mesh encloses the glass.
const THICKNESS_M: f32 = 0.005;
/// Returns the extensions that materials use.
fn extensions(materials: &[MaterialEntry]) -> Vec<&'static str> {
    let glass = || materials.iter().filter_map(|m| m.extensions.as_ref());
    let mut names = vec![];
    if glass().next().is_some() {
        names.extend(["KHR_materials_transmission", "KHR_materials_ior"]);
    }
    if glass().any(|g| g.volume.is_some()) {
        names.push("KHR_materials_volume");
    }
    names
}

#[derive(Debug, Serialize)]
#[serde(rename_all = "camelCase")]
struct Pbr {
    base_color_factor: [f32; 4],
    #[serde(skip_serializing_if = "Option::is_none")]
    base_color_texture: Option<TextureInfo>,
    metallic_factor: f32,
    roughness_factor: f32,
}

#[derive(Debug, Serialize)]
#[serde(rename_all = "camelCase")]
struct Buffer {
    byte_length: usize,
}

impl Document {
    /// Returns the document and its binary chunk; `mesh_of[i]` is the mesh of object i.
    pub(super) fn new(
        scene: &Scene,
        meshes: &[Arc<Mesh>],
        mesh_of: &[usize],
        normals: Normals,
    ) -> (Self, Vec<u8>) {
        let mut binary = Binary::default();
        let mut textures = Textures::default();
        let mut materials: Vec<MaterialEntry> = Vec::new();
        let mesh_entries: Vec<MeshEntry> = meshes
            .iter()
            .map(|mesh| {
                let mut grouped = Mesh::clone(mesh);
                grouped.make_canonical();
                let base = materials.len();
                let entries = grouped.materials.iter();
                materials.extend(entries.map(|m| material_entry(m, &mut textures)));
                MeshEntry {
                    name: grouped.name.clone(),
                    primitives: primitives(&grouped, base, normals, &mut binary),
                }
            })
            .collect();

        let mut nodes: Vec<Node> = scene
            .objects
            .iter()
            .enumerate()
            .map(|(i, object)| Node {
                name: object.name.clone(),
                matrix: columns(&object.to_world),
                mesh: Some(mesh_of[i]),
                camera: None,
                extras: Some(NodeExtras {
                    label: Some(scene.labels[usize::from(object.label)].clone()),
                    instance: Some(i as u32),
                    ..NodeExtras::default()
                }),
            })
            .collect();
        nodes.push(camera_node(&scene.camera));

        let (images, samplers, textures) = textures.entries(&mut binary);
        let document = Self {
            asset: Asset {
                version: "2.0",
                generator: concat!("picofarm-scene ", env!("CARGO_PKG_VERSION")),
                copyright: scene.provenance.attribution.join("; "),
            },
            extensions_used: extensions(&materials),
            scene: 0,
            scenes: [SceneEntry {
                name: scene.name.clone(),
                nodes: (0..nodes.len()).collect(),
                extras: Keyed {
                    picofarm: scene_extras(scene),
                },
            }],
            nodes,
            cameras: [camera_entry(&scene.camera)],
            meshes: mesh_entries,
            materials,
            textures,
            samplers,
            images,
            accessors: binary.accessors,
            buffer_views: binary.views,
            buffers: if binary.bytes.is_empty() {
                Vec::new()
            } else {
                vec![Buffer {
                    byte_length: binary.bytes.len(),
                }]
            },
        };
        (document, binary.bytes)
    }
}

/// Returns one primitive for each material in use; all share the mesh's vertices.
fn primitives(mesh: &Mesh, base: usize, normals: Normals, binary: &mut Binary) -> Vec<Primitive> {
    let position = binary.positions(mesh);
    let normal = normals.of(mesh).map(|normals| binary.normals(&normals));
    let coordinates = binary.coordinates(mesh);
    let mut out = Vec::new();
    let mut start = 0;
    for run in mesh.triangle_material.chunk_by(|a, b| a == b) {
        out.push(Primitive {
            attributes: Attributes {
                position,
                normal,
                coordinates,
            },
            indices: binary.indices(&mesh.triangles[start..start + run.len()]),
            material: base + run[0] as usize,
        });
        start += run.len();
    }
    out
}

fn scene_extras(scene: &Scene) -> SceneExtras {
    SceneExtras {
        format: FORMAT,
        name: scene.name.clone(),
        labels: scene.labels.clone(),
        camera: scene.camera,
        laser: scene.laser.clone(),
        provenance: scene.provenance.clone(),
    }
}

fn material_entry(material: &Material, textures: &mut Textures) -> MaterialEntry {
    let (metallic_factor, roughness_factor) = metallic_roughness(material);
    let [r, g, b] = material.rgb;
    MaterialEntry {
        name: material.name.clone(),
        double_sided: material.two_sided,
        pbr_metallic_roughness: Pbr {
            base_color_factor: [r, g, b, 1.0],
            base_color_texture: material.texture.as_ref().map(|t| textures.info(t)),
            metallic_factor,
            roughness_factor,
        },
        extensions: glass(material.bsdf),
        extras: Keyed {
            picofarm: MaterialExtras {
                bsdf: material.bsdf,
                two_sided: material.two_sided,
                spectrum: material.spectrum.clone(),
            },
        },
    }
}

fn glass(bsdf: Bsdf) -> Option<Glass> {
    let (ior, bounds) = match bsdf {
        Bsdf::ThinDielectric { ior, face, .. } => (ior, face),
        Bsdf::Dielectric { ior, .. } => (ior, true),
        _ => return None,
    };
    Some(Glass {
        transmission: Transmission {
            transmission_factor: 1.0,
        },
        ior: Ior { ior },
        volume: bounds.then_some(Volume {
            thickness_factor: THICKNESS_M,
        }),
    })
}

/// Returns the column-major 4×4 matrix of an affine map.
fn columns(a: &Affine) -> [f32; 16] {
    let mut m = [0.0; 16];
    for (row, r) in a.linear.iter().enumerate() {
        (m[row], m[4 + row], m[8 + row]) = (r.x, r.y, r.z);
        m[12 + row] = a.translation[row];
    }
    m[15] = 1.0;
    m
}

/// Returns the node of a camera. glTF cameras look along −z with y up.
fn camera_node(camera: &Camera) -> Node {
    let (x, y, z) = (camera.right, -camera.down, -camera.forward);
    let row = |k: usize| Vec3::new(x[k], y[k], z[k]);
    let pose = Affine {
        linear: [row(0), row(1), row(2)],
        translation: camera.origin,
    };
    Node {
        name: "camera".into(),
        matrix: columns(&pose),
        mesh: None,
        camera: Some(0),
        extras: None,
    }
}

fn camera_entry(camera: &Camera) -> CameraEntry {
    let i = &camera.intrinsics;
    CameraEntry {
        r#type: "perspective",
        perspective: Perspective {
            aspect_ratio: (i.width as f32 / i.fx) / (i.height as f32 / i.fy),
            yfov: 2.0 * libm::atanf(i.height as f32 * 0.5 / i.fy),
            znear: 0.01,
        },
    }
}
