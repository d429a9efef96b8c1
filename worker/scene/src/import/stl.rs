//! STL meshes, in text and binary. All solids of a file are joined, and equal corners are one
//! vertex.

use std::collections::BTreeMap;

/// The length of a binary file's header, and of a facet.
const HEADER: usize = 84;
const FACET: usize = 50;
/// The greatest number of facets.
const MAX_FACETS: usize = 50_000_000;

/// The content of an STL file.
#[derive(Debug, Default)]
pub(super) struct Solid {
    pub(super) positions: Vec<[f64; 3]>,
    pub(super) triangles: Vec<[u32; 3]>,
    known: BTreeMap<[u32; 3], u32>,
}

/// Returns whether a file has the structure of STL: a binary file has exactly the length that its
/// number of facets implies, and text starts with `solid` and contains a facet.
pub(super) fn is_stl(bytes: &[u8]) -> bool {
    is_binary(bytes) || is_text(bytes)
}

fn is_text(bytes: &[u8]) -> bool {
    let start = &bytes[..bytes.len().min(4096)];
    let facet = start.windows(5).any(|w| w == b"facet");
    bytes.trim_ascii_start().starts_with(b"solid") && facet
}

fn is_binary(bytes: &[u8]) -> bool {
    let count = bytes.get(80..HEADER).map(|b| [b[0], b[1], b[2], b[3]]);
    let facets = count.map_or(0, |b| u32::from_le_bytes(b) as usize);
    facets > 0
        && facets
            .checked_mul(FACET)
            .and_then(|n| n.checked_add(HEADER))
            == Some(bytes.len())
}

/// Parses a whole file. The message quotes nothing, because the file may have another format.
pub(super) fn parse(bytes: &[u8]) -> Result<Solid, String> {
    let mut solid = Solid::default();
    match is_binary(bytes) {
        true => binary(bytes, &mut solid)?,
        false => text(bytes, &mut solid)?,
    }
    match solid.triangles.is_empty() {
        true => Err("has no facets; export a mesh with facets".into()),
        false => Ok(solid),
    }
}

fn binary(bytes: &[u8], solid: &mut Solid) -> Result<(), String> {
    for (k, facet) in bytes[HEADER..].chunks_exact(FACET).enumerate() {
        let number = |n: usize| {
            let b = &facet[12 + 4 * n..][..4];
            f32::from_le_bytes([b[0], b[1], b[2], b[3]])
        };
        let corner = |c: usize| [number(3 * c), number(3 * c + 1), number(3 * c + 2)];
        solid
            .add([corner(0), corner(1), corner(2)])
            .map_err(|what| format!("facet {}: {what}", k + 1))?;
    }
    Ok(())
}

fn text(bytes: &[u8], solid: &mut Solid) -> Result<(), String> {
    let mut corners: Vec<[f32; 3]> = Vec::new();
    for (k, line) in bytes.split(|b| matches!(b, b'\n' | b'\r')).enumerate() {
        let mut words = line
            .split(u8::is_ascii_whitespace)
            .filter(|w| !w.is_empty());
        let fail = |what: &str| Err(format!("line {}: {what}", k + 1));
        match words.next() {
            Some(b"vertex") => {
                let numbers: Option<Vec<f32>> = words
                    .map(|w| std::str::from_utf8(w).ok()?.parse().ok())
                    .collect();
                match numbers.as_deref() {
                    Some([x, y, z]) => corners.push([*x, *y, *z]),
                    _ => return fail("vertex: expected three numbers"),
                }
            }
            Some(b"endfacet") => {
                let [a, b, c] = corners[..] else {
                    return fail("facet: expected three vertices");
                };
                if let Err(what) = solid.add([a, b, c]) {
                    return fail(&what);
                }
                corners.clear();
            }
            None | Some(b"solid" | b"facet" | b"outer" | b"endloop" | b"endsolid" | b"color") => {}
            Some(_) => return fail("is no statement of STL, such as facet or vertex"),
        }
    }
    match corners.is_empty() {
        true => Ok(()),
        false => Err("ends within a facet; copy it again".into()),
    }
}

impl Solid {
    fn add(&mut self, corners: [[f32; 3]; 3]) -> Result<(), String> {
        if self.triangles.len() >= MAX_FACETS {
            return Err(format!("more than {MAX_FACETS} facets; split the mesh"));
        }
        let mut triangle = [0; 3];
        for (slot, corner) in triangle.iter_mut().zip(corners) {
            if !corner.iter().all(|x| x.is_finite()) {
                return Err("a vertex is not finite; repair the mesh".into());
            }
            // −0 equals 0.
            let key = corner.map(|x| (x + 0.0).to_bits());
            let next = self.positions.len() as u32;
            *slot = *self.known.entry(key).or_insert(next);
            if *slot == next {
                self.positions.push(corner.map(f64::from));
            }
        }
        self.triangles.push(triangle);
        Ok(())
    }
}
