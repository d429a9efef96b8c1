//! Makes the list of a folder of models: categories from the metadata of the Amazon Berkeley
//! Objects (Collins et al. 2022), or from the names of folders and files.

use std::{
    collections::BTreeMap,
    fmt::Write as _,
    io::Read,
    path::{Path, PathBuf},
};

use flate2::read::MultiGzDecoder;
use picofarm_files::Opener;
use serde_json::Value;

use super::{category::category_of, folder};
use crate::{LABELS, SceneError};

/// The deepest nesting of folders.
const MAX_DEPTH: usize = 32;
/// The greatest size of a decompressed list of products, bytes.
const MAX_METADATA: u64 = 1 << 30;
/// The least and the greatest extent of a piece of furniture, metres.
const EXTENTS: [f32; 2] = [0.02, 5.0];
/// Metres per unit, in the order in which they are tried.
const SCALES: [f32; 3] = [1.0, 0.01, 0.001];

/// The result of a scan.
#[derive(Debug)]
pub struct Scanned {
    /// The list that was written.
    pub list: PathBuf,
    /// The number of models of each category.
    pub listed: BTreeMap<&'static str, usize>,
    /// The models that are not listed, with the reason.
    pub refused: Vec<(String, String)>,
}

/// Facts about a model file that is not read.
struct Entry {
    path: String,
    name: String,
    label: Result<&'static str, String>,
    attribution: &'static str,
}

/// Writes `assets.csv` for the `.glb` models of a folder and its subfolders. Models are y up and
/// face +z, as glTF defines; their unit is the metre, or the centimetre or millimetre if only that
/// gives them the size of furniture.
///
/// # Errors
/// [`SceneError::Assets`] if there is a list already or no usable model, [`SceneError::Read`] and
/// [`SceneError::Format`] for files that cannot be read or written.
pub fn scan(dir: &Path) -> Result<Scanned, SceneError> {
    let list = dir.join(folder::LIST);
    let refuse = |looked: String, hint: &'static str| SceneError::Assets {
        name: super::GLTF.into(),
        looked,
        hint,
    };
    if list.exists() {
        let looked = format!("{} exists already", list.display());
        return Err(refuse(looked, "remove it to make another"));
    }
    let mut models = Vec::new();
    find(dir, MAX_DEPTH, &mut models)?;
    let relative = |path: &Path| {
        let inner = path.strip_prefix(dir).unwrap_or(path);
        inner.to_string_lossy().replace('\\', "/")
    };
    let products = products(dir)?;
    let entries = models
        .iter()
        .map(|path| entry(relative(path), products.as_ref()));
    let files = Opener::anywhere().within([dir]);
    let (mut text, mut listed) = (
        String::from("path,label,up,front,scale,name,attribution\n"),
        BTreeMap::new(),
    );
    let mut refused = Vec::new();
    for entry in entries {
        let found = entry.label.and_then(|label| {
            let scale = scale(&folder::Row::upright(dir.join(&entry.path), &files))?;
            Ok((label, scale))
        });
        match found {
            Ok((label, scale)) => {
                *listed.entry(label).or_default() += 1;
                let [path, name, attribution] =
                    [&entry.path, &entry.name, entry.attribution].map(quoted);
                let _ = writeln!(text, "{path},{label},y,z,{scale},{name},{attribution}");
            }
            Err(why) => refused.push((entry.path, why)),
        }
    }
    if listed.is_empty() {
        let why = refused.first().map_or_else(
            || format!("no .glb file in {}", dir.display()),
            |(path, why)| format!("none of {} models is usable; {path}: {why}", refused.len()),
        );
        return Err(refuse(why, folder::WRITE));
    }
    std::fs::write(&list, text).map_err(|source| SceneError::Read {
        path: list.clone(),
        source,
    })?;
    Ok(Scanned {
        list,
        listed,
        refused,
    })
}

/// Returns the first scale that gives a model the size of furniture, after the checks of a model of
/// the list.
fn scale(row: &folder::Row) -> Result<f32, String> {
    let (mesh, _) = folder::parse(row)?;
    let (lo, hi) = mesh.bounds().ok_or("has no triangles")?;
    let size = hi - lo;
    let extent = size.x.max(size.y).max(size.z);
    let [least, most] = EXTENTS;
    let fits = |scale: &&f32| (least..=most).contains(&(extent * **scale));
    SCALES.iter().find(fits).copied().ok_or_else(|| {
        format!(
            "measures {extent} units, which is no piece of furniture in metres, centimetres or millimetres"
        )
    })
}

