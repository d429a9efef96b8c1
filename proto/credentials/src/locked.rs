//! Changes a file that other processes read and change.
//!
//! One process at a time has the lock, which is on the file itself. The file is replaced atomically
//! by a file with the same owner, group, mode and access list. A reader therefore sees the old
//! content or the new, and can read both.

use std::{
    ffi::OsString,
    fs::{File, OpenOptions, Permissions, TryLockError},
    io::{self, ErrorKind, Write},
    os::unix::fs::{MetadataExt, OpenOptionsExt, PermissionsExt, fchown},
    path::{Path, PathBuf},
    time::{Duration, Instant},
};

use rustix::{
    fs::{XattrFlags, fgetxattr, flistxattr, fremovexattr, fsetxattr},
    io::Errno,
};

use crate::{CredentialError, private, read_at_most};

/// Longest wait for another process that changes the file.
const WAIT: Duration = Duration::from_secs(10);
/// Time between two attempts to get the lock.
const RETRY: Duration = Duration::from_millis(20);
/// Largest extended attribute, and largest list of their names, on Linux.
const LARGEST_ATTRIBUTE: usize = 64 << 10;
/// Name of the attribute with the access list of a file.
const ACCESS_LIST: &str = "system.posix_acl_access";
/// Attributes that belong to the old content. The system creates new ones.
const OF_THE_CONTENT: [&str; 3] = ["security.ima", "security.evm", "security.capability"];

/// A file that no other process changes while this value lives.
#[derive(Debug)]
pub struct LockedFile {
    file: File,
    /// The path with all links resolved, so that replacing the file leaves a link in place.
    place: PathBuf,
    /// Whether this value created the file and has not replaced it. If so, the file is removed
    /// again.
    new: bool,
}

impl LockedFile {
    /// Waits for the lock of an existing file.
    ///
    /// # Errors
    /// Returns an error if the file cannot be opened or is open to everyone, or if another process
    /// keeps its lock for ten seconds.
    pub fn open(path: &Path) -> Result<Self, CredentialError> {
        Self::wait(path, false)
    }

    /// Waits for the lock of a file. A missing file is created with access for its owner only. A
    /// new file is removed again if it is not replaced.
    ///
    /// # Errors
    /// Returns the errors of [`Self::open`], or an error if the file or its folder cannot be
    /// created.
    pub fn open_or_create(path: &Path) -> Result<Self, CredentialError> {
        if let Some(folder) = path.parent().filter(|p| !p.as_os_str().is_empty()) {
            std::fs::create_dir_all(folder).map_err(|e| CredentialError::write(path, e))?;
        }
        Self::wait(path, true)
    }

    fn wait(path: &Path, create: bool) -> Result<Self, CredentialError> {
        let until = Instant::now() + WAIT;
        loop {
            if let Some(locked) = Self::attempt(path, create)? {
                return Ok(locked);
            }
            if Instant::now() > until {
                return Err(CredentialError::unusable(
                    path,
                    format!(
                        "another process has kept its lock for {} s; wait for that process or end it, then try again",
                        WAIT.as_secs()
                    ),
                ));
            }
            std::thread::sleep(RETRY);
        }
    }

