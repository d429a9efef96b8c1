//! Mitsuba's `.serialized` files: several meshes, each compressed by zlib (Mitsuba 0.6
//! documentation, section 8.2.4).

use std::io::Read;

use flate2::read::ZlibDecoder;

use crate::import::far;

use super::shape::Geometry;

const MAGIC: u16 = 0x041c;
const HAS_NORMALS: u32 = 0x0001;
const HAS_UV: u32 = 0x0002;
const HAS_COLOURS: u32 = 0x0008;
const DOUBLE: u32 = 0x2000;
/// The greatest number of vertices and of triangles of a mesh.
const MAX_COUNT: u64 = 50_000_000;
/// A mesh of more bytes than this must not be more than this many times as large as its compressed
/// form: the coordinates of a real mesh never compress so well.
const LARGE: u64 = 64 << 20;
const MAX_RATIO: u64 = 100;
/// The longest name of a mesh, bytes.
const MAX_NAME: usize = 4096;

/// Reads the mesh of an index (from 0).
pub(super) fn read(bytes: &[u8], index: usize) -> Result<Geometry, String> {
    let version = header(bytes, 0)?;
    let count = tail(bytes, 4).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]))?;
    if index >= count as usize {
        return Err(format!("shape_index: {index}; the file has {count} meshes"));
    }
    // The positions of the meshes stand before their number.
    let width = if version == 4 { 8 } else { 4 };
    let table = tail(
        bytes,
        (count as usize).saturating_mul(width).saturating_add(4),
    )?;
    let entry = &table[index * width..][..width];
    let start = entry.iter().rev().fold(0u64, |n, b| n << 8 | u64::from(*b));
    let start = usize::try_from(start).unwrap_or(usize::MAX);
    header(bytes, start)?;
    mesh(&bytes[start + 4..], version)
}

/// Checks the header at a position and returns its version.
fn header(bytes: &[u8], start: usize) -> Result<u16, String> {
    let header = bytes.get(start..).and_then(|b| b.get(..4));
    let Some(&[a, b, c, d]) = header else {
        return Err("ends within a header; copy it again".into());
    };
    let version = u16::from_le_bytes([c, d]);
    match u16::from_le_bytes([a, b]) == MAGIC && matches!(version, 3 | 4) {
        true => Ok(version),
        false => Err("is not a serialized mesh of version 3 or 4".into()),
    }
}

fn tail(bytes: &[u8], length: usize) -> Result<&[u8], String> {
    let start = bytes.len().checked_sub(length);
    start
        .map(|start| &bytes[start..])
        .ok_or_else(|| "ends within its table of meshes; copy it again".to_owned())
}

fn mesh(compressed: &[u8], version: u16) -> Result<Geometry, String> {
    let mut stream = Stream(ZlibDecoder::new(compressed));
    let flags = stream.u32()?;
    if version == 4 {
        stream.skip_name()?;
    }
    let (vertices, triangles) = (stream.u64()?, stream.u64()?);
    if vertices > MAX_COUNT || triangles > MAX_COUNT {
        return Err(format!("has more than {MAX_COUNT} vertices or triangles"));
    }
    let double = flags & DOUBLE != 0;
    let reals = [(HAS_NORMALS, 3), (HAS_UV, 2), (HAS_COLOURS, 3)].into_iter();
    let reals = 3 + reals
        .map(|(flag, n)| if flags & flag != 0 { n } else { 0 })
        .sum::<u64>();
    let bytes = vertices * reals * if double { 8 } else { 4 } + triangles * 12;
    if bytes > LARGE && bytes > MAX_RATIO * compressed.len() as u64 {
        return Err(format!(
            "says that it has {vertices} vertices and {triangles} triangles, which {} bytes cannot contain; export the \
             mesh again",
            compressed.len()
        ));
    }
    let mut positions = Vec::new();
    for _ in 0..vertices {
        positions.push([
            stream.real(double)?,
            stream.real(double)?,
            stream.real(double)?,
        ]);
    }
    if flags & HAS_NORMALS != 0 {
        stream.skip(vertices * 3, double)?;
    }
    let mut uv = Vec::new();
    if flags & HAS_UV != 0 {
        for _ in 0..vertices {
            uv.push([stream.real(double)? as f32, stream.real(double)? as f32]);
        }
    }
    if flags & HAS_COLOURS != 0 {
        stream.skip(vertices * 3, double)?;
    }
    let mut faces = Vec::new();
    for _ in 0..triangles {
        let face = [stream.u32()?, stream.u32()?, stream.u32()?];
        if let Some(wrong) = face.iter().find(|v| u64::from(**v) >= vertices) {
            return Err(format!("index {wrong} points past {vertices} vertices"));
        }
        faces.push(face);
    }
    let (positions, origin) = far::local(&positions);
    Ok(Geometry {
        positions,
        uv,
        triangles: faces,
        origin,
        ..Geometry::default()
    })
}

