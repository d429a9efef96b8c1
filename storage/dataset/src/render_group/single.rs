//! A single render: a data set of one scene in a local folder. The group `render` in it has what
//! data sets lack: settings, and arrays of the renderer's own. `preview.png` shows the scene.

use std::fs;
use std::path::Path;
use std::sync::Arc;

use object_store::local::LocalFileSystem;
use object_store::path::Path as Key;
use serde_json::{Map, Value};

use crate::layout::spec::DatasetSpec;
use crate::render_group::read::RenderGroup;
use crate::render_group::write::{NewFolder, RenderArray, check, write_into};
use crate::scenes::dataset::Dataset;
use crate::scenes::encode::EncodedScene;
use picofarm_store::StorageError;

/// Name of the picture in the folder of a single render.
pub const SINGLE_PICTURE: &str = "preview.png";
/// Name of the group with the parts that data sets lack.
const GROUP: &str = "render";

/// The parts of a single render that data sets lack.
#[derive(Debug, Clone, Copy)]
pub struct SingleRenderParts<'a> {
    /// Arrays of the group `render`.
    pub arrays: &'a [RenderArray<'a>],
    /// Attributes of the group `render`.
    pub attributes: &'a Map<String, Value>,
    /// The picture, as PNG.
    pub picture: &'a [u8],
}

/// Writes a data set of the scene 0 that `encode` returns to the new folder `dir`. The write is
/// atomic: the data set is written to a temporary folder next to `dir` and renamed.
///
/// # Errors
/// [`StorageError::Invalid`] for an unsuitable specification, scene or array, and if `dir` exists
/// and is not empty (nothing is overwritten); [`StorageError::Io`]; [`StorageError::Store`].
pub async fn write_single_render(
    dir: &Path,
    spec: &DatasetSpec,
    encode: impl FnOnce(&Dataset) -> Result<EncodedScene, StorageError>,
    parts: &SingleRenderParts<'_>,
) -> Result<(), StorageError> {
    check(parts.arrays)?;
    let folder = NewFolder::begin(dir)?;
    let store = Arc::new(local(folder.path())?);
    let dataset = Dataset::create_or_open(store, Key::default(), spec).await?;
    let scene = encode(&dataset)?;
    write_into(&folder.path().join(GROUP), parts.arrays, parts.attributes)?;
    let picture = folder.path().join(SINGLE_PICTURE);
    fs::write(&picture, parts.picture).map_err(|e| StorageError::io("write", &picture, e))?;
    dataset.publish_encoded(scene).await?;
    folder.finish()
}

/// A single render in a local folder.
#[derive(Debug, Clone)]
pub struct SingleRender {
    /// The data set; its scene is 0.
    pub dataset: Dataset,
    /// The parts that data sets lack.
    pub group: RenderGroup,
}

impl SingleRender {
    /// Opens the render in `dir` without changing it.
    ///
    /// # Errors
    /// [`StorageError::Io`] without such a folder, [`StorageError::NoDataset`],
    /// [`StorageError::Damaged`], [`StorageError::Invalid`] for metadata that cannot be read.
    pub async fn open(dir: &Path) -> Result<Self, StorageError> {
        let group = RenderGroup::open(&dir.join(GROUP))?;
        let dataset = Dataset::open(Arc::new(local(dir)?), Key::default()).await?;
        Ok(Self { dataset, group })
    }

    /// Returns whether `dir` has the parts of a single render.
    pub fn is_in(dir: &Path) -> bool {
        dir.join(GROUP).is_dir()
    }
}

fn local(dir: &Path) -> Result<LocalFileSystem, StorageError> {
    LocalFileSystem::new_with_prefix(dir)
        .map_err(|e| StorageError::store("open", dir.display().to_string(), e))
}

/// Returns whether an object belongs to a single render, outside of its data set's arrays.
pub(crate) fn is_of_single(key: &str) -> bool {
    key == SINGLE_PICTURE || key.strip_prefix(GROUP).is_some_and(|k| k.starts_with('/'))
}
