//! A folder of glTF models with a list, e.g. one made from the Amazon Berkeley Objects.

use std::{
    io::{Read, Seek, SeekFrom},
    path::{Path, PathBuf},
};

use picofarm_files::{FileError, Opener};
use sha2::{Digest, Sha256};

use crate::{LABELS, Mesh, SceneError, Vec3, body, import, trace::Model};

use super::obj::drop_degenerate;

/// The file name of the list.
pub(super) const LIST: &str = "assets.csv";
pub(super) const WRITE: &str = "write one beside the models (path,label,up,front,scale)";
/// Models with more triangles are omitted: they cost more than they show.
const MAX_TRIANGLES: usize = 100_000;
/// The greatest length of a list, bytes.
const MAX_LIST: u64 = 64 << 20;
/// The number of bytes at a model's start and end that its fingerprint covers.
const SAMPLE: u64 = 64 << 10;
const NEEDED: [&str; 5] = ["path", "label", "up", "front", "scale"];

/// One model of the list.
#[derive(Debug, Clone)]
pub(super) struct Row {
    pub(super) file: PathBuf,
    /// Opens the model and the files that it names: the list's folder.
    files: Opener,
    pub(super) name: String,
    pub(super) label: &'static str,
    pub(super) elevation: f32,
    pub(super) attribution: Option<String>,
    up: Vec3,
    front: Vec3,
    scale: f32,
}

/// The whole list.
#[derive(Debug)]
pub(super) struct List {
    pub(super) rows: Vec<Row>,
    /// The first 16 digits of the content's SHA-256.
    pub(super) digest: String,
}

/// Reads the list and checks every file that it names.
pub(super) fn open(dir: &Path) -> Result<List, SceneError> {
    let path = dir.join(LIST);
    if !path.is_file() {
        return Err(SceneError::Assets {
            name: super::GLTF.into(),
            looked: format!("no {LIST} in {}", dir.display()),
            hint: WRITE,
        });
    }
    let fail = |what: String| SceneError::Format {
        path: path.clone(),
        what,
    };
    let files = Opener::anywhere().within([dir]);
    let text = files
        .read(&path, MAX_LIST)
        .map_err(|e| fail(format!("{e}; a longer list can be split")))?;
    let text = String::from_utf8(text).map_err(|e| fail(format!("is not UTF-8 text: {e}")))?;
    let mut hash = Sha256::new_with_prefix(super::READING);
    hash.update(&text);
    let records = records(text.trim_start_matches('\u{feff}')).map_err(fail)?;
    let mut records = records.into_iter();
    let columns = Columns::of(records.next()).map_err(fail)?;
    let mut rows = Vec::new();
    for record in records {
        let row = columns.row((dir, &files), &record).map_err(fail)?;
        sample(&row, &mut hash).map_err(|e| {
            let line = record.line;
            fail(format!(
                "line {line}, column path: {e}; keep models in the list's folder"
            ))
        })?;
        rows.push(row);
    }
    if rows.is_empty() {
        return Err(fail("names no model; add a line for each".into()));
    }
    let digest = hex::encode(hash.finalize());
    Ok(List {
        rows,
        digest: digest[..16].to_owned(),
    })
}

/// Adds a file's length, start and end to `hash`.
fn sample(row: &Row, hash: &mut Sha256) -> Result<(), FileError> {
    let mut file = row.files.open(&row.file)?;
    let failed = |source| FileError::Io {
        path: row.file.clone(),
        source,
    };
    let length = file.metadata().map_err(failed)?.len();
    hash.update(length.to_le_bytes());
    for start in [0, length.saturating_sub(SAMPLE)] {
        let mut part = Vec::new();
        file.seek(SeekFrom::Start(start)).map_err(failed)?;
        let read = file.by_ref().take(SAMPLE).read_to_end(&mut part);
        read.map_err(failed)?;
        hash.update(&part);
    }
    Ok(())
}

/// A line of the list, or several if quotes contain line breaks.
struct Record {
    line: usize,
    fields: Vec<String>,
}