struct Stream<'a>(ZlibDecoder<&'a [u8]>);

impl Stream<'_> {
    fn take<const N: usize>(&mut self) -> Result<[u8; N], String> {
        let mut bytes = [0; N];
        match self.0.read_exact(&mut bytes) {
            Ok(()) => Ok(bytes),
            Err(e) => Err(format!("ends within a mesh ({e}); copy it again")),
        }
    }

    fn u32(&mut self) -> Result<u32, String> {
        self.take().map(u32::from_le_bytes)
    }

    fn u64(&mut self) -> Result<u64, String> {
        self.take().map(u64::from_le_bytes)
    }

    fn real(&mut self, double: bool) -> Result<f64, String> {
        let x = match double {
            true => f64::from_le_bytes(self.take()?),
            false => f64::from(f32::from_le_bytes(self.take()?)),
        };
        match (x as f32).is_finite() {
            true => Ok(x),
            false => Err("a coordinate is not finite; export the mesh again".into()),
        }
    }

    fn skip(&mut self, count: u64, double: bool) -> Result<(), String> {
        for _ in 0..count {
            match double {
                true => self.take::<8>().map(|_| ())?,
                false => self.take::<4>().map(|_| ())?,
            }
        }
        Ok(())
    }

    fn skip_name(&mut self) -> Result<(), String> {
        for _ in 0..=MAX_NAME {
            if self.take::<1>()? == [0] {
                return Ok(());
            }
        }
        Err(format!("a name is longer than {MAX_NAME} bytes"))
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::*;

    /// Returns a file whose only mesh says that it has this many vertices, all at the origin.
    fn zeros(vertices: u64, written: usize) -> Vec<u8> {
        let mut bytes = vec![0x1c, 0x04, 4, 0];
        let mut encoder = flate2::write::ZlibEncoder::new(&mut bytes, flate2::Compression::best());
        encoder.write_all(&0x1000u32.to_le_bytes()).unwrap();
        encoder.write_all(b"\0").unwrap();
        encoder.write_all(&vertices.to_le_bytes()).unwrap();
        encoder.write_all(&1u64.to_le_bytes()).unwrap();
        encoder.write_all(&vec![0; written]).unwrap();
        encoder.finish().unwrap();
        bytes.extend(0u64.to_le_bytes());
        bytes.extend(1u32.to_le_bytes());
        bytes
    }

    #[test]
    fn a_small_file_of_very_many_vertices_is_refused_before_they_are_read() {
        let refused = |n| {
            read(&zeros(n, 12 << 20), 0)
                .map(|_| ())
                .expect_err("too many")
        };
        let said = refused(49_000_000);
        assert!(said.contains("49000000 vertices"), "{said}");
        let said = refused(200_000_000);
        assert!(said.contains("more than 50000000"), "{said}");
        let said = refused(u64::MAX);
        assert!(said.contains("more than 50000000"), "{said}");
        // A mesh that is large for its file but small in itself is read.
        assert!(read(&zeros(1 << 20, (12 << 20) + 12), 0).is_ok());
    }
}
