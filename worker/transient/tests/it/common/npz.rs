//! A minimal reader of numpy's .npz for the references: little-endian f2, f4 and f8 in C order.

use std::{fs::File, io::Read, path::Path};

/// Reads one array as f32, flattened.
pub fn read(path: &Path, name: &str) -> Vec<f32> {
    let mut zip = zip::ZipArchive::new(File::open(path).unwrap()).unwrap();
    let mut bytes = vec![];
    zip.by_name(&format!("{name}.npy"))
        .unwrap()
        .read_to_end(&mut bytes)
        .unwrap();
    assert_eq!(&bytes[..6], b"\x93NUMPY");
    let length = usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
    let header = std::str::from_utf8(&bytes[10..10 + length]).unwrap();
    assert!(header.contains("'fortran_order': False"));
    let data = &bytes[10 + length..];
    if header.contains("'<f4'") {
        let word = |c: &[u8]| f32::from_le_bytes(c.try_into().unwrap());
        data.chunks(4).map(word).collect()
    } else if header.contains("'<f8'") {
        let word = |c: &[u8]| f64::from_le_bytes(c.try_into().unwrap()) as f32;
        data.chunks(8).map(word).collect()
    } else {
        assert!(header.contains("'<f2'"), "{header}");
        let word = |c: &[u8]| half(u16::from_le_bytes(c.try_into().unwrap()));
        data.chunks(2).map(word).collect()
    }
}

fn half(h: u16) -> f32 {
    let (sign, exponent, fraction) = (h >> 15, i32::from(h >> 10 & 31), f32::from(h & 1023));
    let value = match exponent {
        0 => fraction * libm::exp2f(-24.0),
        31 => f32::INFINITY,
        e => (1.0 + fraction / 1024.0) * libm::exp2f((e - 15) as f32),
    };
    if sign == 1 { -value } else { value }
}