/// Parses comma-separated values (RFC 4180). Empty lines and those that start with # are skipped.
fn records(text: &str) -> Result<Vec<Record>, String> {
    let (mut out, mut line, mut rest) = (Vec::new(), 1, text);
    while !rest.is_empty() {
        let (start, mut fields) = (line, Vec::new());
        let skipped = rest.starts_with(['#', '\n', '\r']);
        loop {
            let (field, after) = match rest.strip_prefix('"').filter(|_| !skipped) {
                Some(quoted) => quoted_field(quoted).ok_or_else(|| {
                    let column = fields.len() + 1;
                    format!("line {start}, column {column}: a quote is not closed")
                })?,
                None => {
                    let stops: &[char] = if skipped { &['\n'] } else { &[',', '\n'] };
                    let end = rest.find(stops).unwrap_or(rest.len());
                    (rest[..end].trim().to_owned(), &rest[end..])
                }
            };
            line += field.matches('\n').count();
            fields.push(field);
            let after = after.trim_start_matches([' ', '\t', '\r']);
            match after.chars().next() {
                Some(',') => rest = &after[1..],
                Some('\n') => {
                    rest = &after[1..];
                    line += 1;
                    break;
                }
                None => {
                    rest = "";
                    break;
                }
                Some(_) => {
                    let column = fields.len();
                    return Err(format!("line {start}, column {column}: text after a quote"));
                }
            }
        }
        if !skipped {
            out.push(Record {
                line: start,
                fields,
            });
        }
    }
    Ok(out)
}

/// Returns a field after its opening quote, and the text after its closing one.
fn quoted_field(text: &str) -> Option<(String, &str)> {
    let (mut field, mut rest) = (String::new(), text);
    loop {
        let end = rest.find('"')?;
        field.push_str(&rest[..end]);
        rest = &rest[end + 1..];
        match rest.strip_prefix('"') {
            Some(after) => {
                field.push('"');
                rest = after;
            }
            None => return Some((field, rest)),
        }
    }
}

/// The position of each column.
struct Columns(Vec<String>);

impl Columns {
    fn of(header: Option<Record>) -> Result<Self, String> {
        let (line, names) = header.map_or((1, Vec::new()), |h| (h.line, h.fields));
        match NEEDED.iter().find(|n| !names.iter().any(|c| c == *n)) {
            Some(missing) => Err(format!(
                "line {line}: has no column {missing}; start with path,label,up,front,scale"
            )),
            None => Ok(Self(names)),
        }
    }

    fn row(&self, (dir, files): (&Path, &Opener), record: &Record) -> Result<Row, String> {
        let optional = |name: &str| {
            let k = self.0.iter().position(|c| c == name)?;
            record
                .fields
                .get(k)
                .map(String::as_str)
                .filter(|v| !v.is_empty())
        };
        let fail = |column: &str, what: String| {
            Err(format!("line {}, column {column}: {what}", record.line))
        };
        let [path, label, up, front, scale] = NEEDED.map(|n| optional(n).unwrap_or_default());
        if !path.to_ascii_lowercase().ends_with(".glb") {
            return fail("path", format!("{path:?}: expected a .glb file"));
        }
        let Some(known) = LABELS.iter().find(|l| **l == label) else {
            return fail(
                "label",
                format!(
                    "{label:?} is no category; see `picofarm_scene::LABELS`, e.g. chair, table, lamp"
                ),
            );
        };
        let axes = "use x, y, z, -x, -y or -z";
        let Some(up_axis) = axis(up) else {
            return fail("up", format!("{up:?} is no axis; {axes}"));
        };
        let Some(front_axis) = axis(front).filter(|f| f.dot(up_axis) == 0.0) else {
            return fail("front", format!("{front:?} is no axis across {up}; {axes}"));
        };
        let positive = |x: &f32| *x > 0.0 && x.is_finite();
        let Some(scale) = scale.parse().ok().filter(positive) else {
            return fail(
                "scale",
                format!("{scale:?}: expected metres per unit, e.g. 1 or 0.01"),
            );
        };
        let elevation = match optional("elevation").map(str::parse::<f32>) {
            None => 0.0,
            Some(Ok(x)) if x.is_finite() && x >= 0.0 => x,
            Some(_) => return fail("elevation", "expected metres over the floor".into()),
        };
        Ok(Row {
            file: Opener::named(dir, path)
                .map_err(|e| format!("line {}, column path: {e}", record.line))?,
            files: files.clone(),
            name: optional("name").unwrap_or(path).to_owned(),
            label: known,
            elevation,
            attribution: optional("attribution").map(str::to_owned),
            up: up_axis,
            front: front_axis,
            scale,
        })
    }
}

