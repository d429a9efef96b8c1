//! Restricts which files may be opened, and opens them.

use std::{
    fs::{File, OpenOptions},
    io::{Error, ErrorKind},
    path::{Path, PathBuf},
    sync::Arc,
};

use crate::{FileError, read_bounded};

/// Maximum length of a file name in bytes. No system opens longer names, and resolving a path takes
/// time for each component.
const MAX_NAME: usize = 4096;

/// Opens regular files inside the given folders, after resolving symbolic links.
///
/// Hard links cannot be distinguished from files, so anyone who may write to an allowed folder
/// decides what can be opened in it.
#[derive(Debug, Clone, Default)]
pub struct Opener {
    /// A file must be inside one folder of every set.
    sets: Vec<Arc<[PathBuf]>>,
}

impl Opener {
    /// Returns an opener without restrictions.
    pub fn anywhere() -> Self {
        Self::default()
    }

    /// Returns an opener with the same restrictions, and additionally restricted to files inside
    /// `folders`. Folders are resolved to their real paths; a missing folder contains nothing.
    #[must_use]
    pub fn within<P: AsRef<Path>>(&self, folders: impl IntoIterator<Item = P>) -> Self {
        let mut sets = self.sets.clone();
        sets.push(folders.into_iter().map(|f| real(f.as_ref())).collect());
        Self { sets }
    }

    /// Resolves `name` relative to `folder`.
    ///
    /// # Errors
    /// [`FileError::Name`] for URLs, for names with a backslash or a NUL, and for names longer than
    /// 4096 bytes.
    pub fn named(folder: &Path, name: &str) -> Result<PathBuf, FileError> {
        let why = if name.len() > MAX_NAME {
            "it is longer than 4096 bytes"
        } else if name.contains('\\') {
            "it has a backslash"
        } else if name.contains('\0') {
            "it has a NUL"
        } else if name.contains("://") || name.starts_with("file:") {
            "it is a URL"
        } else if name.is_empty() {
            "it is empty"
        } else {
            return Ok(folder.join(name));
        };
        let name = name.chars().take(80).collect::<String>();
        let name = name.replace('\0', "\\0");
        Err(FileError::Name { name, why })
    }

    /// Opens a regular file.
    ///
    /// # Errors
    /// [`FileError::Outside`], even if no such file exists outside; [`FileError::Io`].
    pub fn open(&self, path: &Path) -> Result<File, FileError> {
        self.check(path)?;
        let failed = |e| FileError::io(path, e);
        let place = path.canonicalize().map_err(failed)?;
        self.allows(path, &place)?;
        // Do not block on a device or pipe, and do not follow a symbolic link created after the
        // check.
        let flags = rustix::fs::OFlags::NONBLOCK | rustix::fs::OFlags::NOFOLLOW;
        let mut options = OpenOptions::new();
        options.read(true);
        std::os::unix::fs::OpenOptionsExt::custom_flags(&mut options, flags.bits() as i32);
        let file = options.open(&place).map_err(failed)?;
        if !file.metadata().map_err(failed)?.is_file() {
            let what = "is not a file; expected one, and no folder, pipe or device";
            return Err(failed(Error::new(ErrorKind::InvalidInput, what)));
        }
        // Folders on the path may have been swapped since the check, so the open file itself is
        // checked.
        self.allows(path, &opened(&file, &place).map_err(failed)?)?;
        Ok(file)
    }

    /// Reads a regular file of at most `most` bytes.
    ///
    /// # Errors
    /// Those of [`Self::open`]; a file larger than `most`.
    pub fn read(&self, path: &Path, most: u64) -> Result<Vec<u8>, FileError> {
        let file = self.open(path)?;
        let failed = |e| FileError::io(path, e);
        let length = file.metadata().map_err(failed)?.len();
        if length > most {
            let what = format!("has {length} bytes, more than the {most} that are read");
            return Err(failed(Error::new(ErrorKind::InvalidInput, what)));
        }
        read_bounded(file, most).map_err(failed)
    }

    /// Checks that a path is inside the allowed folders. It need not exist.
    ///
    /// # Errors
    /// [`FileError::Outside`].
    pub fn check(&self, path: &Path) -> Result<(), FileError> {
        match self.sets.is_empty() {
            true => Ok(()),
            false => self.allows(path, &real(path)),
        }
    }

    fn allows(&self, path: &Path, place: &Path) -> Result<(), FileError> {
        let refused = self
            .sets
            .iter()
            .find(|set| !set.iter().any(|folder| place.starts_with(folder)));
        let Some(set) = refused else { return Ok(()) };
        let names: Vec<String> = set.iter().map(|f| f.display().to_string()).collect();
        Err(FileError::Outside {
            path: path.to_owned(),
            allowed: match names.is_empty() {
                true => "all folders that may be read".into(),
                false => names.join(" and "),
            },
        })
    }
}

/// Returns the real path. For a path that does not exist, resolves its existing part, so that the
/// answer reveals nothing about files elsewhere.
fn real(path: &Path) -> PathBuf {
    let mut there = std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
    let mut rest = Vec::new();
    loop {
        if let Ok(place) = there.canonicalize() {
            return rest.iter().rev().fold(place, |place, part: &PathBuf| {
                // A path that does not exist has no links, so `..` removes a component.
                match part.as_os_str() == ".." {
                    true => place.parent().unwrap_or(Path::new("/")).to_owned(),
                    false => place.join(part),
                }
            });
        }
        // A dangling link is followed as far as possible.
        if let Ok(target) = std::fs::read_link(&there)
            && rest.len() < 40
        {
            let parent = there.parent().unwrap_or(Path::new("/"));
            let target = parent.join(target);
            if target != there {
                rest.push(PathBuf::new());
                there = target;
                continue;
            }
        }
        let last = there.components().next_back();
        match (there.parent(), last) {
            (Some(parent), Some(part)) => {
                rest.push(PathBuf::from(part.as_os_str()));
                there = parent.to_owned();
            }
            _ => return PathBuf::from("/"),
        }
    }
}

