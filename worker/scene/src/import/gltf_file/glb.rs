//! The container of binary glTF.

const MAGIC: &[u8] = b"glTF";

/// The chunks of a file.
pub(super) struct Chunks<'a> {
    pub(super) json: &'a [u8],
    pub(super) bin: Option<&'a [u8]>,
}

/// Splits `.glb` bytes into their chunks. Bytes without its magic are the JSON of `.gltf`. Chunks
/// of other kinds, and bytes after the stated length, are ignored, as the format demands.
///
/// # Errors
/// The fault of the container.
pub(super) fn split(bytes: &[u8]) -> Result<Chunks<'_>, String> {
    let Some(header) = bytes.strip_prefix(MAGIC) else {
        return Ok(Chunks {
            json: bytes,
            bin: None,
        });
    };
    let (version, header) = number(header).ok_or("the header is cut short")?;
    let (length, _) = number(header).ok_or("the header is cut short")?;
    if version != 2 {
        return Err(format!("the container has version {version}, expected 2"));
    }
    let length = (length as usize).min(bytes.len());
    let mut rest = bytes.get(12..length).unwrap_or_default();
    let mut chunks: Vec<([u8; 4], &[u8])> = Vec::new();
    while let Some((kind, chunk, after)) = chunk(rest)? {
        // Only the first two chunks have a meaning.
        chunks.push((kind, chunk));
        rest = if chunks.len() == 2 { &[] } else { after };
    }
    match chunks[..] {
        [(kind, json), ref others @ ..] if &kind == b"JSON" => {
            let bin = others.first().filter(|(kind, _)| kind == b"BIN\0");
            // Some programs pad with zeros.
            let end = json.iter().rposition(|b| *b != 0).map_or(0, |k| k + 1);
            Ok(Chunks {
                json: &json[..end],
                bin: bin.map(|(_, bytes)| *bytes),
            })
        }
        _ => Err("the first chunk is not JSON".into()),
    }
}

/// The kind and the bytes of a chunk, and what follows.
type Chunk<'a> = ([u8; 4], &'a [u8], &'a [u8]);

/// Returns the first chunk, or `None` after the last.
fn chunk(bytes: &[u8]) -> Result<Option<Chunk<'_>>, String> {
    let Some((length, rest)) = number(bytes) else {
        return Ok(None);
    };
    let Some((kind, rest)) = rest.split_first_chunk::<4>() else {
        return Ok(None);
    };
    match rest.split_at_checked(length as usize) {
        Some((chunk, after)) => Ok(Some((*kind, chunk, after))),
        None => Err(format!(
            "a chunk of {length} bytes is cut short after {}",
            rest.len()
        )),
    }
}

/// Returns the first number and what follows.
fn number(bytes: &[u8]) -> Option<(u32, &[u8])> {
    let (number, rest) = bytes.split_first_chunk::<4>()?;
    Some((u32::from_le_bytes(*number), rest))
}

#[cfg(test)]
mod tests {
    use super::split;

    fn file(length: u32, chunks: &[(&[u8; 4], &[u8])]) -> Vec<u8> {
        let mut bytes = b"glTF\x02\0\0\0".to_vec();
        bytes.extend(length.to_le_bytes());
        for (kind, chunk) in chunks {
            bytes.extend((chunk.len() as u32).to_le_bytes());
            bytes.extend(*kind);
            bytes.extend(*chunk);
        }
        bytes
    }

    #[test]
    fn other_chunks_and_bytes_after_the_end_are_ignored() {
        let more: [(&[u8; 4], &[u8]); 3] =
            [(b"JSON", b"{}\0\0"), (b"BIN\0", b"1234"), (b"MORE", b"x")];
        for (length, bin) in [(47, true), (36, true), (24, false)] {
            let bytes = file(length, &more);
            let found = split(&bytes).expect("splits");
            assert_eq!(found.json, b"{}");
            assert_eq!(found.bin.is_some(), bin, "{length}");
        }
        let bytes = file(99, &[(b"JSON", b"{}"), (b"MORE", b"x"), (b"BIN\0", b"1")]);
        assert!(split(&bytes).expect("splits").bin.is_none());
    }

    #[test]
    fn damage_is_named() {
        let cut = file(99, &[(b"JSON", b"{}"), (b"BIN\0", b"1234")]);
        for (bytes, expected) in [
            (&b"glTF\x02\0\0\0"[..], "header is cut short"),
            (b"glTF\0\0\0\0\0\0\0\0", "version 0"),
            (&file(0, &[]), "not JSON"),
            (&file(99, &[(b"BIN\0", b"1234")]), "not JSON"),
            (&cut[..cut.len() - 1], "4 bytes is cut short after 3"),
        ] {
            let error = split(bytes).err().expect(expected);
            assert!(error.contains(expected), "{error}");
        }
    }
}
