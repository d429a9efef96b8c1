//! Compressed, sparse and quantised glTF, and orthographic cameras: the same geometry as in plain
//! files.

use draco_core::{
    DataType, EncoderBuffer, EncoderOptions, FaceIndex, GeometryAttributeType, Mesh, MeshEncoder,
    PointAttribute, PointIndex,
};
use picofarm_scene::Scene;
use serde_json::json;

use crate::{
    common::gltf::{Gltf, QUAD},
    strangers::{
        Expected::{self, Read, Refused},
        check, read,
    },
};

/// The corners of the square's triangles.
const CORNERS: [u32; 6] = [0, 1, 2, 0, 2, 3];
/// The square of the file, unchanged.
const SAME: Expected = Read([-0.5, -0.5, -2.0], [0.5, 0.5, -2.0], 1.0, "");

/// Returns the square as Draco writes it, with texture coordinates as attribute 1.
pub fn draco(level: i32) -> Vec<u8> {
    let mut mesh = Mesh::new();
    let uv: [f32; 8] = [0.0, 0.0, 1.0, 0.0, 1.0, 1.0, 0.0, 1.0];
    for (kind, numbers) in [
        (GeometryAttributeType::Position, &QUAD[..]),
        (GeometryAttributeType::TexCoord, &uv[..]),
    ] {
        let each = numbers.len() / 4;
        let mut attribute = PointAttribute::new();
        attribute.init(kind, each as u8, DataType::Float32, false, 4);
        let bytes: Vec<u8> = numbers.iter().flat_map(|x| x.to_le_bytes()).collect();
        attribute.buffer_mut().write(0, &bytes);
        mesh.add_attribute(attribute);
    }
    mesh.set_num_faces(2);
    for (k, corners) in CORNERS.chunks(3).enumerate() {
        let face = [corners[0], corners[1], corners[2]].map(PointIndex);
        mesh.set_face(FaceIndex(k as u32), face);
    }
    let mut encoder = MeshEncoder::new();
    encoder.set_mesh(mesh);
    let mut options = EncoderOptions::new();
    options.set_compression_level(level);
    let mut out = EncoderBuffer::new();
    encoder.encode(&options, &mut out).expect("encodes");
    out.data().to_vec()
}

/// Replaces the second mesh by a Draco mesh.
pub fn with_draco(file: &mut Gltf, data: &[u8]) {
    let view = file.bare_view(data);
    let accessors = file.json["accessors"].as_array_mut().expect("a list");
    let first = accessors.len();
    accessors.push(json!({"componentType": 5126, "count": 4, "type": "VEC3", "min": [-0.5, -0.5, 0], "max": [0.5, 0.5, 0]}));
    accessors.push(json!({"componentType": 5126, "count": 4, "type": "VEC2"}));
    accessors.push(json!({"componentType": 5123, "count": 6, "type": "SCALAR"}));
    let attributes = json!({"POSITION": first, "TEXCOORD_0": first + 1});
    *file.primitive() = json!({"attributes": attributes, "indices": first + 2, "material": 0, "extensions":
        {"KHR_draco_mesh_compression": {"bufferView": view, "attributes": {"POSITION": 0, "TEXCOORD_0": 1}}}});
    file.json["extensionsRequired"] = json!(["KHR_draco_mesh_compression"]);
}

/// Returns the compressed corners and indices of the square.
pub fn meshopt() -> [Vec<u8>; 2] {
    let corners: Vec<[f32; 3]> = QUAD.as_chunks::<3>().0.to_vec();
    [
        meshopt::encoding::encode_vertex_buffer_level(&corners, 2, Some(0)).expect("encodes"),
        meshopt::encoding::encode_index_buffer(&CORNERS, 4).expect("encodes"),
    ]
}

