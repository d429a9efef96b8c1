//! Reads packed data within a size limit. Sizes in headers are not trusted for allocation.

use std::io::{Error, Read};

/// Maximum number of bytes allocated before the first read, whatever size is announced.
const AT_FIRST: u64 = 1 << 20;

/// Reads `reader` to its end, up to `most` bytes. Memory use grows with the data read and is
/// independent of announced sizes.
///
/// # Errors
/// `InvalidData` if there are more than `most` bytes; any error of the reader.
pub fn read_bounded(reader: impl Read, most: u64) -> Result<Vec<u8>, Error> {
    let mut out = Vec::new();
    reader.take(most.saturating_add(1)).read_to_end(&mut out)?;
    if out.len() as u64 > most {
        return Err(Error::new(
            std::io::ErrorKind::InvalidData,
            format!("holds more than the {most} bytes that it may"),
        ));
    }
    Ok(out)
}

/// Like [`read_bounded`], for an entry with an announced size. An announcement above the limit is
/// refused before anything is read, and so is content with another size than announced.
///
/// # Errors
/// Those of [`read_bounded`]; a size other than the announced one.
pub fn read_entry(reader: impl Read, announced: u64, most: u64) -> Result<Vec<u8>, Error> {
    let refused = |what: String| Err(Error::new(std::io::ErrorKind::InvalidData, what));
    if announced > most {
        return refused(format!(
            "announces {announced} bytes, more than the {most} that it may hold"
        ));
    }
    let mut out = Vec::with_capacity(announced.min(AT_FIRST) as usize);
    reader
        .take(announced.saturating_add(1))
        .read_to_end(&mut out)?;
    if out.len() as u64 != announced {
        return refused(format!(
            "announces {announced} bytes and holds {}",
            match out.len() as u64 > announced {
                true => "more".to_owned(),
                false => out.len().to_string(),
            }
        ));
    }
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_endless_stream_ends_at_its_bound() {
        assert_eq!(read_bounded(&b"abc"[..], 3).unwrap(), b"abc");
        assert!(read_bounded(std::io::repeat(0), 1000).is_err());
        assert_eq!(read_entry(&b"abc"[..], 3, 10).unwrap(), b"abc");
        for (announced, most) in [(1 << 60, 1000), (2, 1000), (4, 1000)] {
            assert!(read_entry(&b"abc"[..], announced, most).is_err());
        }
        assert!(read_entry(std::io::repeat(0), 100, 1000).is_err());
    }
}
