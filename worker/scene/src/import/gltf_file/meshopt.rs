//! Decodes `EXT_meshopt_compression` and `KHR_meshopt_compression`: vertices, triangles, indices
//! and the filters of vertices.
//!
//! After the decoders of meshoptimizer 1.0 (Kapoulkine 2016-2026, MIT) and the extensions'
//! appendices. Every read is checked, and the output's size is that which the caller states.

/// The number of values in a group of bytes.
const GROUP: usize = 16;
/// The size of a block of vertices, bytes, and the greatest number of its vertices.
const BLOCK_BYTES: usize = 8192;
const BLOCK_VERTICES: usize = 256;
/// The greatest number of decoded bytes for a compressed byte: a lane of zeros takes 2 bits for a
/// block of 256 vertices.
pub(super) const MAX_RATIO: usize = 1024;

const CUT: &str = "the compressed data is cut short or damaged";

/// Compressed bytes that are read from the front.
struct Bytes<'a>(&'a [u8]);

impl<'a> Bytes<'a> {
    fn take(&mut self, count: usize) -> Result<&'a [u8], String> {
        let (head, rest) = self.0.split_at_checked(count).ok_or(CUT)?;
        self.0 = rest;
        Ok(head)
    }

    fn byte(&mut self) -> Result<u8, String> {
        Ok(self.take(1)?[0])
    }

    /// Reads up to five groups of seven bits, the lowest first.
    fn varint(&mut self) -> Result<u32, String> {
        let mut value = 0u32;
        for k in 0..5 {
            let byte = self.byte()?;
            value |= u32::from(byte & 127).wrapping_shl(7 * k);
            if byte < 128 {
                break;
            }
        }
        Ok(value)
    }

    /// Reads a difference to `last`, and adds it.
    fn index(&mut self, last: u32) -> Result<u32, String> {
        Ok(last.wrapping_add(unsigned_to_signed(self.varint()?)))
    }

    /// Decodes one group of 16 bytes with `bits` for each, where the greatest value stands for a
    /// byte after the group.
    fn group(&mut self, bits: usize, out: &mut [u8]) -> Result<(), String> {
        if bits == 0 {
            out.fill(0);
            return Ok(());
        }
        if bits == 8 {
            out.copy_from_slice(self.take(GROUP)?);
            return Ok(());
        }
        let packed = self.take(GROUP * bits / 8)?;
        let escape = (1u8 << bits) - 1;
        let each = 8 / bits;
        for (k, value) in out.iter_mut().enumerate() {
            let place = match bits {
                // Single bits are stored in the opposite order.
                1 => k % each,
                _ => each - 1 - k % each,
            };
            let small = packed[k / each] >> (place * bits) & escape;
            *value = match small == escape {
                true => self.byte()?,
                false => small,
            };
        }
        Ok(())
    }

    /// Decodes groups of bytes. A header states the bits of each group as an index of `bits`.
    fn groups(&mut self, bits: &[usize], out: &mut [u8]) -> Result<(), String> {
        let groups = out.len() / GROUP;
        let header = self.take(groups.div_ceil(4))?;
        for (k, group) in out.chunks_exact_mut(GROUP).enumerate() {
            let choice = header[k / 4] >> (k % 4 * 2) & 3;
            self.group(bits[usize::from(choice)], group)?;
        }
        Ok(())
    }
}

/// Maps 0, 1, 2, 3, … to 0, −1, 1, −2, …
fn unsigned_to_signed(v: u32) -> u32 {
    (v >> 1) ^ (v & 1).wrapping_neg()
}

/// Decodes `count` vertices of `size` bytes.
///
/// # Errors
/// Damaged data.
pub(super) fn vertices(data: &[u8], count: usize, size: usize) -> Result<Vec<u8>, String> {
    let mut data = Bytes(data);
    let version = match data.byte()? {
        0xa0 => 0,
        0xa1 => 1,
        other => {
            return Err(format!(
                "expected vertices of version 0 or 1, found {other:#04x}"
            ));
        }
    };
    let channels = if version == 0 { 0 } else { size / 4 };
    let padded = (size + channels).max(if version == 0 { 32 } else { 24 });
    let (mut blocks, tail) = match data.0.len().checked_sub(padded) {
        Some(end) => (Bytes(&data.0[..end]), &data.0[end..]),
        None => return Err(CUT.into()),
    };
    let tail = &tail[padded - size - channels..];
    let (first, channels) = tail.split_at(size);
    let mut last = first.to_vec();
    let most = ((BLOCK_BYTES / size) & !(GROUP - 1)).min(BLOCK_VERTICES);
    let mut out = vec![0; count * size];
    for block in out.chunks_mut(most * size) {
        self::block(&mut blocks, block, &mut last, (version, channels))?;
    }
    match blocks.0.is_empty() {
        true => Ok(out),
        false => Err(CUT.into()),
    }
}

