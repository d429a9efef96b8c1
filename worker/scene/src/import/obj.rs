//! Wavefront OBJ: vertices, texture coordinates, polygons and the names of their materials; normals
//! are not read.

use std::collections::{BTreeMap, btree_map::Entry};

use super::polygon::Triangulation;

/// Statements without geometry.
const SKIPPED: [&[u8]; 17] = [
    b"vn",
    b"vp",
    b"g",
    b"o",
    b"s",
    b"mg",
    b"usemap",
    b"maplib",
    b"lod",
    b"bevel",
    b"c_interp",
    b"d_interp",
    b"shadow_obj",
    b"trace_obj",
    b"l",
    b"p",
    b"vc",
];
/// Free-form curves and surfaces.
const FREE_FORM: [&[u8]; 8] = [
    b"cstype", b"surf", b"curv", b"curv2", b"bzp", b"bsp", b"cdc", b"cdp",
];

/// The content of an OBJ file.
#[derive(Debug, Default)]
pub(super) struct Obj {
    /// The positions as in the file.
    pub(super) positions: Vec<[f64; 3]>,
    /// Texture coordinates, one a vertex, v upwards, or none.
    pub(super) uv: Vec<[f32; 2]>,
    pub(super) triangles: Vec<[u32; 3]>,
    /// The index into `materials` of each triangle.
    pub(super) triangle_material: Vec<u32>,
    /// The names of the materials; the first is that of faces before any `usemtl`.
    pub(super) materials: Vec<String>,
    /// The names of the material files.
    pub(super) libraries: Vec<String>,
    /// The notes on changes and omissions, by key.
    pub(super) notes: BTreeMap<String, String>,
}

/// The greatest number of materials and of material files.
const MAX_MATERIALS: usize = 65_536;

/// The statements of a file.
#[derive(Default)]
struct Statements {
    positions: Vec<[f64; 3]>,
    uv: Vec<[f32; 2]>,
    /// The indices of position and texture coordinates.
    corners: Vec<(usize, Option<usize>)>,
    /// The line, the number of corners and the material of each face.
    faces: Vec<(usize, usize, u32)>,
    /// The materials by name.
    materials: BTreeMap<String, u32>,
    material: u32,
    libraries: Vec<String>,
    lines_and_points: usize,
    /// The number of faces with fewer than three corners.
    degenerate: usize,
}

/// Parses a whole file. The message names the line and quotes nothing, because the file may have
/// another format.
pub(super) fn parse(bytes: &[u8]) -> Result<Obj, String> {
    let mut all = Statements::default();
    let mut lines = Lines {
        rest: bytes,
        number: 0,
    };
    while let Some((number, line)) = lines.next() {
        all.read(number, &line)
            .map_err(|what| format!("line {number}: {what}"))?;
    }
    all.finish()
}

/// Lines with any line ending. A line that ends in a backslash is joined with the next.
struct Lines<'a> {
    rest: &'a [u8],
    number: usize,
}

impl Lines<'_> {
    fn next(&mut self) -> Option<(usize, Vec<u8>)> {
        let (mut whole, first) = (Vec::new(), self.number + 1);
        loop {
            if self.rest.is_empty() {
                return (!whole.is_empty()).then_some((first, whole));
            }
            let end = self.rest.iter().position(|b| matches!(b, b'\n' | b'\r'));
            let (line, rest) = self.rest.split_at(end.unwrap_or(self.rest.len()));
            let ending = if rest.starts_with(b"\r\n") { 2 } else { 1 };
            self.rest = rest.get(ending..).unwrap_or_default();
            self.number += 1;
            match line.trim_ascii_end().strip_suffix(b"\\") {
                Some(part) => {
                    whole.extend_from_slice(part);
                    whole.push(b' ');
                }
                None => {
                    whole.extend_from_slice(line);
                    return Some((first, whole));
                }
            }
        }
    }
}