/// Replaces the second mesh by one with meshopt's compression.
pub fn with_meshopt(file: &mut Gltf, [vertices, triangles]: &[Vec<u8>; 2]) {
    let mut view = |data: &[u8], count: usize, stride: usize, mode: &str| {
        let index = file.bare_view(data);
        let view = &mut file.json["bufferViews"][index];
        let own = json!({"buffer": 0, "byteOffset": view["byteOffset"], "byteLength": data.len(), "byteStride": stride,
            "count": count, "mode": mode});
        // The buffer without content that readers without the extension would need.
        *view = json!({"buffer": 1, "byteOffset": 0, "byteLength": count * stride,
            "extensions": {"EXT_meshopt_compression": own}});
        if stride > 4 {
            view["byteStride"] = json!(stride);
        }
        index
    };
    let places = view(vertices, 4, 12, "ATTRIBUTES");
    let corners = view(triangles, 6, 2, "TRIANGLES");
    let accessors = file.json["accessors"].as_array_mut().expect("a list");
    let first = accessors.len();
    accessors.push(json!({"bufferView": places, "componentType": 5126, "count": 4, "type": "VEC3", "min": [-0.5, -0.5, 0],
        "max": [0.5, 0.5, 0]}));
    accessors
        .push(json!({"bufferView": corners, "componentType": 5123, "count": 6, "type": "SCALAR"}));
    *file.primitive() =
        json!({"attributes": {"POSITION": first}, "indices": first + 1, "material": 0});
    file.json["extensionsRequired"] = json!(["EXT_meshopt_compression"]);
    file.fallback = true;
}

fn read_file(file: &Gltf) -> Result<Scene, picofarm_scene::SceneError> {
    read(&[("a.gltf", &file.bytes())])
}

#[test]
fn draco_meshes_are_what_was_encoded() {
    for level in [0, 5, 7, 10] {
        let mut file = Gltf::new();
        with_draco(&mut file, &draco(level));
        // Draco quantises, to about a thousandth of the size.
        let scene = read_file(&file).expect("reads");
        let mesh = &scene.objects.last().expect("an object").mesh;
        assert_eq!((mesh.positions.len(), mesh.triangles.len()), (4, 2));
        for (p, uv) in mesh.positions.iter().zip(&mesh.uv) {
            let expected = [p.x + 0.5, p.y + 0.5];
            let off = |k: usize| (uv[k] - expected[k]).abs();
            assert!(off(0) < 2e-3 && off(1) < 2e-3, "{p:?} {uv:?}");
            assert!((p.x.abs() - 0.5).abs() < 1e-3 && (p.y.abs() - 0.5).abs() < 1e-3);
        }
    }
    let mut file = Gltf::new();
    with_draco(&mut file, &draco(7)[..30]);
    check("cut short", read_file(&file), &Refused("gltf-transform"));
    let mut file = Gltf::new();
    with_draco(&mut file, &draco(7));
    let draco = &mut file.primitive()["extensions"]["KHR_draco_mesh_compression"];
    draco["attributes"]["POSITION"] = json!(9);
    check(
        "no such attribute",
        read_file(&file),
        &Refused("has no attribute 9"),
    );
}

#[test]
fn meshopt_views_are_what_was_encoded() {
    let mut file = Gltf::new();
    with_meshopt(&mut file, &meshopt());
    check("meshopt", read_file(&file), &SAME);
    let [vertices, triangles] = meshopt();
    let mut file = Gltf::new();
    with_meshopt(&mut file, &[vertices[..9].to_vec(), triangles]);
    check(
        "cut short",
        read_file(&file),
        &Refused("cut short or damaged"),
    );
}

#[test]
fn a_meshopt_view_that_promises_too_much_is_refused_before_decoding() {
    for count in [1u64 << 20, 1 << 40] {
        let mut file = Gltf::new();
        with_meshopt(&mut file, &meshopt());
        let views = file.json["bufferViews"].as_array_mut().expect("a list");
        let view = views.iter_mut().find(|v| v.get("extensions").is_some());
        view.expect("a compressed view")["extensions"]["EXT_meshopt_compression"]["count"] =
            json!(count);
        check("too much", read_file(&file), &Refused("elements"));
    }
}

