//! Sweet Home 3D furniture libraries (`.sh3f`): the Java-properties catalogue inside each zip.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs::File,
    io::BufReader,
    path::{Path, PathBuf},
    sync::Mutex,
};

use sha2::{Digest, Sha256};
use zip::ZipArchive;

use crate::SceneError;

use super::category::category_of;

const CATALOGUE: &str = "PluginFurnitureCatalog.properties";
/// The greatest size of an entry, bytes: catalogues have some hundred kilobytes.
const MAX_ENTRY: u64 = 64 << 20;

/// An open `.sh3f` file, shared by the threads that load models.
#[derive(Debug)]
pub(super) struct Archive {
    path: PathBuf,
    zip: Mutex<ZipArchive<BufReader<File>>>,
}

/// One usable catalogue entry.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Item {
    pub(super) name: String,
    pub(super) label: &'static str,
    /// The width, height and depth in metres.
    pub(super) size: [f32; 3],
    /// The height above the floor, metres.
    pub(super) elevation: f32,
    /// The rows of the rotation that turns the model upright with its front towards +z.
    pub(super) rotation: Option<[f32; 9]>,
    /// The entry of the OBJ file in the zip.
    pub(super) model: String,
    pub(super) attribution: String,
}

/// The contents of one library.
#[derive(Debug)]
pub(super) struct Catalogue {
    pub(super) version: String,
    pub(super) items: Vec<Item>,
}

impl Archive {
    pub(super) fn open(path: &Path) -> Result<Self, SceneError> {
        let file = File::open(path).map_err(|source| SceneError::Read {
            path: path.to_path_buf(),
            source,
        })?;
        let zip = ZipArchive::new(BufReader::new(file)).map_err(|e| SceneError::Format {
            path: path.to_path_buf(),
            what: format!("is not a readable .sh3f (zip) file: {e}; install the assets again"),
        })?;
        Ok(Self {
            path: path.to_path_buf(),
            zip: Mutex::new(zip),
        })
    }

    fn with_zip<T>(&self, use_zip: impl FnOnce(&mut ZipArchive<BufReader<File>>) -> T) -> T {
        // A panic of another reader leaves the archive usable, because every read seeks first.
        let mut zip = self
            .zip
            .lock()
            .unwrap_or_else(|poisoned| poisoned.into_inner());
        use_zip(&mut zip)
    }

    /// Returns the bytes of one entry.
    pub(super) fn read(&self, entry: &str) -> Result<Vec<u8>, SceneError> {
        let bytes = self.with_zip(|zip| {
            let file = zip.by_name(entry).map_err(|e| e.to_string())?;
            let announced = file.size();
            picofarm_files::read_entry(file, announced, MAX_ENTRY).map_err(|e| e.to_string())
        });
        bytes.map_err(|e| SceneError::Format {
            path: self.path.clone(),
            what: format!("entry {entry}: {e}; install the assets again"),
        })
    }

    /// Adds the name, size and checksum of every entry to `hash`. They identify the exact content
    /// without reading all of it.
    pub(super) fn fingerprint(&self, hash: &mut Sha256) -> Result<(), SceneError> {
        self.with_zip(|zip| {
            for k in 0..zip.len() {
                let entry = zip.by_index_raw(k).map_err(|e| SceneError::Format {
                    path: self.path.clone(),
                    what: format!("entry {k}: {e}; install the assets again"),
                })?;
                hash.update(entry.name().as_bytes());
                hash.update(entry.size().to_le_bytes());
                hash.update(entry.crc32().to_le_bytes());
            }
            Ok(())
        })
    }

    /// Returns the uncompressed size of an entry in bytes, or 0 if there is none.
    fn entry_size(&self, entry: &str) -> u64 {
        self.with_zip(|zip| {
            let index = zip.index_for_name(entry);
            index
                .and_then(|k| zip.by_index_raw(k).ok())
                .map_or(0, |f| f.size())
        })
    }

    /// Returns the items that have one of our categories, a free licence, a plausible size and an
    /// OBJ of at most `max_bytes`, in catalogue order.
    pub(super) fn catalogue(&self, max_bytes: u64) -> Result<Catalogue, SceneError> {
        let text = latin1(&self.read(CATALOGUE)?);
        let properties = properties(&text);
        let get = |key: &str| properties.get(key).map(String::as_str);
        let version = get("version").unwrap_or("unknown").to_owned();
        // The numbers that occur: the largest may be any, and says nothing of how many there are.
        let numbers: BTreeSet<u32> = properties
            .keys()
            .filter_map(|k| k.strip_prefix("model#")?.parse().ok())
            .filter(|n| *n > 0)
            .collect();
        let items = numbers
            .into_iter()
            .filter_map(|n| {
                item(
                    &|key| get(&format!("{key}#{n}")),
                    get("license").unwrap_or_default(),
                )
            })
            .filter(|item| (1..=max_bytes).contains(&self.entry_size(&item.model)))
            .collect();
        Ok(Catalogue { version, items })
    }
}