/// Decodes a block of vertices. `last` is the vertex before it, and then its last one.
fn block(
    data: &mut Bytes<'_>,
    out: &mut [u8],
    last: &mut [u8],
    (version, channels): (u8, &[u8]),
) -> Result<(), String> {
    const BITS_0: [usize; 4] = [0, 2, 4, 8];
    const BITS_1: [usize; 5] = [0, 1, 2, 4, 8];
    let size = last.len();
    let count = out.len() / size;
    let control = match version {
        0 => &[][..],
        _ => data.take(size / 4)?,
    };
    let mut lanes = [[0u8; BLOCK_VERTICES]; 4];
    for part in 0..size / 4 {
        let modes = control.get(part).copied().unwrap_or(0);
        for (j, lane) in lanes.iter_mut().enumerate() {
            let aligned = &mut lane[..count.next_multiple_of(GROUP)];
            match modes >> (2 * j) & 3 {
                3 => aligned[..count].copy_from_slice(data.take(count)?),
                2 => aligned.fill(0),
                _ if version == 0 => data.groups(&BITS_0, aligned)?,
                mode => data.groups(&BITS_1[usize::from(mode)..], aligned)?,
            }
        }
        let channel = channels.get(part).copied().unwrap_or(0);
        let before: [u8; 4] = std::array::from_fn(|j| last[4 * part + j]);
        let mut p = u32::from_le_bytes(before);
        for (k, vertex) in out.chunks_exact_mut(size).enumerate() {
            let d = u32::from_le_bytes(std::array::from_fn(|j| lanes[j][k]));
            p = match channel & 3 {
                0 => u32::from_le_bytes(std::array::from_fn(|j| {
                    let d = d.to_le_bytes()[j];
                    let d = (d >> 1) ^ (d & 1).wrapping_neg();
                    d.wrapping_add(p.to_le_bytes()[j])
                })),
                1 => {
                    let half = |shift: u32| {
                        let d = (d >> shift) as u16;
                        let d = (d >> 1) ^ (d & 1).wrapping_neg();
                        u32::from(d.wrapping_add((p >> shift) as u16)) << shift
                    };
                    half(0) | half(16)
                }
                2 => d.rotate_left((32 - u32::from(channel >> 4)) & 31) ^ p,
                _ => return Err(CUT.into()),
            };
            vertex[4 * part..4 * part + 4].copy_from_slice(&p.to_le_bytes());
        }
    }
    let end = out.len() - size;
    last.copy_from_slice(&out[end..]);
    Ok(())
}

/// The 16 most recent values.
struct Recent<T> {
    values: [T; 16],
    next: usize,
}

impl<T: Copy> Recent<T> {
    fn push(&mut self, value: T) {
        self.values[self.next] = value;
        self.next = (self.next + 1) % 16;
    }

    /// Returns the value that was pushed `ago` pushes before the last one.
    fn before(&self, ago: u8) -> T {
        self.values[self.next.wrapping_sub(1 + usize::from(ago)) & 15]
    }
}

/// Decodes the corners of triangles.
///
/// # Errors
/// Damaged data.
pub(super) fn triangles(data: &[u8], count: usize) -> Result<Vec<u32>, String> {
    let mut data = Bytes(data);
    let most_recent: u8 = match data.byte()? {
        0xe0 => 15,
        0xe1 => 13,
        other => {
            return Err(format!(
                "expected triangles of version 0 or 1, found {other:#04x}"
            ));
        }
    };
    let codes = data.take(count / 3)?;
    let Some(end) = data.0.len().checked_sub(16) else {
        return Err(CUT.into());
    };
    let table = &data.0[end..];
    let mut edges = Recent {
        values: [[u32::MAX; 2]; 16],
        next: 0,
    };
    let mut recent = Recent {
        values: [u32::MAX; 16],
        next: 0,
    };
    let (mut next, mut last) = (0u32, 0u32);
    let mut out = Vec::with_capacity(codes.len() * 3);
    // Indices of up to five bytes may reach into the table, as in the encoder.
    for &code in codes {
        if code < 0xf0 {
            let [a, b] = edges.before(code >> 4);
            let third = code & 15;
            let c = if third == 0 {
                next = next.wrapping_add(1);
                next.wrapping_sub(1)
            } else if third < most_recent {
                recent.before(third)
            } else {
                last = match third {
                    15 => data.index(last)?,
                    // 13 and 14 stand for −1 and 1.
                    _ => last.wrapping_add(u32::from(third) * 2).wrapping_sub(27),
                };
                last
            };
            if third == 0 || third >= most_recent {
                recent.push(c);
            }
            edges.push([c, b]);
            edges.push([a, c]);
            out.extend([a, b, c]);
            continue;
        }
        let (first, aux) = match code {
            0xf0..0xfe => (0, table[usize::from(code & 15)]),
            _ => {
                let aux = data.byte()?;
                if aux == 0 {
                    next = 0;
                }
                (if code == 0xfe { 0 } else { 15 }, aux)
            }
        };
        // All fresh vertices are counted, and all recent ones looked up, before the free indices.
        let mut pick = |choice: u8| match choice {
            0 => {
                next = next.wrapping_add(1);
                next.wrapping_sub(1)
            }
            ago => recent.before(ago.wrapping_sub(1)),
        };
        let choices = [first, aux >> 4, aux & 15];
        let mut corners = choices.map(&mut pick);
        let free = |k: usize| choices[k] == 15 && code >= 0xfe;
        for (k, corner) in corners.iter_mut().enumerate() {
            if free(k) {
                last = data.index(last)?;
                *corner = last;
            }
        }
        for (k, corner) in corners.into_iter().enumerate() {
            if choices[k] == 0 || free(k) {
                recent.push(corner);
            }
        }
        let [a, b, c] = corners;
        edges.push([b, a]);
        edges.push([c, b]);
        edges.push([a, c]);
        out.extend(corners);
    }
    match data.0.len() {
        16 => Ok(out),
        _ => Err(CUT.into()),
    }
}