impl Statements {
    fn read(&mut self, number: usize, line: &[u8]) -> Result<(), String> {
        let line = line.split(|b| *b == b'#').next().unwrap_or_default();
        let mut words = line
            .split(u8::is_ascii_whitespace)
            .filter(|w| !w.is_empty());
        let Some(keyword) = words.next() else {
            return Ok(());
        };
        match keyword {
            b"v" => {
                let n = numbers(words)?;
                // A weight may follow, or a colour.
                match n[..] {
                    [x, y, z] | [x, y, z, _] | [x, y, z, _, _, _] | [x, y, z, _, _, _, _] => {
                        self.positions.push([x, y, z]);
                    }
                    _ => return Err(format!("v: expected 3 numbers, found {}", n.len())),
                }
            }
            b"vt" => {
                let n = numbers(words)?;
                match n[..] {
                    [u] => self.uv.push([u as f32, 0.0]),
                    [u, v] | [u, v, _] => self.uv.push([u as f32, v as f32]),
                    _ => return Err(format!("vt: expected 1 to 3 numbers, found {}", n.len())),
                }
            }
            b"f" | b"fo" => {
                let before = self.corners.len();
                for word in words {
                    let corner = self.corner(word)?;
                    self.corners.push(corner);
                }
                let corners = self.corners.len() - before;
                self.degenerate += usize::from(corners < 3);
                self.faces.push((number, corners, self.material));
            }
            _ if FREE_FORM.contains(&keyword) => {
                return Err(
                    "free-form curves and surfaces are not supported; export polygons".into(),
                );
            }
            b"usemtl" => {
                let next = self.materials.len() as u32 + 1;
                self.material = *self.materials.entry(rest_of(line)).or_insert(next);
            }
            b"mtllib" => self.libraries.push(rest_of(line)),
            b"l" | b"p" => self.lines_and_points += 1,
            _ if SKIPPED.contains(&keyword) => {}
            _ => {
                return Err(
                    "is no statement of OBJ, such as v, vt, vn, f, g, o, s or usemtl; export the mesh again"
                        .into(),
                );
            }
        }
        if self.materials.len().max(self.libraries.len()) > MAX_MATERIALS {
            return Err(format!(
                "more than {MAX_MATERIALS} materials or material files"
            ));
        }
        Ok(())
    }

    /// Parses `v`, `v/vt`, `v//vn` or `v/vt/vn`.
    fn corner(&self, word: &[u8]) -> Result<(usize, Option<usize>), String> {
        let mut parts = word.split(|b| *b == b'/');
        let index = |part: Option<&[u8]>, count: usize, what: &str| {
            let Some(part) = part.filter(|p| !p.is_empty()) else {
                return Ok(None);
            };
            let text = std::str::from_utf8(part).ok();
            let number: i64 = text.and_then(|t| t.parse().ok()).ok_or_else(|| {
                format!("f: expected whole numbers such as 1/2/3 for the {what} of a corner")
            })?;
            // Negative numbers count back from the latest.
            let index = match number {
                0 => None,
                n if n < 0 => count.checked_sub(n.unsigned_abs() as usize),
                n => usize::try_from(n - 1).ok(),
            };
            index
                .map(Some)
                .ok_or_else(|| format!("f: index {number} is no {what}"))
        };
        let place = index(parts.next(), self.positions.len(), "vertex")?;
        let uv = index(parts.next(), self.uv.len(), "texture coordinates")?;
        if parts.nth(1).is_some() {
            return Err("f: expected corners such as 1/2/3, found more than two slashes".into());
        }
        let place = place.ok_or("f: a corner has no vertex")?;
        Ok((place, uv))
    }

    fn finish(self) -> Result<Obj, String> {
        let mut obj = Obj::default();
        let mut split = Triangulation::default();
        let mut known: BTreeMap<(usize, Option<usize>), u32> = BTreeMap::new();
        let (mut places, mut vertices, mut parts) = (Vec::new(), Vec::new(), Vec::new());
        let textured = self.corners.iter().any(|c| c.1.is_some());
        let mut rest = self.corners.as_slice();
        for &(line, length, material) in &self.faces {
            let (corners, after) = rest.split_at(length);
            rest = after;
            if length < 3 {
                continue;
            }
            let fail = |what: String| format!("line {line}: {what}");
            places.clear();
            vertices.clear();
            for &(place, uv) in corners {
                let position = *self.positions.get(place).ok_or_else(|| {
                    fail(format!(
                        "f: index {} points past {} vertices",
                        place + 1,
                        self.positions.len()
                    ))
                })?;
                if !position.iter().all(|x| x.is_finite()) {
                    return Err(fail(format!(
                        "f: vertex {} is not finite; repair the mesh",
                        place + 1
                    )));
                }
                places.push(position);
                let coordinates = match uv {
                    None => [0.0; 2],
                    Some(k) => *self.uv.get(k).ok_or_else(|| {
                        fail(format!(
                            "f: index {} points past {} texture coordinates",
                            k + 1,
                            self.uv.len()
                        ))
                    })?,
                };
                let next = obj.positions.len() as u32;
                let vertex = match known.entry((place, uv)) {
                    Entry::Occupied(known) => *known.get(),
                    Entry::Vacant(new) => {
                        obj.positions.push(position);
                        if textured {
                            obj.uv.push(coordinates);
                        }
                        *new.insert(next)
                    }
                };
                vertices.push(vertex);
            }
            parts.clear();
            split.split(&places, &mut parts).map_err(fail)?;
            let triangle = |t: &[u32; 3]| t.map(|c| vertices[c as usize]);
            obj.triangles.extend(parts.iter().map(triangle));
            obj.triangle_material.resize(obj.triangles.len(), material);
        }
        if obj.triangles.is_empty() {
            return Err("has no faces; export a mesh with faces (no point cloud)".into());
        }
        obj.materials = vec![String::new(); self.materials.len() + 1];
        for (name, index) in self.materials {
            obj.materials[index as usize] = name;
        }
        obj.libraries = self.libraries;
        if let Some(note) = split.note() {
            obj.notes.insert("polygons".into(), note);
        }
        if self.degenerate > 0 {
            let what = format!("{} with fewer than three corners left out", self.degenerate);
            obj.notes.insert("faces".into(), what);
        }
        if self.lines_and_points > 0 {
            obj.notes
                .insert("dropped".into(), "points and lines".into());
        }
        Ok(obj)
    }
}

