//! Scene files to be spoilt: a generated `.glb` taken apart into `.gltf` and `.bin`.

use std::{fs, path::Path};

use serde_json::{Value, json};

/// A `.glb` file's two parts.
pub struct Parts {
    /// The JSON document.
    pub document: Value,
    /// The binary buffer.
    pub buffer: Vec<u8>,
}

impl Parts {
    /// Takes a `.glb` apart.
    ///
    /// # Panics
    /// When it is none.
    pub fn of(glb: &Path) -> Self {
        let bytes = fs::read(glb).unwrap_or_else(|e| panic!("{}: {e}", glb.display()));
        assert_eq!(&bytes[..4], b"glTF", "{}", glb.display());
        let word =
            |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().expect("four bytes"));
        let length = word(12) as usize;
        let (document, rest) = (&bytes[20..20 + length], 20 + length);
        Self {
            document: serde_json::from_slice(document).expect("the first chunk is JSON"),
            buffer: bytes[rest + 8..][..word(rest) as usize].to_vec(),
        }
    }

    /// Makes the first vertex of the first mesh not a number.
    ///
    /// # Panics
    /// When there is no mesh.
    pub fn spoil_vertex(&mut self) {
        let index = |v: &Value| v.as_u64().expect("an index") as usize;
        let offset = |v: &Value| v["byteOffset"].as_u64().unwrap_or(0) as usize;
        let d = &self.document;
        let accessor =
            &d["accessors"][index(&d["meshes"][0]["primitives"][0]["attributes"]["POSITION"])];
        let at = offset(accessor) + offset(&d["bufferViews"][index(&accessor["bufferView"])]);
        self.buffer[at..at + 4].copy_from_slice(&f32::NAN.to_le_bytes());
    }

    /// Writes `<stem>.gltf`, and `<stem>.bin`, to which it refers, into `folder`.
    ///
    /// # Panics
    /// When the folder cannot be written.
    pub fn write(&self, folder: &Path, stem: &str) {
        let mut document = self.document.clone();
        document["buffers"] =
            json!([{"byteLength": self.buffer.len(), "uri": format!("{stem}.bin")}]);
        let write = |name: String, bytes: &[u8]| {
            fs::write(folder.join(name), bytes).expect("the test's folder is writable");
        };
        write(format!("{stem}.gltf"), document.to_string().as_bytes());
        write(format!("{stem}.bin"), &self.buffer);
    }
}