#[test]
fn sparse_places_replace_those_of_the_view_or_zeros() {
    let mut file = Gltf::new();
    let places = file.floats(&[0.5, 0.5, 0.0, -0.5, 0.5, 0.0], "VEC3");
    let indices = file.accessor(&[2, 3], 5121, "SCALAR", 2);
    let view = |accessor: usize| file.json["accessors"][accessor]["bufferView"].clone();
    let sparse = json!({"count": 2, "indices": {"bufferView": view(indices), "componentType": 5121},
        "values": {"bufferView": view(places)}});
    // The corners of the view are those of the square, with two of them elsewhere.
    let moved: Vec<f32> = QUAD
        .iter()
        .enumerate()
        .map(|(k, x)| if k < 6 { *x } else { 7.0 })
        .collect();
    let base = file.floats(&moved, "VEC3");
    file.json["accessors"][base]["sparse"] = sparse.clone();
    file.json["accessors"][base]["min"] = json!([-0.5, -0.5, 0]);
    file.json["accessors"][base]["max"] = json!([0.5, 0.5, 0]);
    file.primitive()["attributes"]["POSITION"] = json!(base);
    check("over a view", read_file(&file), &SAME);
    let accessor = file.json["accessors"][base]
        .as_object_mut()
        .expect("an object");
    accessor.remove("bufferView");
    let half = Read([-0.5, 0.0, -2.0], [0.5, 0.5, -2.0], 0.25, "");
    check("over zeros", read_file(&file), &half);
}

#[test]
fn quantised_places_and_texture_coordinates_have_their_values() {
    let words =
        |numbers: &[i16]| -> Vec<u8> { numbers.iter().flat_map(|x| x.to_le_bytes()).collect() };
    for (normalized, scale) in [(true, 32767.0), (false, 1.0)] {
        let mut file = Gltf::new();
        // Elements of 8 bytes, of which the last two are a gap.
        let corners: Vec<i16> = QUAD
            .chunks(3)
            .flat_map(|p| [p[0], p[1], p[2], 9.0].map(|x| (x * 2e4) as i16))
            .collect();
        let places = file.accessor(&words(&corners), 5122, "VEC3", 4);
        let view = file.json["accessors"][places]["bufferView"]
            .as_u64()
            .expect("a view") as usize;
        file.json["bufferViews"][view]["byteStride"] = json!(8);
        let accessor = &mut file.json["accessors"][places];
        accessor["min"] = json!([-10000, -10000, 0]);
        accessor["max"] = json!([10000, 10000, 0]);
        accessor["normalized"] = json!(normalized);
        let uv = file.accessor(&words(&[0, 0, 2, 0, 2, -2, 0, -2]), 5122, "VEC2", 4);
        file.primitive()["attributes"] = json!({"POSITION": places, "TEXCOORD_0": uv});
        let size = 1e4 / scale;
        file.json["nodes"][2]["scale"] = json!([0.5 / size, 0.5 / size, 0.5 / size]);
        file.json["extensionsRequired"] = json!(["KHR_mesh_quantization"]);
        check("quantised", read_file(&file), &SAME);
        let scene = read_file(&file).expect("reads");
        let mesh = &scene.objects.last().expect("an object").mesh;
        assert_eq!(mesh.uv, [[0.0, 0.0], [2.0, 0.0], [2.0, -2.0], [0.0, -2.0]]);
    }
}

#[test]
fn an_orthographic_camera_becomes_a_pinhole_with_its_width_at_the_middle_of_the_objects() {
    let mut file = Gltf::new();
    let lens = json!({"xmag": 2, "ymag": 1, "zfar": 9, "znear": 1});
    file.json["cameras"] = json!([{"type": "orthographic", "orthographic": lens}]);
    let scene = read_file(&file).expect("reads");
    let camera = &scene.camera;
    assert_eq!(camera.origin, picofarm_scene::Vec3::ZERO);
    // The square and the wall stand 2 m and 3 m in front of the camera.
    let i = &camera.intrinsics;
    let half = |pixels: u32, focal: f32| 2.5 * 0.5 * pixels as f32 / focal;
    assert!((half(i.width, i.fx) - 2.0).abs() < 1e-4, "{i:?}");
    assert!((half(i.height, i.fy) - 1.0).abs() < 1e-4, "{i:?}");
    assert!(scene.provenance.notes["import.cameras"].contains("--look-from"));
}