    /// Returns `None` if another process has the lock, or replaced the file before this one got it.
    fn attempt(path: &Path, create: bool) -> Result<Option<Self>, CredentialError> {
        let failed = |e: io::Error| CredentialError::write(path, e);
        let mut options = OpenOptions::new();
        // A pipe must not block.
        let flags = rustix::fs::OFlags::NONBLOCK.bits().cast_signed();
        options.read(true).write(true).custom_flags(flags);
        let (file, new) = match options.open(path) {
            Ok(file) => (file, false),
            Err(e) if create && e.kind() == ErrorKind::NotFound => {
                match options.create_new(true).mode(0o600).open(path) {
                    Ok(file) => (file, true),
                    Err(e) if e.kind() == ErrorKind::AlreadyExists => return Ok(None),
                    Err(e) => return Err(failed(e)),
                }
            }
            Err(e) if e.kind() == ErrorKind::NotFound => {
                return Err(CredentialError::read(path, e));
            }
            Err(e) => return Err(failed(e)),
        };
        let ours = file.metadata().map_err(failed)?;
        if !ours.is_file() {
            return Err(CredentialError::unusable(
                path,
                "is not a regular file; give the path of one",
            ));
        }
        match file.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => return Ok(None),
            Err(TryLockError::Error(e)) => return Err(failed(e)),
        }
        let (place, now) = match path.canonicalize().and_then(|p| Ok((p.metadata()?, p))) {
            Ok((now, place)) => (place, now),
            Err(e) if e.kind() == ErrorKind::NotFound => return Ok(None),
            Err(e) => return Err(failed(e)),
        };
        if (now.dev(), now.ino()) != (ours.dev(), ours.ino()) {
            return Ok(None);
        }
        private(path)?;
        Ok(Some(Self { file, place, new }))
    }

    /// Reads the content, of at most `most` bytes.
    ///
    /// # Errors
    /// Returns an error if the file cannot be read, or is larger.
    pub fn read(&self, most: u64) -> Result<Vec<u8>, CredentialError> {
        read_at_most(&self.file, &self.place, most)
    }

    /// Replaces the file atomically and releases the lock. The new file has the old one's owner,
    /// group, mode and extended attributes, which include its access list.
    ///
    /// # Errors
    /// Returns an error if the new file cannot be written, or if this user may not give it the old
    /// one's attributes. The old file then stays.
    pub fn replace(mut self, content: &[u8]) -> Result<(), CredentialError> {
        let failed = |e: io::Error| CredentialError::write(&self.place, e);
        let folder = self.place.parent().unwrap_or(Path::new("/"));
        let mut prefix = OsString::from(".");
        prefix.push(self.place.file_name().unwrap_or_default());
        prefix.push(".");
        let mut next = tempfile::Builder::new()
            .prefix(&prefix)
            .tempfile_in(folder)
            .map_err(failed)?;
        next.write_all(content).map_err(failed)?;
        self.hand_down(next.as_file())?;
        next.as_file().sync_all().map_err(failed)?;
        next.persist(&self.place).map_err(|e| failed(e.error))?;
        self.new = false;
        // Without this, a crash of the machine could restore the old file.
        File::open(folder)
            .and_then(|folder| folder.sync_all())
            .map_err(|e| CredentialError::write(&self.place, e))
    }

    /// Copies this file's metadata to `next`.
    fn hand_down(&self, next: &File) -> Result<(), CredentialError> {
        let failed = |e: io::Error| CredentialError::write(&self.place, e);
        let (old, new) = (
            self.file.metadata().map_err(failed)?,
            next.metadata().map_err(failed)?,
        );
        if (old.uid(), old.gid()) != (new.uid(), new.gid()) {
            fchown(next, Some(old.uid()), Some(old.gid())).map_err(|e| {
                CredentialError::unusable(
                    &self.place,
                    format!(
                        "the new file cannot get the owner and group of the old one ({}:{}): {e}; run this as root or as \
                         the file's owner",
                        old.uid(),
                        old.gid()
                    ),
                )
            })?;
        }
        self.hand_down_attributes(next)?;
        // This follows the access list, because the middle digit of the mode is the list's mask.
        next.set_permissions(Permissions::from_mode(old.mode() & 0o7777))
            .map_err(failed)
    }

    fn hand_down_attributes(&self, next: &File) -> Result<(), CredentialError> {
        let failed = |name: &str, e: Errno| {
            CredentialError::unusable(
                &self.place,
                format!(
                    "the new file cannot get the attribute {name} of the old one: {e}; run this as root or as the file's \
                     owner"
                ),
            )
        };
        let (old, new) = (attributes(&self.file), attributes(next));
        let (old, new) = (
            old.map_err(|e| failed("list", e))?,
            new.map_err(|e| failed("list", e))?,
        );
        for name in old.iter().filter(|n| !OF_THE_CONTENT.contains(&&***n)) {
            let value = attribute(&self.file, name).map_err(|e| failed(name, e))?;
            if !new.contains(name) || attribute(next, name).map_err(|e| failed(name, e))? != value {
                fsetxattr(next, &**name, &value, XattrFlags::empty())
                    .map_err(|e| failed(name, e))?;
            }
        }
        // A folder may give its new files an access list, which the old file does not have.
        if new.iter().any(|n| n == ACCESS_LIST) && !old.iter().any(|n| n == ACCESS_LIST) {
            fremovexattr(next, ACCESS_LIST).map_err(|e| failed(ACCESS_LIST, e))?;
        }
        Ok(())
    }
}

