//! The fingerprint of a scene file, over its own bytes and those of the buffer files that it refers
//! to.

use std::path::Path;

use sha2::{Digest, Sha256};

use super::{Bounds, buffers::buffer_file, gltf_file, is_xml, mesh_file, mitsuba, read_file};
use crate::SceneError;

/// Returns the SHA-256 of a scene's content, hexadecimal. For a file without external buffers
/// (every `.glb` and reference scene of ours) it is the file's own SHA-256. Each external buffer of
/// a glTF file adds its URI, its length and its bytes.
///
/// # Errors
/// [`SceneError::Read`] for the file or a buffer that cannot be read, [`SceneError::Refused`] for
/// one outside `bounds`.
pub fn fingerprint(path: &Path, bounds: &Bounds) -> Result<String, SceneError> {
    let bytes = read_file(&bounds.files, path)?;
    let files = &bounds.of_scene(path);
    let mut hash = Sha256::new_with_prefix(&bytes);
    if is_xml(&bytes) || bytes.trim_ascii_start().first() == Some(&b'{') {
        for external in mitsuba::files(path, &bytes, files)? {
            let data = read_file(files, &external)?;
            hash.update(external.file_name().unwrap_or_default().as_encoded_bytes());
            hash.update((data.len() as u64).to_le_bytes());
            hash.update(&data);
        }
    }
    if mesh_file::is_obj(path, &bytes) {
        for external in mesh_file::files(path, &bytes, files) {
            let data = read_file(files, &external)?;
            hash.update(external.file_name().unwrap_or_default().as_encoded_bytes());
            hash.update((data.len() as u64).to_le_bytes());
            hash.update(&data);
        }
    }
    // Other files, including unreadable ones, are hashed on their own.
    if let Ok(file) = gltf_file::document::parse(&bytes) {
        let json = &file.root;
        let buffers = json.buffers.iter().filter_map(|b| b.uri.as_deref());
        let images = json.images.iter().filter_map(|i| i.uri.as_deref());
        for uri in buffers.chain(images) {
            if let Some(external) = buffer_file(path, uri)? {
                let data = read_file(files, &external)?;
                hash.update(uri.as_bytes());
                hash.update((data.len() as u64).to_le_bytes());
                hash.update(&data);
            }
        }
    }
    Ok(hex::encode(hash.finalize()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_external_buffer_is_part_of_the_fingerprint() {
        let dir = tempfile::tempdir().unwrap();
        let scene = dir.path().join("a.gltf");
        let document = r#"{"asset":{"version":"2.0"},"buffers":[{"uri":"a.bin","byteLength":3}]}"#;
        std::fs::write(&scene, document).unwrap();
        let missing = fingerprint(&scene, &Bounds::default())
            .unwrap_err()
            .to_string();
        assert!(missing.contains("a.bin"), "{missing}");
        std::fs::write(dir.path().join("a.bin"), b"abc").unwrap();
        let before = fingerprint(&scene, &Bounds::default()).unwrap();
        std::fs::write(dir.path().join("a.bin"), b"abd").unwrap();
        assert_ne!(before, fingerprint(&scene, &Bounds::default()).unwrap());
    }

    #[test]
    fn a_file_that_stands_alone_has_its_own_sha256() {
        let dir = tempfile::tempdir().unwrap();
        let scene = dir.path().join("a.gltf");
        let document = br#"{"asset":{"version":"2.0"},"buffers":[]}"#;
        std::fs::write(&scene, document).unwrap();
        assert_eq!(
            fingerprint(&scene, &Bounds::default()).unwrap(),
            hex::encode(Sha256::digest(document))
        );
    }
}
