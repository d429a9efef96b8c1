//! The environment in which a job is submitted. Submission fills in the inputs of its tasks that
//! are only known there.

mod listed;

use std::path::{Component, Path, PathBuf};

use picofarm_dataset::Profile;
use picofarm_proto::spec::{SceneKind, SceneSource, SpecError};
use picofarm_scene::{
    AssetLibrary,
    import::{Bounds, fingerprint},
};
use picofarm_store::check_location;

/// The environment in which a job is submitted.
#[derive(Debug, Clone, Copy)]
pub struct Submission<'a> {
    /// Base folder of relative paths.
    pub base: &'a Path,
    /// Folders with furniture.
    pub assets: &'a [PathBuf],
}

impl Submission<'_> {
    /// Returns a store's absolute location. An empty one stays empty.
    pub(crate) fn store(&self, field: &str, text: &str) -> Result<String, SpecError> {
        if text.is_empty() {
            return Ok(String::new());
        }
        // Checks the location as written, because resolved against the job file's folder, a
        // mistyped URL would look like a folder.
        check_location(text).map_err(|e| SpecError::new(field, e.to_string()))?;
        match text.contains("://") {
            true => Ok(text.to_owned()),
            false => Ok(self.path(field, text)?.display().to_string()),
        }
    }

    /// Returns an absolute path.
    pub(crate) fn path(&self, field: &str, text: &str) -> Result<PathBuf, SpecError> {
        absolute(self.base, text).map_err(|e| SpecError::new(field, e))
    }

    /// Checks the name of a codec profile.
    #[expect(clippy::unused_self, reason = "as the other checks are called")]
    pub(crate) fn profile(&self, name: &str) -> Result<(), SpecError> {
        Profile::parse(name)
            .map(|_| ())
            .map_err(|e| SpecError::new("output.profile", e))
    }

    /// Pins furniture and the content of files.
    pub(crate) fn scenes(&self, source: &mut SceneSource) -> Result<(), SpecError> {
        let (files, root) = match &mut source.kind {
            SceneKind::Furnished { assets, .. } => {
                let library = AssetLibrary::named(assets, self.assets)
                    .map_err(|e| SpecError::new("scenes.assets", e.to_string()))?;
                library.fingerprint().clone_into(assets);
                return Ok(());
            }
            SceneKind::Primitive { .. } => return Ok(()),
            SceneKind::Files { files, root, .. } => (files, root),
        };
        if let Some(root) = root {
            *root = self.path("scenes.root", root)?.display().to_string();
        }
        let bounds = within(root.as_deref());
        let mut all = Vec::with_capacity(files.len());
        for (i, file) in std::mem::take(files).into_iter().enumerate() {
            let field = format!("scenes.files[{i}]");
            match file.sha256.is_empty() {
                true => all.extend(listed::files(&field, &self.path(&field, &file.path)?)?),
                false => all.push(file),
            }
        }
        *files = all;
        source.count = files.len() as u64;
        for (i, file) in files.iter_mut().enumerate() {
            let field = format!("scenes.files[{i}]");
            let path = self.path(&field, &file.path)?;
            let hash =
                fingerprint(&path, &bounds).map_err(|e| SpecError::new(&*field, e.to_string()))?;
            if !file.sha256.is_empty() && file.sha256 != hash {
                let what = format!(
                    "{} has SHA-256 {hash}, the job says {}",
                    path.display(),
                    file.sha256
                );
                return Err(SpecError::new(field, what));
            }
            file.sha256 = hash;
            file.path = path.display().to_string();
        }
        Ok(())
    }
}

fn within(root: Option<&str>) -> Bounds {
    Bounds {
        root: root.map(PathBuf::from),
        ..Bounds::default()
    }
}

/// Pins scene files by the content that they have now. Returns the positions of those that had
/// another one.
///
/// # Errors
/// A file that cannot be read on this machine.
pub fn repin(source: &mut SceneSource) -> Result<Vec<usize>, SpecError> {
    let SceneKind::Files { files, root, .. } = &mut source.kind else {
        return Ok(Vec::new());
    };
    let bounds = within(root.as_deref());
    let mut changed = Vec::new();
    for (i, file) in files.iter_mut().enumerate() {
        let hash = fingerprint(Path::new(&file.path), &bounds)
            .map_err(|e| SpecError::new(format!("scenes.files[{i}]"), e.to_string()))?;
        if file.sha256 != hash {
            file.sha256 = hash;
            changed.push(i);
        }
    }
    Ok(changed)
}

/// The place that `path` means in `base`, without `.` and `..`: what they mean in a shell. (Jobs on
/// the wire must name places without them: there they would mean another folder to each machine.)
///
/// # Errors
/// Fails if the path is empty, or there is no current folder.
pub fn absolute(base: &Path, path: &str) -> Result<PathBuf, String> {
    if path == "~" || path.starts_with("~/") {
        // Only a shell expands it; here it would create a folder of this name.
        return Err(format!(
            "{path:?}: `~` is not expanded here; write the whole path (or \"./{path}\" for a folder named ~)"
        ));
    }
    let whole = std::path::absolute(base.join(path)).map_err(|e| format!("{path:?}: {e}"))?;
    let mut plain = PathBuf::new();
    for part in whole.components() {
        if part == Component::ParentDir {
            // The parent folder of a link's target differs from that of the link.
            plain = plain.canonicalize().unwrap_or(plain);
            plain.pop();
        } else {
            plain.push(part);
        }
    }
    Ok(plain)
}