/// Finds the models of a folder and its subfolders, in the order of their paths.
fn find(dir: &Path, depth: usize, models: &mut Vec<PathBuf>) -> Result<(), SceneError> {
    let failed = |source| SceneError::Read {
        path: dir.to_owned(),
        source,
    };
    let entries: Result<Vec<_>, _> = std::fs::read_dir(dir).map_err(failed)?.collect();
    let mut paths: Vec<PathBuf> = entries.map_err(failed)?.iter().map(|e| e.path()).collect();
    paths.sort_unstable();
    for path in paths {
        if path.is_dir() {
            if depth > 0 {
                find(&path, depth - 1, models)?;
            }
        } else if path
            .extension()
            .is_some_and(|e| e.eq_ignore_ascii_case("glb"))
        {
            models.push(path);
        }
    }
    Ok(())
}

fn entry(path: String, products: Option<&BTreeMap<String, Product>>) -> Entry {
    let stem = Path::new(&path)
        .file_stem()
        .unwrap_or_default()
        .to_string_lossy()
        .into_owned();
    match products {
        None => Entry {
            label: by_path(&path).ok_or_else(|| "no category in its path".to_owned()),
            name: stem,
            path,
            attribution: "",
        },
        Some(products) => {
            let product = products.get(&stem);
            let label = match product {
                None => Err("is in no list of products".to_owned()),
                Some(p) => p
                    .label()
                    .ok_or_else(|| format!("product type {:?} is no furniture", p.kind)),
            };
            Entry {
                label,
                name: product.map_or(stem, |p| p.name.clone()),
                path,
                attribution: "Amazon Berkeley Objects",
            }
        }
    }
}

/// Returns the category that a path names: a folder, the nearest first, or the file.
fn by_path(path: &str) -> Option<&'static str> {
    let path = path.rsplit_once('.').map_or(path, |(stem, _)| stem);
    let parts: Vec<String> = path
        .split('/')
        .rev()
        .map(|p| p.to_lowercase().replace(['-', ' '], "_"))
        .collect();
    let (file, folders) = parts.split_first()?;
    let exact = |part: &String| {
        let one = part.strip_suffix('s').unwrap_or(part);
        LABELS.iter().copied().find(|l| l == part || *l == one)
    };
    let close = |part: &String| category_of("", &part.replace('_', " "));
    let folders = || folders.iter().chain([file]);
    folders()
        .find_map(exact)
        .or_else(|| folders().find_map(close))
}

/// A product of the Amazon Berkeley Objects.
struct Product {
    /// Its type, for example `COFFEE_TABLE`.
    kind: String,
    name: String,
}

impl Product {
    fn label(&self) -> Option<&'static str> {
        let kind = self.kind.to_lowercase().replace('_', " ");
        // Types such as HOME and HOME_BED_AND_BATH cover everything, so that the name decides.
        match kind.starts_with("home") || kind.is_empty() {
            true => category_of("", &self.name),
            false => category_of("", &kind).or_else(|| match &*kind {
                "ottoman" | "bench" => Some("stool"),
                "planter" => Some("plant"),
                _ => None,
            }),
        }
    }
}

/// Returns the products with a model, by the model's id, if the folder has lists of products:
/// `listings_*.json` or `.json.gz` in `metadata`, `listings/metadata` or the folder itself.
fn products(dir: &Path) -> Result<Option<BTreeMap<String, Product>>, SceneError> {
    let mut lists = Vec::new();
    for place in ["", "metadata", "listings/metadata", "../listings/metadata"] {
        let inside = std::fs::read_dir(dir.join(place)).into_iter().flatten();
        let inside = inside.filter_map(|e| Some(e.ok()?.path()));
        lists.extend(inside.filter(|p| {
            let name = p.file_name().unwrap_or_default().to_string_lossy();
            name.starts_with("listings_") && (name.ends_with(".json") || name.ends_with(".json.gz"))
        }));
    }
    if lists.is_empty() {
        return Ok(None);
    }
    lists.sort_unstable();
    let mut products = BTreeMap::new();
    for path in lists {
        let fail = |what: String| SceneError::Format {
            path: path.clone(),
            what,
        };
        let bytes = std::fs::read(&path).map_err(|source| SceneError::Read {
            path: path.clone(),
            source,
        })?;
        let mut text = String::new();
        let reading = match path.extension().is_some_and(|e| e == "gz") {
            true => MultiGzDecoder::new(&*bytes)
                .take(MAX_METADATA)
                .read_to_string(&mut text),
            false => (&*bytes).take(MAX_METADATA).read_to_string(&mut text),
        };
        reading.map_err(|e| fail(format!("{e}; copy it again")))?;
        for (k, line) in text
            .lines()
            .enumerate()
            .filter(|(_, line)| !line.trim().is_empty())
        {
            let product: Value =
                serde_json::from_str(line).map_err(|e| fail(format!("line {}: {e}", k + 1)))?;
            let Some(model) = product["3dmodel_id"].as_str() else {
                continue;
            };
            let english = |e: &&Value| {
                e["language_tag"]
                    .as_str()
                    .is_some_and(|t| t.starts_with("en"))
            };
            let names = product["item_name"]
                .as_array()
                .map_or(&[][..], Vec::as_slice);
            let name = names.iter().find(english).or(names.first());
            let name = name.and_then(|n| n["value"].as_str()).unwrap_or(model);
            let kind = product["product_type"][0]["value"]
                .as_str()
                .unwrap_or_default();
            let product = Product {
                kind: kind.to_owned(),
                name: name.to_owned(),
            };
            products.entry(model.to_owned()).or_insert(product);
        }
    }
    Ok(Some(products))
}

