//! Reads the folders of `scene render`, and of `scene sense`, for other commands.

use std::path::Path;

use futures::executor::block_on;
use picofarm_dataset::{Quantity, RenderGroup, SingleRender, Stored};
use picofarm_store::StorageError;
use serde::de::DeserializeOwned;
use serde_json::{Map, Value};

use crate::error::{CliError, Code, Result};

/// A folder of `scene render` or of `scene sense`. Its readers block; the caller is on a thread
/// for blocking work.
pub enum Folder {
    Render(SingleRender),
    Sensed(RenderGroup),
}

impl Folder {
    /// Opens a render, or what a sensor measured of one.
    ///
    /// # Errors
    /// Fails on another folder, or on damaged metadata.
    pub fn open(dir: &Path) -> Result<Self> {
        let opened = match SingleRender::is_in(dir) {
            true => block_on(SingleRender::open(dir)).map(Self::Render),
            false => RenderGroup::open(dir).map(Self::Sensed),
        };
        opened.map_err(|e| unreadable(dir, e))
    }

    /// Returns the attributes that say how the render was made.
    pub fn attributes(&self) -> &Map<String, Value> {
        match self {
            Self::Render(render) => render.group.attributes(),
            Self::Sensed(group) => group.attributes(),
        }
    }

    /// Parses an attribute.
    ///
    /// # Errors
    /// Names the attribute.
    pub fn attribute<T: DeserializeOwned>(&self, dir: &Path, name: &str) -> Result<T> {
        let value = self.attributes().get(name).cloned().unwrap_or(Value::Null);
        serde_json::from_value(value).map_err(|e| {
            let file = match self {
                Self::Render(_) => dir.join("render/zarr.json"),
                Self::Sensed(_) => dir.join("zarr.json"),
            };
            CliError::input(format!("{}: attributes.{name}: {e}", file.display())).hint(HINT)
        })
    }
}

/// Reads an array of a group, which must have this shape.
///
/// # Errors
/// Names the array.
pub fn array<T: Stored + Send + Sync>(
    dir: &Path,
    group: &RenderGroup,
    name: &str,
    expected: &[u64],
) -> Result<Vec<T>> {
    let (shape, values) = group.read(name).map_err(|e| unreadable(dir, e))?;
    if shape != expected {
        let what = format!(
            "{}: the array {name} has the shape {shape:?}, but camera, gate and spots say {expected:?}",
            dir.display()
        );
        return Err(CliError::input(what).hint("render the scene again"));
    }
    Ok(values)
}

/// Reads the histogram of all spots of a render.
///
/// # Errors
/// Names the damaged object.
pub fn transient(dir: &Path, render: &SingleRender) -> Result<Vec<f32>> {
    block_on(render.dataset.read_transient(0)).map_err(|e| unreadable(dir, e))
}

/// Reads an image of a render.
///
/// # Errors
/// Names the damaged object.
pub fn image<T: Stored>(dir: &Path, render: &SingleRender, quantity: Quantity) -> Result<Vec<T>> {
    block_on(render.dataset.read(0, quantity)).map_err(|e| unreadable(dir, e))
}

/// Reads the masks of a render, `[spot][row][column]`.
///
/// # Errors
/// Names the damaged object.
pub fn masks(dir: &Path, render: &SingleRender) -> Result<Vec<u8>> {
    block_on(render.dataset.read_visibility(0)).map_err(|e| unreadable(dir, e))
}

const HINT: &str = "expected a folder that `picofarm scene render FILE --out FOLDER` or `picofarm scene sense` wrote";

/// Returns the error of a command for a folder that cannot be read.
pub fn unreadable(dir: &Path, error: StorageError) -> CliError {
    let code = match &error {
        StorageError::Codec { .. } | StorageError::Damaged { .. } => Code::Damaged,
        _ => Code::Input,
    };
    CliError::new(code, format!("{}: {error}", dir.display())).hint(HINT)
}
