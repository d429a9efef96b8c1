//! Exports data sets for other people: packed into few files, or in a layout that their tools
//! support. Every export ends with a data card, a table of its scenes and Croissant metadata
//! (`card.rs`). An interrupted export can be resumed: files are put create-only, and equal ones
//! count as written.

mod card;
#[cfg(feature = "formats")]
mod exr;
#[cfg(feature = "formats")]
mod hdf5;
mod packed;
mod plain;
mod sb3d;
mod webdataset;
#[cfg(not(feature = "formats"))]
mod without_formats;

use bytes::Bytes;
use object_store::ObjectStore;
use object_store::path::Path;
use sha2::{Digest, Sha256};

use picofarm_dataset::Dataset;
use picofarm_dataset::Manifest;
use picofarm_dataset::Quantity;
use picofarm_store::StorageError;
use picofarm_store::{folder, objects};

#[cfg(feature = "formats")]
use hdf5::file as hdf5_file;
pub(crate) use sb3d::{ASIDE, Aside};
#[cfg(not(feature = "formats"))]
use without_formats::file as hdf5_file;

use card::Row;

/// Number of scenes in a tar file of [`ExportFormat::WebDataset`].
const TAR: usize = 8;

/// Statistics of a finished export.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Exported {
    /// Number of scenes.
    pub scenes: u64,
    /// Number of files.
    pub files: u64,
    /// Total size in bytes.
    pub bytes: u64,
    /// SHA-256 over the names and contents of the files, in the order of writing.
    pub sha256: [u8; 32],
}

/// Layouts of an export.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum ExportFormat {
    /// Zarr v3 with 16 scenes per file. Chunks are copied without decoding.
    #[default]
    Zarr,
    /// The paper's release: a folder per scene, with histograms as half-precision OpenEXR images.
    Sb3d,
    /// Tar files of 8 scenes, with an `.npz` and a `.json` each, for the `webdataset` library.
    WebDataset,
    /// One HDF5 file per scene, with shuffle and gzip.
    Hdf5,
}

impl ExportFormat {
    /// All formats.
    pub const ALL: [Self; 4] = [Self::Zarr, Self::Sb3d, Self::WebDataset, Self::Hdf5];

    /// Returns its name in job files and on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Zarr => "zarr",
            Self::Sb3d => "sb3d",
            Self::WebDataset => "webdataset",
            Self::Hdf5 => "hdf5",
        }
    }

    /// Returns the format called `name`.
    ///
    /// # Errors
    /// A message that lists the valid names.
    pub fn parse(name: &str) -> Result<Self, String> {
        let found = Self::ALL.into_iter().find(|f| f.name() == name);
        found.ok_or_else(|| {
            let names = Self::ALL.map(Self::name).join(", ");
            format!("{name:?} is not one of {names}")
        })
    }
}

/// An export in progress, in any format.
pub struct Exporter<'a> {
    format: ExportFormat,
    source: &'a Dataset,
    scenes: &'a [u64],
    out: Out<'a>,
    rows: Vec<Row>,
}

/// The destination, and a record of the files written.
struct Out<'a> {
    store: &'a dyn ObjectStore,
    prefix: Path,
    done: Exported,
    digest: Sha256,
}

impl Out<'_> {
    async fn put(&mut self, name: &str, bytes: Bytes) -> Result<(), StorageError> {
        self.done.files += 1;
        self.done.bytes += bytes.len() as u64;
        self.digest.update(name);
        self.digest.update([0]);
        self.digest.update(Sha256::digest(&bytes));
        let path = objects::path_of(&self.prefix, name);
        objects::create_or_match(self.store, &path, bytes).await
    }
}

impl<'a> Exporter<'a> {
    /// Exports the given scenes, in that order, to `prefix`.
    ///
    /// # Errors
    /// [`StorageError::Invalid`] if there are no scenes, or the format does not support the data
    /// set: per-spot histograms, or, in the paper's layout, a number of spots other than 4, 25 or
    /// 100.
    pub fn new(
        format: ExportFormat,
        source: &'a Dataset,
        scenes: &'a [u64],
        store: &'a dyn ObjectStore,
        prefix: Path,
    ) -> Result<Self, StorageError> {
        if scenes.is_empty() {
            let what = "expected at least one published scene, found none";
            return Err(StorageError::invalid("scenes", what));
        }
        #[cfg(not(feature = "formats"))]
        without_formats::check(format)?;
        packed::check(source)?;
        if format == ExportFormat::Sb3d {
            sb3d::check(source.spec())?;
        }
        Ok(Self {
            format,
            source,
            scenes,
            out: Out {
                store,
                prefix,
                done: Exported::default(),
                digest: Sha256::new(),
            },
            rows: Vec::new(),
        })
    }

