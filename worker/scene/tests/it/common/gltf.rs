//! glTF files written by hand.

use serde_json::{Value as Json, json};

/// A glTF file under construction: a wall, a camera with a laser, and a quad 2 m in front of it.
pub struct Gltf {
    pub json: Json,
    pub data: Vec<u8>,
    /// Whether there is a second buffer without content, as for meshopt's extension.
    pub fallback: bool,
}

/// The corners of a unit square.
pub const QUAD: [f32; 12] = [
    -0.5, -0.5, 0.0, 0.5, -0.5, 0.0, 0.5, 0.5, 0.0, -0.5, 0.5, 0.0,
];

impl Gltf {
    /// Returns the file with a wall, a camera with a laser, and a square in front of the wall.
    pub fn new() -> Self {
        let mut file = Gltf {
            json: json!({
                "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0, 1, 2]}],
                "nodes": [
                    {"mesh": 0, "translation": [0, 0, -3], "extras": {"label": "wall"}},
                    {"camera": 0, "extras": {"laser_spots": 4}},
                    {"mesh": 1, "translation": [0, 0, -2]},
                ],
                "materials": [{"pbrMetallicRoughness": {"metallicFactor": 0}}],
                "cameras": [{"type": "perspective", "perspective": {"yfov": 1.0, "znear": 0.01, "aspectRatio": 1}}],
                "accessors": [], "bufferViews": [], "meshes": [],
            }),
            data: Vec::new(),
            fallback: false,
        };
        let places = file.floats(&QUAD, "VEC3");
        file.json["accessors"][places]["min"] = json!([-0.5, -0.5, 0]);
        file.json["accessors"][places]["max"] = json!([0.5, 0.5, 0]);
        let mut corners = Vec::new();
        for k in [0u16, 1, 2, 0, 2, 3] {
            corners.extend(k.to_le_bytes());
        }
        let corners = file.accessor(&corners, 5123, "SCALAR", 6);
        for _ in 0..2 {
            let mesh = json!({"primitives": [{"attributes": {"POSITION": places}, "indices": corners, "material": 0}]});
            file.json["meshes"]
                .as_array_mut()
                .expect("a list")
                .push(mesh);
        }
        file
    }

    /// Adds an accessor with a view of its own and returns its index.
    pub fn accessor(&mut self, bytes: &[u8], component: u32, kind: &str, count: usize) -> usize {
        self.data.resize(self.data.len().next_multiple_of(4), 0);
        let view = json!({"buffer": 0, "byteOffset": self.data.len(), "byteLength": bytes.len()});
        self.data.extend(bytes);
        let views = self.json["bufferViews"].as_array_mut().expect("a list");
        views.push(view);
        let accessor = json!({"bufferView": views.len() - 1, "componentType": component, "count": count, "type": kind});
        let all = self.json["accessors"].as_array_mut().expect("a list");
        all.push(accessor);
        all.len() - 1
    }

    /// Adds a view without an accessor and returns its index.
    pub fn bare_view(&mut self, bytes: &[u8]) -> usize {
        let accessor = self.accessor(bytes, 5121, "SCALAR", bytes.len());
        let accessors = self.json["accessors"].as_array_mut().expect("a list");
        accessors.truncate(accessor);
        self.json["bufferViews"].as_array().expect("a list").len() - 1
    }

    /// Adds an accessor of floats.
    pub fn floats(&mut self, numbers: &[f32], kind: &str) -> usize {
        let each = match kind {
            "VEC2" => 2,
            "VEC3" => 3,
            "VEC4" => 4,
            "MAT4" => 16,
            _ => 1,
        };
        let bytes: Vec<u8> = numbers.iter().flat_map(|x| x.to_le_bytes()).collect();
        self.accessor(&bytes, 5126, kind, numbers.len() / each)
    }

    /// Returns the second mesh's primitive.
    pub fn primitive(&mut self) -> &mut Json {
        &mut self.json["meshes"][1]["primitives"][0]
    }

    /// Adds a texture of an image to the second mesh, as its base colour.
    pub fn textured(&mut self, image: &[u8], mime: &str) {
        let uv = self.floats(&[0.0, 0.0, 1.0, 0.0, 1.0, 1.0, 0.0, 1.0], "VEC2");
        self.primitive()["attributes"]["TEXCOORD_0"] = json!(uv);
        self.accessor(image, 5121, "SCALAR", image.len());
        let view = self.json["bufferViews"].as_array().expect("a list").len() - 1;
        self.json["images"] = json!([{"bufferView": view, "mimeType": mime}]);
        self.json["textures"] = json!([{"source": 0}]);
        self.primitive()["material"] = json!(1);
        let material = json!({"pbrMetallicRoughness": {"metallicFactor": 0, "baseColorTexture": {"index": 0}}});
        self.json["materials"]
            .as_array_mut()
            .expect("a list")
            .push(material);
    }

    /// Returns the `.gltf` file.
    pub fn bytes(&self) -> Vec<u8> {
        let mut json = self.json.clone();
        json["buffers"] =
            json!([{"byteLength": self.data.len(), "uri": super::data_uri(&self.data)}]);
        if self.fallback {
            let buffer = json!({"byteLength": 1 << 20, "extensions": {"EXT_meshopt_compression": {"fallback": true}}});
            json["buffers"].as_array_mut().expect("a list").push(buffer);
        }
        serde_json::to_vec(&json).expect("JSON")
    }
}
