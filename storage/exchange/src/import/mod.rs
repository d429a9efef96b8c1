//! Imports other people's data into our layout. The content of the files is checked against the
//! known conventions of the format (see `check.rs`). Mismatches are refused with an error that
//! names the field; nothing is guessed.
//!
//! [`import_scene`] is a pure function of the files and options. The manifest of an imported scene
//! contains the format, the files with their SHA-256, and a list of all conversions and missing
//! quantities.

mod bf_lidar;
pub mod capture;
mod check;
mod error;
#[cfg(feature = "formats")]
mod exr;
mod files;
#[cfg(feature = "formats")]
mod hdf5;
mod image;
mod mask_order;
mod masks;
mod mat;
pub(crate) mod npy;
mod npy_folder;
mod options;
mod paths;
mod platonerf;
mod profile;
mod publish;
mod sb3d;
mod scene;
mod vector;
#[cfg(not(feature = "formats"))]
mod without_formats;

use std::path::{Path, PathBuf};

use picofarm_files::Opener;

pub use error::ImportError;
pub use files::SourceFile;
pub use options::{Captures, DepthKind, Format, ImportOptions, Polarity};
pub use scene::ImportedScene;

use files::Files;
use scene::Shape;

use picofarm_dataset::{DatasetSpec, Profile, Wavelength};

/// Version of the import. It changes whenever the same files could give different bytes.
pub const IMPORT_VERSION: &str = "import-5";

/// A folder of importable scenes.
#[derive(Debug, Clone)]
pub struct Source {
    root: PathBuf,
    opener: Opener,
    format: Format,
    options: ImportOptions,
    items: Vec<Item>,
    shape: Shape,
}

/// The location of a source's scene.
#[derive(Debug, Clone)]
struct Item {
    name: String,
    /// The scene's folder.
    folder: PathBuf,
    /// The capture in the folder; `None` = all captures.
    capture: Option<usize>,
    opener: Opener,
}

impl Item {
    fn new(root: &Path, folder: PathBuf, opener: &Opener) -> Self {
        let name = match folder == root {
            true => ".".into(),
            false => Files::new(root, opener).name(&folder),
        };
        Self {
            name,
            folder,
            capture: None,
            opener: opener.clone(),
        }
    }

    /// Returns a reader of its folder's files.
    fn files(&self) -> Files {
        Files::new(&self.folder, &self.opener)
    }
}

impl Source {
    /// Finds scenes in `root` and its folders, ordered by name. With `names`, uses only these
    /// scenes in this order. The first scene's files determine the data set's properties. If
    /// `format` is `None`, it is detected.
    ///
    /// ```
    /// use picofarm_exchange::import::{ImportOptions, Source};
    ///
    /// let folder = tempfile::tempdir()?;
    /// let error = Source::open(folder.path(), None, ImportOptions::default(), None);
    /// assert!(error.unwrap_err().to_string().contains("scene.json"));
    /// # Ok::<(), std::io::Error>(())
    /// ```
    ///
    /// # Errors
    /// [`ImportError::Refused`] if there are no scenes of the format, or scenes of several; if the
    /// first scene's files or the options do not fit the format; [`ImportError::Io`].
    pub fn open(
        root: &Path,
        format: Option<Format>,
        options: ImportOptions,
        names: Option<&[String]>,
    ) -> Result<Self, ImportError> {
        Self::open_within(root, format, options, names, &Opener::anywhere())
    }

    /// Like [`Self::open`], but only reads files that `opener` permits, after resolving links in
    /// the folder.
    ///
    /// # Errors
    /// Also [`ImportError::File`].
    pub fn open_within(
        root: &Path,
        format: Option<Format>,
        options: ImportOptions,
        names: Option<&[String]>,
        opener: &Opener,
    ) -> Result<Self, ImportError> {
        opener.check(root)?;
        let (format, mut items) = match format {
            Some(format) => (format, find(root, format, &options, opener)?),
            None => detect(root, &options, opener)?,
        };
        options.check(format)?;
        if let Some(names) = names {
            items = choose(root, items, names)?;
        }
        let Some(first) = items.first() else {
            let expected = format!(
                "scenes in the layout {}: {}",
                format.name(),
                looks_like(format)
            );
            return Err(ImportError::refused(
                root,
                "contents",
                expected,
                "none",
                "check the folder, or give another --format",
            ));
        };
        let shape = match format {
            Format::Sb3d => sb3d::shape(first, &options),
            Format::Platonerf => platonerf::shape(first, &options),
            Format::BfLidar => bf_lidar::shape(first, &options),
            Format::Npy => npy_folder::shape(first),
        }?;
        Ok(Self {
            root: root.to_owned(),
            opener: opener.clone(),
            format,
            options,
            items,
            shape,
        })
    }

    /// Returns the format.
    pub fn format(&self) -> Format {
        self.format
    }

    /// Returns the number of scenes.
    pub fn scenes(&self) -> u64 {
        self.items.len() as u64
    }

    /// Returns the index of the scene called `name`.
    pub fn index_of(&self, name: &str) -> Option<u64> {
        let found = self.items.iter().position(|i| i.name == name);
        found.map(|i| i as u64)
    }