/// Returns a field of comma-separated values.
fn quoted(text: &str) -> String {
    let text: String = text
        .chars()
        .map(|c| if c.is_control() { ' ' } else { c })
        .collect();
    match text.contains([',', '"']) || text.starts_with('#') {
        true => format!("\"{}\"", text.replace('"', "\"\"")),
        false => text,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::AssetLibrary;

    fn folder(files: &[(&str, f32)]) -> tempfile::TempDir {
        let dir = tempfile::tempdir().unwrap();
        for (file, size) in files {
            let path = dir.path().join(file);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            folder::tests::model(&path, *size);
        }
        dir
    }

    #[test]
    fn categories_come_from_the_nearest_folder_then_from_the_file() {
        for (path, expected) in [
            ("furniture/chairs/0001.glb", Some("chair")),
            ("bedroom/Coffee-Table/model.glb", Some("coffee_table")),
            ("models/old oak table.glb", Some("table")),
            ("models/7f3a.glb", None),
        ] {
            assert_eq!(by_path(path), expected, "{path}");
        }
    }

    #[test]
    fn a_folder_becomes_a_library_and_what_is_refused_is_named() {
        let files = [
            ("chair/a, b.glb", 0.03),
            ("lamps/2.glb", 3.0),
            ("sofa/huge.glb", 1e5),
            ("other/x.glb", 0.03),
        ];
        let dir = folder(&files);
        std::fs::write(dir.path().join("chair/broken.glb"), b"glTF").unwrap();
        let scanned = scan(dir.path()).unwrap();
        assert_eq!(scanned.listed, BTreeMap::from([("chair", 1), ("lamp", 1)]));
        let refused: Vec<&str> = scanned.refused.iter().map(|(path, _)| &**path).collect();
        assert_eq!(
            refused,
            ["chair/broken.glb", "other/x.glb", "sofa/huge.glb"]
        );
        assert!(
            scanned.refused[2].1.contains("measures"),
            "{:?}",
            scanned.refused
        );
        let library = AssetLibrary::gltf(dir.path()).unwrap();
        assert_eq!(library.len(), 2);
        let again = scan(dir.path()).unwrap_err().to_string();
        assert!(again.contains("exists already"), "{again}");
    }

    #[test]
    fn the_types_of_products_name_the_models_of_the_amazon_berkeley_objects() {
        let dir = folder(&[
            ("original/0/B01.glb", 0.03),
            ("original/1/B02.glb", 0.03),
            ("original/2/B03.glb", 0.03),
        ]);
        let metadata = dir.path().join("listings/metadata");
        std::fs::create_dir_all(&metadata).unwrap();
        let product = |id: &str, kind: &str, name: &str| {
            format!(
                "{{\"3dmodel_id\": \"{id}\", \"product_type\": [{{\"value\": \"{kind}\"}}], \
                \"item_name\": [{{\"language_tag\": \"en_US\", \"value\": \"{name}\"}}]}}\n"
            )
        };
        let text = product("B01", "OTTOMAN", "A round one")
            + &product("B02", "HOME", "Mid-century sofa")
            + &product("B03", "CELLULAR_PHONE_CASE", "Case");
        std::fs::write(
            metadata.join("listings_0.json"),
            text.replace("PHONE_CASE", "CASE"),
        )
        .unwrap();
        let scanned = scan(dir.path()).unwrap();
        assert_eq!(scanned.listed, BTreeMap::from([("sofa", 1), ("stool", 1)]));
        assert!(
            scanned.refused[0].1.contains("CELLULAR_CASE"),
            "{:?}",
            scanned.refused
        );
        let list = std::fs::read_to_string(&scanned.list).unwrap();
        assert!(
            list.contains("original/1/B02.glb,sofa,y,z,1,Mid-century sofa,Amazon Berkeley Objects"),
            "{list}"
        );
    }
}
