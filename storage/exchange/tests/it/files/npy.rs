//! Writes `.npy` files, without the code under test.

pub fn npy<T: bytemuck::Pod>(descr: &str, shape: &[usize], values: &[T]) -> Vec<u8> {
    let shape: Vec<String> = shape.iter().map(|s| format!("{s},")).collect();
    let header = format!(
        "{{'descr': '{descr}', 'fortran_order': False, 'shape': ({}), }}\n",
        shape.join(" ")
    );
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((header.len() as u16).to_le_bytes());
    bytes.extend(header.as_bytes());
    bytes.extend(bytemuck::cast_slice::<T, u8>(values));
    bytes
}