    /// Returns the name of a scene: its folder relative to the source, and its capture.
    pub fn name(&self, index: u64) -> Option<&str> {
        let item = self.items.get(usize::try_from(index).ok()?);
        item.map(|i| i.name.as_str())
    }

    /// Returns the properties of a data set for the scenes.
    pub fn spec(&self, profile: Profile) -> DatasetSpec {
        DatasetSpec {
            scenes: self.scenes(),
            height: self.shape.height,
            width: self.shape.width,
            spots: self.shape.spots,
            subsets: self.shape.subsets,
            per_spot: self.options.captures == Captures::Both,
            wavelengths_nm: Wavelength::NONE,
            two_bounce: self.shape.two_bounce,
            gate: self.shape.gate,
            profile,
        }
    }
}

/// Reads, checks and converts a scene. It blocks while rayon threads decode, and needs memory for
/// one scene.
///
/// # Errors
/// [`ImportError`] naming file and field; there is no such scene.
pub fn import_scene(source: &Source, index: u64) -> Result<ImportedScene, ImportError> {
    let item = usize::try_from(index)
        .ok()
        .and_then(|i| source.items.get(i));
    let Some(item) = item else {
        let expected = format!("an index below {}", source.scenes());
        return Err(ImportError::refused(
            &source.root,
            "scene",
            expected,
            index.to_string(),
            "choose another one",
        ));
    };
    let (options, files) = (&source.options, Files::new(&source.root, &source.opener));
    let mut scene = match source.format {
        Format::Sb3d => sb3d::read(item, options, &files),
        Format::Platonerf => platonerf::read(item, options, &files),
        Format::BfLidar => bf_lidar::read(item, options, &files),
        Format::Npy => npy_folder::read(item, options, &files),
    }?;
    scene.files = files.into_list();
    if let Some((field, first, this)) = source.shape.difference(&scene.shape) {
        let expected = format!("{first}, as in scene {}", source.items[0].name);
        let hint = "import scenes of other shapes into a data set of their own";
        return Err(ImportError::refused(
            &item.folder,
            field,
            expected,
            this,
            hint,
        ));
    }
    Ok(scene)
}

fn find(
    root: &Path,
    format: Format,
    options: &ImportOptions,
    opener: &Opener,
) -> Result<Vec<Item>, ImportError> {
    match format {
        Format::Sb3d => sb3d::find(root, opener),
        Format::Platonerf => platonerf::find(root, options, opener),
        Format::BfLidar => bf_lidar::find(root, options, opener),
        Format::Npy => npy_folder::find(root, opener),
    }
}

fn detect(
    root: &Path,
    options: &ImportOptions,
    opener: &Opener,
) -> Result<(Format, Vec<Item>), ImportError> {
    let mut found = Vec::new();
    for format in Format::ALL {
        let items = find(root, format, options, opener)?;
        if !items.is_empty() {
            found.push((format, items));
        }
    }
    if found.len() == 1 {
        return Ok(found.remove(0));
    }
    let names: Vec<&str> = found.iter().map(|(f, _)| f.name()).collect();
    let expected: Vec<String> = Format::ALL
        .iter()
        .map(|f| format!("{} ({})", f.name(), looks_like(*f)))
        .collect();
    let expected = format!("scenes in one of the layouts {}", expected.join(", "));
    let found = match names.is_empty() {
        true => "none of them".into(),
        false => names.join(" and "),
    };
    let hint = "check the folder, or say which with --format";
    Err(ImportError::refused(
        root, "contents", expected, found, hint,
    ))
}

fn looks_like(format: Format) -> &'static str {
    match format {
        Format::Sb3d => "lidar_4.exr, lidar_25.exr or lidar_100.exr in a folder for each scene",
        Format::Platonerf => "transforms_train.json next to the folder of .npy captures",
        Format::BfLidar => "spot_1.mat and so on next to a detector_scan*.mat",
        Format::Npy => "scene.json in a folder for each scene",
    }
}

/// Returns the folders for which `is_scene` is true: the root itself, or those in it.
fn folders_with(
    root: &Path,
    opener: &Opener,
    is_scene: impl Fn(&Path) -> bool,
) -> Result<Vec<Item>, ImportError> {
    if is_scene(root) {
        return Ok(vec![Item::new(root, root.to_owned(), opener)]);
    }
    let (folders, _) = files::entries(root)?;
    let mut scenes = Vec::new();
    for folder in folders.into_iter().filter(|f| is_scene(f)) {
        opener.check(&folder)?;
        scenes.push(Item::new(root, folder, opener));
    }
    Ok(scenes)
}

/// Returns the named items, in that order.
fn choose(root: &Path, items: Vec<Item>, names: &[String]) -> Result<Vec<Item>, ImportError> {
    let mut by_name: std::collections::BTreeMap<String, Item> =
        items.into_iter().map(|i| (i.name.clone(), i)).collect();
    let take = |name: &String| {
        by_name.remove(name).ok_or_else(|| {
            let hint = "correct the list: each scene once, named by its folder";
            ImportError::refused(
                root,
                "scene",
                format!("{name:?}"),
                "no such folder, or listed twice",
                hint,
            )
        })
    };
    names.iter().map(take).collect()
}