fn axis(name: &str) -> Option<Vec3> {
    let (sign, letter) = match name.strip_prefix('-') {
        Some(letter) => (-1.0, letter),
        None => (1.0, name.strip_prefix('+').unwrap_or(name)),
    };
    Some(match letter {
        "x" | "X" => Vec3::new(sign, 0.0, 0.0),
        "y" | "Y" => Vec3::new(0.0, sign, 0.0),
        "z" | "Z" => Vec3::new(0.0, 0.0, sign),
        _ => return None,
    })
}

impl Row {
    /// Returns a model that is y up and faces +z, in metres, as glTF defines.
    pub(super) fn upright(file: PathBuf, files: &Opener) -> Self {
        Self {
            file,
            files: files.clone(),
            name: String::new(),
            label: LABELS[0],
            elevation: 0.0,
            attribution: None,
            up: Vec3::new(0.0, 1.0, 0.0),
            front: Vec3::new(0.0, 0.0, 1.0),
            scale: 1.0,
        }
    }
}

/// Reads, turns and scales a model, and returns whether a transparent material was made opaque.
/// Returns `None` if the model cannot be used.
pub(super) fn load(row: &Row) -> Option<(Mesh, bool)> {
    let loaded = parse(row);
    if let Err(why) = &loaded {
        tracing::warn!(model = %row.file.display(), why, "furniture model left out");
    }
    loaded.ok()
}

