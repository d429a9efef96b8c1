//! Scene files for corruption tests: a generated `.glb` split into `.gltf` and `.bin`.

use std::{fs, path::Path};

use serde_json::{Value, json};

/// The two parts of a `.glb` file.
pub struct Parts {
    /// The JSON document.
    pub document: Value,
    /// The binary buffer.
    pub buffer: Vec<u8>,
}

impl Parts {
    /// Splits a `.glb` file.
    ///
    /// # Panics
    /// If it is not a `.glb` file.
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

    /// Sets the first vertex of the first mesh to NaN.
    ///
    /// # Panics
    /// If there is no mesh.
    pub fn spoil_vertex(&mut self) {
        let index = |v: &Value| v.as_u64().expect("an index") as usize;
        let offset = |v: &Value| v["byteOffset"].as_u64().unwrap_or(0) as usize;
        let d = &self.document;
        let accessor =
            &d["accessors"][index(&d["meshes"][0]["primitives"][0]["attributes"]["POSITION"])];
        let at = offset(accessor) + offset(&d["bufferViews"][index(&accessor["bufferView"])]);
        self.buffer[at..at + 4].copy_from_slice(&f32::NAN.to_le_bytes());
    }

    /// Writes `<stem>.gltf` and the `<stem>.bin` to which it refers into `folder`.
    ///
    /// # Panics
    /// If the folder cannot be written.
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
