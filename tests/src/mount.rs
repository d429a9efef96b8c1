//! A file system of a given size, for tests with full or read-only disks. Needs root.

use std::{
    path::{Path, PathBuf},
    process::Command,
};

use crate::wait::until;

/// A tmpfs, unmounted on drop.
pub struct Tmpfs(PathBuf);

impl Tmpfs {
    /// Mounts a tmpfs of `kib` KiB at the new folder `path`. Prints the reason and returns `None`
    /// if the system does not allow it.
    ///
    /// # Panics
    /// If the folder cannot be created.
    pub fn mount(path: &Path, kib: u64) -> Option<Self> {
        std::fs::create_dir(path).expect("the test's folder is writable");
        let size = format!("size={kib}k");
        let tried = Command::new("mount")
            .args(["-t", "tmpfs", "-o", &size, "picofarm-test"])
            .arg(path)
            .output();
        match tried {
            Ok(output) if output.status.success() => Some(Self(path.to_owned())),
            Ok(output) => {
                let why = String::from_utf8_lossy(&output.stderr);
                eprintln!("skipped: a tmpfs cannot be mounted here ({})", why.trim());
                None
            }
            Err(e) => {
                eprintln!("skipped: there is no `mount` ({e})");
                None
            }
        }
    }

    /// Changes its options, e.g. `ro` or `size=1000k`.
    ///
    /// # Panics
    /// If the system refuses.
    pub fn remount(&self, options: &str) {
        assert!(self.try_remount(options), "remount,{options}");
    }

    /// Changes its options. Returns `false` if the system refuses, as it does `ro` while a file is
    /// open for writing.
    ///
    /// # Panics
    /// If there is no `mount`.
    fn try_remount(&self, options: &str) -> bool {
        let output = Command::new("mount")
            .args(["-o", &format!("remount,{options}")])
            .arg(&self.0)
            .output();
        output.expect("there is `mount`").status.success()
    }

    /// Makes it read-only. Retries until no file is open for writing, because the system refuses
    /// otherwise.
    ///
    /// # Panics
    /// If the system refuses for too long.
    pub fn forbid_writes(&self) {
        until("a moment in which nobody writes", || {
            self.try_remount("ro").then_some(())
        });
    }

    /// Leaves at most `kib` KiB free until [`Tmpfs::widen`]. Others may be writing at the same
    /// time. If more is in use than counted, the system refuses the size, and the space is counted
    /// again.
    ///
    /// # Panics
    /// If the system refuses for too long.
    pub fn fill(&self, kib: u64) {
        until("a size that the system takes", || {
            self.try_remount(&format!("size={}k", self.used_kib() + kib))
                .then_some(())
        });
    }

    /// Sets its size to `mib` MiB.
    ///
    /// # Panics
    /// If the system refuses.
    pub fn widen(&self, mib: u64) {
        self.remount(&format!("size={mib}m"));
    }

    /// Covers it with an empty file system, as if it were not mounted, until the value is dropped.
    ///
    /// # Panics
    /// If the system refuses.
    pub fn cover(&self) -> Cover {
        let status = Command::new("mount")
            .args(["-t", "tmpfs", "-o", "size=64m", "picofarm-test-cover"])
            .arg(&self.0)
            .status();
        assert!(status.expect("there is `mount`").success(), "cover");
        Cover(self.0.clone())
    }

    /// Returns the KiB in use.
    ///
    /// # Panics
    /// If `df` does not report them.
    pub fn used_kib(&self) -> u64 {
        let output = Command::new("df")
            .args(["--output=used", "-k"])
            .arg(&self.0)
            .output();
        let text = String::from_utf8(output.expect("there is `df`").stdout).expect("numbers");
        text.lines()
            .last()
            .and_then(|l| l.trim().parse().ok())
            .expect("df prints a number")
    }
}

/// An empty file system over another one.
pub struct Cover(PathBuf);

impl Drop for Cover {
    fn drop(&mut self) {
        // Lazily, because a process may have a file open in it.
        let _ = Command::new("umount").arg("-l").arg(&self.0).status();
    }
}

impl Drop for Tmpfs {
    fn drop(&mut self) {
        // Lazily, because a process that still runs in it must not keep the mount alive. A failure
        // is ignored.
        let _ = Command::new("umount").arg("-l").arg(&self.0).status();
    }
}
