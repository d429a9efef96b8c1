//! Decodes `KHR_draco_mesh_compression` by the crate `draco-core`, within limits.

use draco_core::{DataType, DecodeLimits, DecoderBuffer, Mesh, MeshDecoder};

/// The greatest number of vertices, and of triangles, of one compressed mesh.
const MAX_POINTS: u64 = 1 << 25;

/// A decoded mesh.
pub(super) struct Decoded {
    mesh: Mesh,
    /// The number of vertices.
    pub(super) points: usize,
}

/// The values of an attribute, vertex by vertex.
pub(super) struct Values {
    /// The number of numbers of each vertex.
    pub(super) each: usize,
    pub(super) numbers: Vec<f32>,
}

/// Decodes a mesh of at most `bytes` decoded bytes.
///
/// # Errors
/// Damaged data, or too much of it.
pub(super) fn decode(data: &[u8], bytes: usize) -> Result<Decoded, String> {
    let limits = DecodeLimits::default()
        .with_max_points(MAX_POINTS)
        .with_max_faces(MAX_POINTS)
        .with_max_decoded_bytes(bytes as u64 / 2);
    let mut buffer = DecoderBuffer::new(data).with_limits(limits);
    let mut mesh = Mesh::new();
    MeshDecoder::new()
        .decode(&mut buffer, &mut mesh)
        .map_err(|e| {
            format!("the compressed data cannot be decoded ({e}); `gltf-transform copy IN OUT` writes the file without compression")
        })?;
    let points = mesh.num_points();
    Ok(Decoded { mesh, points })
}

impl Decoded {
    /// Returns the values of the attribute with this id. Integers that are `normalized` become
    /// numbers up to 1.
    pub(super) fn attribute(&self, id: u32, normalized: bool) -> Option<Values> {
        let attribute = self.mesh.attribute_by_unique_id(id)?;
        let each = usize::from(attribute.num_components());
        let mut numbers = attribute.read_f32s(self.points, each);
        let most = match attribute.data_type() {
            DataType::Int8 => 127.0,
            DataType::Uint8 => 255.0,
            DataType::Int16 => 32767.0,
            DataType::Uint16 => 65535.0,
            _ => 1.0,
        };
        if normalized && most > 1.0 {
            numbers.iter_mut().for_each(|x| *x = (*x / most).max(-1.0));
        }
        Some(Values { each, numbers })
    }

    /// Returns the corners of all triangles.
    pub(super) fn corners(&self) -> impl Iterator<Item = u32> {
        self.mesh.faces().iter().flatten().map(|point| point.0)
    }
}