/// Decodes a sequence of indices.
///
/// # Errors
/// Damaged data.
pub(super) fn indices(data: &[u8], count: usize) -> Result<Vec<u32>, String> {
    let mut data = Bytes(data);
    match data.byte()? {
        0xd0 | 0xd1 => {}
        other => {
            return Err(format!(
                "expected indices of version 0 or 1, found {other:#04x}"
            ));
        }
    }
    if count > data.0.len() {
        return Err(CUT.into());
    }
    let mut last = [0u32; 2];
    let mut out = Vec::with_capacity(count);
    for _ in 0..count {
        let v = data.varint()?;
        let base = &mut last[(v & 1) as usize];
        *base = base.wrapping_add(unsigned_to_signed(v >> 1));
        out.push(*base);
    }
    match data.0.len() {
        4 => Ok(out),
        _ => Err(CUT.into()),
    }
}

/// Rounds to the nearest whole number, halves away from zero.
fn rounded(x: f32) -> i32 {
    (x + if x >= 0.0 { 0.5 } else { -0.5 }) as i32
}

/// Undoes the filter of unit vectors, which stores them on an octahedron, in vertices of 4 or 8
/// bytes.
pub(super) fn octahedral(data: &mut [u8], size: usize) {
    let decode = |v: [i32; 4], most: f32| {
        let (mut x, mut y) = (v[0] as f32, v[1] as f32);
        let z = v[2] as f32 - x.abs() - y.abs();
        let t = z.min(0.0);
        x += if x >= 0.0 { t } else { -t };
        y += if y >= 0.0 { t } else { -t };
        let s = most / (x * x + y * y + z * z).sqrt();
        [rounded(x * s), rounded(y * s), rounded(z * s), v[3]]
    };
    match size {
        4 => data.as_chunks_mut::<4>().0.iter_mut().for_each(|v| {
            *v = decode(v.map(|x| i32::from(x as i8)), 127.0).map(|x| x as u8);
        }),
        _ => words(data, |v| {
            decode(v.map(i32::from), 32767.0).map(|x| x as i16)
        }),
    }
}

/// Undoes the filter of unit quaternions in vertices of 8 bytes.
pub(super) fn quaternions(data: &mut [u8]) {
    let most = 32767.0 / 2f32.sqrt();
    words(data, |v| {
        let s = f32::from(v[3] | 3);
        let [x, y, z] = [v[0], v[1], v[2]].map(f32::from);
        let w = (s * s * 2.0 - x * x - y * y - z * z).max(0.0).sqrt();
        let scale = most / s;
        let first = (v[3] & 3) as usize;
        let mut out = [0i16; 4];
        for (k, c) in [w, x, y, z].into_iter().enumerate() {
            out[(first + k) & 3] = rounded(c * scale) as i16;
        }
        out
    });
}

/// Changes vertices of four 16-bit words.
fn words(data: &mut [u8], change: impl Fn([i16; 4]) -> [i16; 4]) {
    for v in data.as_chunks_mut::<8>().0 {
        let old = std::array::from_fn(|k| i16::from_le_bytes([v[2 * k], v[2 * k + 1]]));
        for (pair, new) in v.as_chunks_mut::<2>().0.iter_mut().zip(change(old)) {
            *pair = new.to_le_bytes();
        }
    }
}

/// Undoes the filter of floats, which stores 24 bits of mantissa and 8 of exponent.
pub(super) fn exponential(data: &mut [u8]) {
    for v in data.as_chunks_mut::<4>().0 {
        let bits = i32::from_le_bytes(*v);
        let (mantissa, exponent) = ((bits << 8) >> 8, bits >> 24);
        let power = f32::from_bits(((exponent + 127) as u32) << 23);
        *v = (power * mantissa as f32).to_le_bytes();
    }
}

#[cfg(test)]
#[path = "meshopt_tests.rs"]
mod tests;