/// Returns the text after the keyword, which may contain spaces.
fn rest_of(line: &[u8]) -> String {
    let line = line.trim_ascii();
    let keyword = line.iter().position(u8::is_ascii_whitespace);
    let rest = &line[keyword.unwrap_or(line.len())..];
    String::from_utf8_lossy(rest.trim_ascii()).into_owned()
}

fn numbers<'a>(words: impl Iterator<Item = &'a [u8]>) -> Result<Vec<f64>, String> {
    words
        .map(|w| {
            let text = std::str::from_utf8(w).ok();
            let number = text.and_then(|t| t.parse().ok());
            number.ok_or_else(|| "expected a number".to_owned())
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn corners_slashes_negative_indices_and_line_ends_are_read() {
        let text = "# a\r\nv 0 0 0\rv 1 0 0 1\nv 1 1 0 .5 .5 .5\nv 0 1 0\nvt 0 0\nvt 1 1 0\nvn 0 0 1\n\
                    f 1/1/1 2/2/1 3/1/1\nf -4//1 -2//1 \\\n -1//1\nl 1 2\n";
        let obj = parse(text.as_bytes()).expect("reads");
        assert_eq!(obj.triangles.len(), 2);
        // The first and third corners occur with and without texture coordinates.
        assert_eq!(obj.positions.len(), 6);
        assert_eq!(obj.uv[1], [1.0, 1.0]);
        assert!(obj.notes.contains_key("dropped"));
    }

    #[test]
    fn a_concave_face_keeps_its_notch_and_digits_beyond_single_precision() {
        let text = "v 500000.25 0 0\nv 500002.25 0 0\nv 500002.25 1 0\nv 500001.25 1 0\nv 500001.25 2 0\n\
                    v 500000.25 2 0\nf 2 3 4 5 6 1\n";
        let obj = parse(text.as_bytes()).expect("reads");
        assert_eq!(obj.triangles.len(), 4);
        let area = |t: &[u32; 3]| {
            let [a, b, c] = t.map(|v| obj.positions[v as usize]);
            0.5 * ((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])).abs()
        };
        assert_eq!(obj.triangles.iter().map(area).sum::<f64>(), 3.0);
    }

    #[test]
    fn damage_is_refused_by_line() {
        for (text, expected) in [
            ("v 0 0\n", "line 1: v: expected 3"),
            ("v 0 0 x\n", "line 1: expected a number"),
            (
                "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n",
                "line 4: f: index 4 points past 3",
            ),
            (
                "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 -4\n",
                "index -4 is no vertex",
            ),
            (
                "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n",
                "index 0 is no vertex",
            ),
            ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1.5 2 3\n", "whole numbers"),
            ("v 0 0 0\nv 1 0 0\nf 1 2\n", "no faces"),
            (
                "v 0 0 0\nv 1 0 0\nv nan 1 0\nf 1 2 3\n",
                "vertex 3 is not finite",
            ),
            ("v 0 0 0\nv 1 1 0\nv 1 0 0\nv 0 1 0\nf 1 2 3 4\n", "cross"),
            ("cstype bezier\n", "free-form"),
            ("hello\n", "no statement of OBJ"),
            ("v 0 0 0\n", "no faces"),
        ] {
            let said = parse(text.as_bytes()).expect_err(text);
            assert!(said.contains(expected), "{text}: {said}");
        }
    }
}