impl Drop for LockedFile {
    fn drop(&mut self) {
        if self.new {
            // The relevant error is the reason why the file was not replaced.
            let _ = std::fs::remove_file(&self.place);
        }
    }
}

/// Returns the names of a file's extended attributes; none if the file system does not support
/// them.
fn attributes(file: &File) -> Result<Vec<String>, Errno> {
    let mut names = Vec::with_capacity(LARGEST_ATTRIBUTE);
    match flistxattr(file, rustix::buffer::spare_capacity(&mut names)) {
        Ok(_) => {}
        Err(Errno::NOTSUP) => return Ok(Vec::new()),
        Err(e) => return Err(e),
    }
    let names = names.split(|b| *b == 0).filter(|name| !name.is_empty());
    Ok(names
        .map(|name| String::from_utf8_lossy(name).into_owned())
        .collect())
}

fn attribute(file: &File, name: &str) -> Result<Vec<u8>, Errno> {
    let mut value = Vec::with_capacity(LARGEST_ATTRIBUTE);
    fgetxattr(file, name, rustix::buffer::spare_capacity(&mut value))?;
    Ok(value)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file(folder: &Path, mode: u32) -> PathBuf {
        let path = folder.join("list");
        std::fs::write(&path, "0").unwrap();
        std::fs::set_permissions(&path, Permissions::from_mode(mode)).unwrap();
        path
    }

    #[test]
    fn changes_at_the_same_moment_are_all_kept() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("list");
        std::thread::scope(|scope| {
            for _ in 0..4 {
                scope.spawn(|| {
                    for _ in 0..10 {
                        let locked = LockedFile::open_or_create(&path).unwrap();
                        let mut content = locked.read(100).unwrap();
                        content.push(b'.');
                        locked.replace(&content).unwrap();
                    }
                });
            }
        });
        assert_eq!(std::fs::read(&path).unwrap().len(), 40);
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 1);
    }

    #[test]
    fn a_replaced_file_keeps_its_mode_attributes_and_the_link_to_it() {
        let folder = tempfile::tempdir().unwrap();
        let path = file(folder.path(), 0o640);
        let link = folder.path().join("link");
        std::os::unix::fs::symlink("list", &link).unwrap();
        let opened = File::open(&path).unwrap();
        let marked = fsetxattr(&opened, "user.origin", b"here", XattrFlags::empty()).is_ok();
        LockedFile::open(&link).unwrap().replace(b"1").unwrap();
        assert!(link.is_symlink());
        assert_eq!(std::fs::read(&path).unwrap(), b"1");
        assert_eq!(path.metadata().unwrap().mode() & 0o7777, 0o640);
        if marked {
            let next = File::open(&path).unwrap();
            assert_eq!(attribute(&next, "user.origin").unwrap(), b"here");
        }
    }

    /// Only root may change a file's owner, so elsewhere the test checks that nothing is replaced.
    #[test]
    fn a_replaced_file_keeps_its_owner_and_group() {
        let folder = tempfile::tempdir().unwrap();
        let path = file(folder.path(), 0o640);
        if std::os::unix::fs::chown(&path, Some(65_534), Some(65_534)).is_err() {
            return;
        }
        LockedFile::open(&path).unwrap().replace(b"1").unwrap();
        let now = path.metadata().unwrap();
        assert_eq!(
            (now.uid(), now.gid(), now.mode() & 0o7777),
            (65_534, 65_534, 0o640)
        );
    }

    #[test]
    fn a_new_file_that_is_not_replaced_is_removed() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("deep/list");
        drop(LockedFile::open_or_create(&path).unwrap());
        assert!(!path.exists());
        assert!(LockedFile::open(&path).is_err());
    }

    #[test]
    fn what_is_not_a_regular_file_is_refused_by_name() {
        for path in ["/dev/zero", "/dev"] {
            let said = LockedFile::open(Path::new(path)).unwrap_err().to_string();
            assert!(said.starts_with(path), "{said}");
        }
    }
}