/// Returns one entry, or `None` if it cannot be used.
fn item<'a>(get: &dyn Fn(&str) -> Option<&'a str>, library_licence: &str) -> Option<Item> {
    let (name, creator) = (get("name")?, get("creator").unwrap_or("unknown"));
    let licence = short_licence(get("license").unwrap_or(library_licence))?;
    let label = category_of(get("category")?, name)?;
    if get("doorOrWindow") == Some("true") {
        return None;
    }
    let metres = |key: &str| {
        get(key)
            .and_then(|v| v.trim().parse::<f32>().ok())
            .map(|cm| cm * 0.01)
    };
    let size = [metres("width")?, metres("height")?, metres("depth")?];
    if !size.iter().all(|s| (0.002..6.0).contains(s)) {
        return None;
    }
    let rotation = match get("modelRotation") {
        None => None,
        Some(text) => {
            let numbers: Vec<f32> = text
                .split_whitespace()
                .filter_map(|v| v.parse().ok())
                .collect();
            Some(numbers.try_into().ok()?)
        }
    };
    Some(Item {
        name: name.to_owned(),
        label,
        size,
        elevation: metres("elevation").unwrap_or(0.0).max(0.0),
        rotation,
        model: get("model")?.trim_start_matches('/').to_owned(),
        attribution: format!("{name} by {creator} ({licence}), Sweet Home 3D furniture library"),
    })
}

/// Returns CC0 or CC BY, or `None` for every other licence.
fn short_licence(text: &str) -> Option<&'static str> {
    let lower = text.to_lowercase();
    if [
        "sharealike",
        "share alike",
        "noncommercial",
        "non-commercial",
        "gpl",
        "noderiv",
    ]
    .iter()
    .any(|w| lower.contains(w))
    {
        return None;
    }
    if lower.contains("public domain") || lower.contains("cc0") || lower.contains("cc-0") {
        return Some("CC0");
    }
    (lower.contains("creative commons") && lower.contains("attribution")).then_some("CC BY 3.0")
}

/// Decodes ISO 8859-1, the encoding of Java properties: every byte is the character with that
/// number.
fn latin1(bytes: &[u8]) -> String {
    bytes.iter().map(|&b| b as char).collect()
}

/// Parses `key=value` lines; `#` and `!` start comments; `\uXXXX` escapes are decoded.
fn properties(text: &str) -> BTreeMap<String, String> {
    text.lines()
        .map(str::trim)
        .filter(|line| !line.starts_with(['#', '!']))
        .filter_map(|line| line.split_once('='))
        .map(|(key, value)| (key.trim().to_owned(), unescaped(value.trim())))
        .collect()
}

fn unescaped(value: &str) -> String {
    let mut out = String::with_capacity(value.len());
    let mut rest = value;
    while let Some(at) = rest.find('\\') {
        out.push_str(&rest[..at]);
        let tail = &rest[at + 1..];
        let code = tail
            .strip_prefix('u')
            .and_then(|hex| hex.get(..4))
            .and_then(|hex| u32::from_str_radix(hex, 16).ok())
            .and_then(char::from_u32);
        match code {
            Some(c) => {
                out.push(c);
                rest = &tail[5..];
            }
            None => rest = tail,
        }
    }
    out.push_str(rest);
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn properties_are_read_with_escapes_and_comments() {
        let text = latin1(b"# name#1=no\nname#1\xa0= Caf\\u00e9 table\nwidth#1=60.5\n");
        let p = properties(&text);
        assert_eq!(p.get("name#1").map(String::as_str), Some("Café table"));
        assert_eq!(p.len(), 2);
    }

    #[test]
    fn only_free_licences_pass() {
        assert_eq!(short_licence("Public domain"), Some("CC0"));
        assert_eq!(
            short_licence("Creative Commons Attribution 3.0 license"),
            Some("CC BY 3.0")
        );
        for other in ["GNU GPL", "Creative Commons Attribution-ShareAlike 3.0", ""] {
            assert_eq!(short_licence(other), None, "{other}");
        }
    }

    #[test]
    fn items_carry_size_in_metres_and_their_creator() {
        let p = properties(
            "name#1=Armchair\ncategory#1=Office\nwidth#1=59.4\ndepth#1=62.7\nheight#1=105\n\
             model#1=/a/armchair.obj\ncreator#1=Absfrm\nmodelRotation#1=1 0 0 0 0 1 0 -1 0",
        );
        let get = |key: &str| p.get(&format!("{key}#1")).map(String::as_str);
        let item = item(&get, "Public domain").expect("usable");
        assert_eq!(
            (item.label, item.model.as_str()),
            ("armchair", "a/armchair.obj")
        );
        assert!((item.size[1] - 1.05).abs() < 1e-6 && item.rotation.is_some());
        assert!(item.attribution.contains("Absfrm") && item.attribution.contains("CC0"));
    }

    #[test]
    fn a_catalogue_whose_numbers_are_huge_has_as_many_items_as_it_lists() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("huge.sh3f");
        let mut zip = zip::ZipWriter::new(File::create(&path).unwrap());
        let plain = zip::write::SimpleFileOptions::default()
            .compression_method(zip::CompressionMethod::Stored);
        zip.start_file(CATALOGUE, plain).unwrap();
        let text = "license=Public domain\nmodel#4294967295=a.obj\nmodel#0=b.obj\n";
        std::io::Write::write_all(&mut zip, text.as_bytes()).unwrap();
        zip.finish().unwrap();
        let catalogue = Archive::open(&path).unwrap().catalogue(1 << 20).unwrap();
        assert!(catalogue.items.is_empty());
    }
}