/// Returns the path of an open file, from the operating system if possible, or otherwise by
/// resolving its path again.
fn opened(file: &File, place: &Path) -> Result<PathBuf, Error> {
    use std::os::{fd::AsRawFd, unix::fs::MetadataExt};
    let link = format!("/proc/self/fd/{}", file.as_raw_fd());
    if let Ok(path) = std::fs::read_link(link) {
        return Ok(path);
    }
    let (ours, now) = (file.metadata()?, std::fs::symlink_metadata(place)?);
    match place.canonicalize()? == place && (ours.dev(), ours.ino()) == (now.dev(), now.ino()) {
        true => Ok(place.to_owned()),
        false => Err(Error::other("was replaced while it was opened; try again")),
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;

    use super::*;

    struct Folder {
        _folder: tempfile::TempDir,
        mine: PathBuf,
        secret: PathBuf,
    }

    fn folder() -> Folder {
        let folder = tempfile::tempdir().unwrap();
        let (mine, other) = (folder.path().join("mine"), folder.path().join("other"));
        std::fs::create_dir_all(mine.join("sub")).unwrap();
        std::fs::create_dir_all(&other).unwrap();
        std::fs::write(mine.join("a"), "a").unwrap();
        std::fs::write(mine.join("sub/b"), "b").unwrap();
        let secret = other.join("secret");
        std::fs::write(&secret, "secret").unwrap();
        Folder {
            _folder: folder,
            mine,
            secret,
        }
    }

    #[test]
    fn what_lies_below_is_opened_however_it_is_named() {
        let p = folder();
        symlink(p.mine.join("a"), p.mine.join("sub/link")).unwrap();
        symlink(p.mine.join("sub"), p.mine.join("folder")).unwrap();
        let files = Opener::anywhere().within([&p.mine]);
        for name in ["a", "sub/../a", "./a", "sub/link", "folder/b"] {
            assert!(files.read(&p.mine.join(name), 10).is_ok(), "{name}");
        }
        assert!(files.read(&p.mine.join("a"), 0).is_err());
        assert!(Opener::anywhere().read(&p.secret, 10).is_ok());
    }

    #[test]
    fn no_trick_leads_outside() {
        let p = folder();
        symlink(&p.secret, p.mine.join("file")).unwrap();
        symlink(p.secret.parent().unwrap(), p.mine.join("folder")).unwrap();
        symlink("../other/secret", p.mine.join("relative")).unwrap();
        symlink("../other/nothing", p.mine.join("dangling")).unwrap();
        symlink("loop", p.mine.join("loop")).unwrap();
        let files = Opener::anywhere().within([&p.mine]);
        let outside = |name: &str| {
            let refused = files.open(&p.mine.join(name)).unwrap_err();
            assert!(
                matches!(refused, FileError::Outside { .. }),
                "{name}: {refused}"
            );
        };
        for name in [
            "file",
            "folder/secret",
            "relative",
            "dangling",
            "../other/secret",
            "sub/../../other/secret",
            "nothing/../../other/secret",
            "folder/nothing",
            "../other/nothing",
            "../mine-too/a",
            "/etc/passwd",
            "/etc/nothing",
            "//server/share",
            "",
        ] {
            if name.is_empty() {
                continue;
            }
            outside(name);
        }
        outside(&p.secret.display().to_string());
        for name in ["loop", "sub", "nothing"] {
            assert!(files.open(&p.mine.join(name)).is_err(), "{name}");
        }
        // Both sets must contain the file.
        let both = files.within([p.mine.join("sub")]);
        assert!(both.open(&p.mine.join("sub/b")).is_ok());
        assert!(both.open(&p.mine.join("a")).is_err());
        let none = Opener::anywhere().within::<&Path>([]);
        assert!(none.open(&p.mine.join("a")).is_err());
    }

    #[test]
    fn pipes_and_devices_are_neither_waited_for_nor_read() {
        let p = folder();
        let pipe = p.mine.join("pipe");
        let made = std::process::Command::new("mkfifo").arg(&pipe).status();
        assert!(made.unwrap().success());
        for path in [&pipe, Path::new("/dev/zero"), &p.mine] {
            let said = Opener::anywhere().read(path, 10).unwrap_err().to_string();
            assert!(said.contains("is not a file"), "{said}");
        }
    }

    #[test]
    fn names_that_are_no_plain_paths_are_refused() {
        let folder = Path::new("/x");
        for name in [
            "a\\b",
            "\\\\server\\share\\a",
            "a\0b",
            "file:///etc/passwd",
            "file:/etc/passwd",
            "http://example/a",
            "",
            &"a/".repeat(32_000),
        ] {
            let refused = Opener::named(folder, name).unwrap_err();
            assert!(!refused.to_string().contains('\0'));
            assert!(refused.to_string().len() < 500, "{refused}");
        }
        assert_eq!(
            Opener::named(folder, "meshes/a.ply").unwrap(),
            Path::new("/x/meshes/a.ply")
        );
    }
}