    /// Returns the number of [`Self::step`]s.
    pub fn steps(&self) -> usize {
        match self.format {
            ExportFormat::Zarr => self.scenes.len().div_ceil(packed::PACK),
            ExportFormat::WebDataset => self.scenes.len().div_ceil(TAR),
            ExportFormat::Sb3d | ExportFormat::Hdf5 => self.scenes.len(),
        }
    }

    /// Performs step `k`. Steps must be performed in order.
    ///
    /// # Errors
    /// [`StorageError::Invalid`] if the destination is a folder of another kind;
    /// [`StorageError::NotPublished`] or [`StorageError::Damaged`] for a faulty object of the
    /// source; [`StorageError::Conflict`] if the destination contains different files;
    /// [`StorageError::Store`].
    pub async fn step(&mut self, k: usize) -> Result<(), StorageError> {
        if k == 0 {
            self.check_folder().await?;
        }
        let of = |each: usize| k * each..self.scenes.len().min((k + 1) * each);
        match self.format {
            ExportFormat::Zarr => {
                let scenes = &self.scenes[of(packed::PACK)];
                let file = self.source.array(Quantity::Transient).layout.key(k as u64);
                for manifest in packed::pack(self.source, scenes, k, &mut self.out).await? {
                    let row = Row::new(self.rows.len(), &manifest, &file);
                    self.rows.push(row);
                }
            }
            ExportFormat::Sb3d => {
                let scene = self.scenes[k];
                let folder = format!("{scene:06}");
                for (name, bytes) in sb3d::scene_files(self.source, scene).await? {
                    self.out.put(&format!("{folder}/{name}"), bytes).await?;
                }
                let manifest = self.source.manifest(scene).await?;
                // The slash prevents table readers from parsing the name as a number.
                self.note(&manifest, &format!("{folder}/"));
            }
            ExportFormat::Hdf5 => {
                let scene = plain::decode(self.source, self.scenes[k]).await?;
                let name = format!("{:06}.h5", self.scenes[k]);
                self.out
                    .put(&name, hdf5_file(&scene, self.source.spec())?.into())
                    .await?;
                self.note(&scene.manifest, &name);
            }
            ExportFormat::WebDataset => {
                let name = format!("scenes-{k:06}.tar");
                let mut tar = webdataset::Tar::new();
                for scene in &self.scenes[of(TAR)] {
                    let scene = plain::decode(self.source, *scene).await?;
                    tar.add(&scene, self.source.spec())?;
                    self.note(&scene.manifest, &name);
                }
                self.out.put(&name, tar.finish()?.into()).await?;
            }
        }
        Ok(())
    }

    /// Checks that the destination is empty, contains a finished export (with the metadata of every
    /// export), or an interrupted one of this format.
    async fn check_folder(&self) -> Result<(), StorageError> {
        let (store, prefix) = (self.out.store, &self.out.prefix);
        let names = folder::names(store, prefix).await?;
        if names.iter().any(|name| name == card::CROISSANT) {
            return Ok(());
        }
        match names.iter().find(|name| !self.writes(name)) {
            None => Ok(()),
            Some(name) => Err(folder::foreign(store, prefix, "export.dest", name)),
        }
    }

    /// Returns whether an export of this format writes such a name before its Croissant metadata.
    fn writes(&self, name: &str) -> bool {
        let scene = |text: &str| text.len() >= 6 && text.bytes().all(|b| b.is_ascii_digit());
        if name == card::TABLE {
            return true;
        }
        match self.format {
            ExportFormat::Zarr => packed::writes(self.source, name),
            ExportFormat::Sb3d => scene(name),
            ExportFormat::Hdf5 => name.strip_suffix(".h5").is_some_and(scene),
            ExportFormat::WebDataset => {
                let number = name.strip_prefix("scenes-");
                number
                    .and_then(|n| n.strip_suffix(".tar"))
                    .is_some_and(scene)
            }
        }
    }

    fn note(&mut self, manifest: &Manifest, file: &str) {
        self.rows.push(Row::new(self.rows.len(), manifest, file));
        self.out.done.scenes += 1;
    }

    /// Writes the files of the whole export, after all steps.
    ///
    /// # Errors
    /// [`StorageError::Conflict`], [`StorageError::Store`].
    pub async fn finish(mut self) -> Result<Exported, StorageError> {
        let name = self.source.prefix().filename().unwrap_or("transients");
        for (file, bytes) in card::files(name, self.format, self.source.spec(), &self.rows) {
            self.out.put(file, bytes.into()).await?;
        }
        if self.format == ExportFormat::Zarr {
            packed::finish(self.source, self.scenes, &mut self.out).await?;
        }
        self.out.done.sha256 = self.out.digest.finalize().into();
        Ok(self.out.done)
    }
}