/// Reads, turns and scales a model. The error is why it cannot be used.
pub(super) fn parse(row: &Row) -> Result<(Mesh, bool), String> {
    let (mut mesh, notes) = import::read_model(&row.file, &row.files).map_err(|e| e.to_string())?;
    if mesh.triangles.len() > MAX_TRIANGLES {
        let count = mesh.triangles.len();
        return Err(format!("{count} triangles, more than {MAX_TRIANGLES}"));
    }
    let right = row.up.cross(row.front);
    for p in &mut mesh.positions {
        let turned = Vec3::new(right.dot(*p), row.up.dot(*p), row.front.dot(*p));
        *p = turned * row.scale;
        if !p.is_finite() {
            return Err("a vertex is not finite".into());
        }
        if <[f32; 3]>::from(*p)
            .iter()
            .any(|x| x.abs() > Model::FARTHEST_M)
        {
            return Err("a vertex is more than 1000 km from the origin; correct the scale".into());
        }
    }
    if mesh.uv.iter().flatten().any(|x| !x.is_finite()) {
        return Err("a texture coordinate is not finite".into());
    }
    for material in &mesh.materials {
        material.check()?;
    }
    drop_degenerate(&mut mesh);
    body::check_mesh(&mesh)?;
    mesh.make_canonical();
    mesh.name.clone_from(&row.name);
    Ok((mesh, notes.contains_key("transparency")))
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::{AssetLibrary, rng::Rng};

    /// Writes a model of 10 × 30 × 20 units, up along z and its front along −y, as a .glb with
    /// textures.
    fn crate_of(path: &Path) {
        model(path, 30.0);
    }

    /// Writes a box of this height as a .glb.
    pub(in crate::assets) fn model(path: &Path, height: f32) {
        use crate::{Aim, Camera, Intrinsics, Material, Object, Provenance, Scene, shape::Shape};
        let mut shape = Shape::new("crate");
        let m = shape.material(Material::diffuse("wood", [0.6, 0.4, 0.2]));
        // The front bulges: 15 units towards −y, 5 towards +y.
        let [w, d] = [height / 6.0, height / 2.0];
        shape.cuboid([-w, -d, 0.0], [w, w, height], m);
        let camera = Camera::look_at(
            Vec3::new(0.0, 0.0, 90.0),
            Vec3::ZERO,
            Intrinsics::from_fov(90.0, 8, 8),
        );
        let scene = Scene {
            name: "crate".into(),
            objects: vec![Object {
                mesh: shape.finish().into(),
                to_world: crate::Affine::IDENTITY,
                label: 0,
                name: "crate".into(),
            }],
            labels: vec!["box".into()],
            laser: Aim::grid(1).unwrap().laser(&camera),
            camera,
            provenance: Provenance::default(),
        };
        crate::export::write_glb(&scene, path).unwrap();
    }

    fn library(list: &str) -> Result<AssetLibrary, SceneError> {
        let dir = tempfile::tempdir().unwrap();
        crate_of(&dir.path().join("a b.glb"));
        std::fs::write(dir.path().join(LIST), list).unwrap();
        let library = AssetLibrary::gltf(dir.path());
        if let Ok(library) = &library {
            // The model is drawn before the folder is deleted.
            library.draw(&mut Rng::new(1, 0), "box", |_, _| true);
        }
        library
    }

    const GOOD: &str = "# my models\nscale,path,label,up,front,attribution\r\n0.01,a b.glb,box,z,-y,\"Ann, \"\"A\"\", CC0\"\n\n";

    #[test]
    fn models_are_turned_and_scaled_to_metres() {
        let library = library(GOOD).unwrap();
        let (asset, model) = library
            .draw(&mut Rng::new(1, 0), "box", |_, _| true)
            .expect("the model");
        let size = model.size();
        for (found, expected) in size.iter().zip([0.1, 0.3, 0.2]) {
            assert!((found - expected).abs() < 1e-6, "{size:?}");
        }
        assert_eq!(asset.attribution.as_deref(), Some("Ann, \"A\", CC0"));
        assert_eq!((library.name(), library.len()), ("gltf", 1));
        assert!(library.fingerprint().starts_with("gltf:"));
    }

    #[test]
    fn the_fingerprint_covers_list_and_models() {
        let dir = tempfile::tempdir().unwrap();
        let write = |list: &str| std::fs::write(dir.path().join(LIST), list).unwrap();
        let print = || {
            let found = AssetLibrary::find("gltf", &[dir.path().to_path_buf()]).unwrap();
            found.fingerprint().to_owned()
        };
        crate_of(&dir.path().join("a b.glb"));
        write(GOOD);
        let first = print();
        assert_eq!(first, print());
        write(&GOOD.replace("0.01", "0.02"));
        assert_ne!(first, print());
        write(GOOD);
        let file = dir.path().join("a b.glb");
        let mut bytes = std::fs::read(&file).unwrap();
        *bytes.last_mut().unwrap() ^= 1;
        std::fs::write(file, bytes).unwrap();
        assert_ne!(first, print());
    }

    #[test]
    fn errors_name_file_line_and_column() {
        for (from, to, expected) in [
            ("scale,", "size,", "line 2: has no column scale"),
            ("0.01", "-1", "line 3, column scale"),
            ("0.01", "", "line 3, column scale"),
            (",box", ",boxes", "line 3, column label: \"boxes\""),
            (",z,", ",w,", "line 3, column up"),
            (
                "-y",
                "-z",
                "line 3, column front: \"-z\" is no axis across z",
            ),
            ("a b.glb", "c.glb", "line 3, column path"),
            ("a b.glb", "a b.fbx", "expected a .glb"),
            ("CC0\"", "CC0", "line 3, column 6: a quote is not closed"),
            ("CC0\"", "CC0\" x", "line 3, column 6: text after a quote"),
        ] {
            let error = library(&GOOD.replacen(from, to, 1))
                .unwrap_err()
                .to_string();
            assert!(error.contains(LIST) && error.contains(expected), "{error}");
        }
        let absent = AssetLibrary::gltf(Path::new("/nowhere")).unwrap_err();
        assert!(matches!(absent, SceneError::Assets { .. }));
    }
}
