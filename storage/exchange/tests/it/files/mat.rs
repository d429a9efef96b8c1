//! Writes MATLAB files of version 5.

/// Encodes an element of a version 5 file.
fn element(kind: u32, data: &[u8]) -> Vec<u8> {
    let mut bytes = kind.to_le_bytes().to_vec();
    bytes.extend((data.len() as u32).to_le_bytes());
    bytes.extend(data);
    bytes.resize(bytes.len().next_multiple_of(8), 0);
    bytes
}

/// Encodes a matrix of doubles, or of bytes stored for doubles as MATLAB does for small whole
/// numbers.
pub fn matrix(name: &str, dims: [i32; 2], values: &[f64]) -> Vec<u8> {
    let small = values
        .iter()
        .all(|x| (0.0..256.0).contains(x) && x.fract() == 0.0);
    let mut parts = element(6, bytemuck::cast_slice(&[6u32, 0]));
    parts.extend(element(5, bytemuck::cast_slice(&dims)));
    match name.len() {
        n @ 1..=4 => {
            parts.extend((1 | (n as u32) << 16).to_le_bytes());
            parts.extend(name.bytes());
            parts.resize(parts.len().next_multiple_of(8), 0);
        }
        _ => parts.extend(element(1, name.as_bytes())),
    }
    parts.extend(match small {
        true => element(2, &values.iter().map(|x| *x as u8).collect::<Vec<_>>()),
        false => element(9, bytemuck::cast_slice(values)),
    });
    element(14, &parts)
}

/// Encodes a file of these arrays.
pub fn version_5(arrays: &[Vec<u8>]) -> Vec<u8> {
    let mut bytes = b"MATLAB 5.0 MAT-file, made by a test".to_vec();
    bytes.resize(124, b' ');
    bytes.extend(0x0100u16.to_le_bytes());
    bytes.extend(b"IM");
    bytes.extend(arrays.concat());
    bytes
}
