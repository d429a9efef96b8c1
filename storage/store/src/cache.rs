//! A bounded cache of objects in a local folder, which several processes may share.
//!
//! Entries are named by the SHA-256 of their object, so a replaced object is never served. Each has
//! a CRC-32C of its own. The folder may be deleted at any time.

use std::{
    fs, io,
    ops::Range,
    path::{Path, PathBuf},
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicU64, Ordering},
    },
    time::{Duration, SystemTime},
};

use bytes::Bytes;

use crate::StorageError;

/// The cache is emptied to this part of its bound, so that it is not listed at each new entry.
const KEPT: f64 = 0.9;
/// A process lists the folder again once it has added this part of the bound, because others add
/// to it, too.
const LISTED_EACH: u64 = 64;
/// The age at which an unfinished entry is one of an ended process.
const ABANDONED: Duration = Duration::from_secs(3600);
const CHECKSUM: usize = 4;

/// A cache of objects and of ranges of them. Clones share it.
#[derive(Debug, Clone)]
pub struct Cache(Arc<Inner>);

#[derive(Debug)]
struct Inner {
    folder: PathBuf,
    most: u64,
    state: Mutex<State>,
    named: AtomicU64,
    trouble: Mutex<Option<String>>,
}

#[derive(Debug, Default)]
struct State {
    /// Bytes in the folder at the last listing, and those added by this process since.
    used: u64,
    added: u64,
}

impl Cache {
    /// Opens a cache of at most about `most` bytes, and creates its folder. Each process may exceed
    /// the bound by a 64th.
    ///
    /// # Errors
    /// [`StorageError::Io`] if the folder cannot be created or listed.
    pub fn open(folder: &Path, most: u64) -> Result<Self, StorageError> {
        let failed = |source| StorageError::io("open the cache", folder, source);
        fs::create_dir_all(folder).map_err(failed)?;
        let inner = Inner {
            folder: folder.to_owned(),
            most,
            state: Mutex::default(),
            named: AtomicU64::new(0),
            trouble: Mutex::default(),
        };
        inner.limit(u64::MAX).map_err(failed)?;
        Ok(Self(Arc::new(inner)))
    }

    /// Returns a range of the object with this SHA-256, if it is in the cache.
    pub async fn get(&self, sha256: &str, range: Range<u64>) -> Option<Bytes> {
        let (inner, sha256) = (self.0.clone(), sha256.to_owned());
        let read = tokio::task::spawn_blocking(move || inner.get(&sha256, range));
        read.await.ok().flatten()
    }

    /// Adds a range of an object. An entry that cannot be written is left out; see
    /// [`Self::trouble`].
    pub async fn put(&self, sha256: &str, range: Range<u64>, bytes: Bytes) {
        let (inner, sha256) = (self.0.clone(), sha256.to_owned());
        let write = tokio::task::spawn_blocking(move || {
            if let Err(e) = inner.put(&sha256, &range, &bytes) {
                let what = format!("{}: cannot write to the cache: {e}", inner.folder.display());
                let mut trouble = inner.trouble.lock().unwrap_or_else(PoisonError::into_inner);
                trouble.get_or_insert(what);
            }
        });
        // The closure does not panic.
        let _ = write.await;
    }

    /// Removes what the cache has of an object that turned out damaged.
    pub fn forget(&self, sha256: &str) {
        // A file that remains is found damaged, and removed, at the next read.
        let _ = fs::remove_dir_all(self.0.folder.join(sha256));
    }

    /// Returns the first error of writing entries, and forgets it. Reads continue without a cache.
    pub fn trouble(&self) -> Option<String> {
        let trouble = &self.0.trouble;
        trouble
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .take()
    }
}

impl Inner {
    fn entry(&self, sha256: &str, range: &Range<u64>) -> PathBuf {
        let name = format!("{}-{}", range.start, range.end);
        self.folder.join(sha256).join(name)
    }

    fn get(&self, sha256: &str, range: Range<u64>) -> Option<Bytes> {
        let path = self.entry(sha256, &range);
        let mut bytes = fs::read(&path).ok()?;
        let whole = bytes.len().checked_sub(CHECKSUM).filter(|len| {
            let (data, sum) = bytes.split_at(*len);
            *len as u64 == range.end - range.start && crc32c::crc32c(data).to_le_bytes() == sum
        });
        let Some(len) = whole else {
            let _ = fs::remove_file(&path);
            return None;
        };
        // The time of the last use is the order of removal. A folder that cannot be written
        // loses only that order.
        let now = fs::File::options().append(true).open(&path);
        let _ = now.and_then(|file| file.set_modified(SystemTime::now()));
        bytes.truncate(len);
        Some(bytes.into())
    }

    fn put(&self, sha256: &str, range: &Range<u64>, bytes: &Bytes) -> io::Result<()> {
        let len = (bytes.len() + CHECKSUM) as u64;
        if len > self.most || bytes.len() as u64 != range.end - range.start {
            return Ok(());
        }
        let path = self.entry(sha256, range);
        let number = self.named.fetch_add(1, Ordering::Relaxed);
        let part = format!(".part-{}-{number}", std::process::id());
        let part = self.folder.join(part);
        let mut content = Vec::with_capacity(len as usize);
        content.extend_from_slice(bytes);
        content.extend_from_slice(&crc32c::crc32c(bytes).to_le_bytes());
        let written = fs::create_dir_all(self.folder.join(sha256))
            .and_then(|()| fs::write(&part, &content))
            .and_then(|()| fs::rename(&part, &path));
        if written.is_err() {
            let _ = fs::remove_file(&part);
        }
        written?;
        self.limit(len)
    }

    /// Counts new bytes, and removes the entries that were used longest ago if there are too many.
    fn limit(&self, added: u64) -> io::Result<()> {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        state.used = state.used.saturating_add(added);
        state.added = state.added.saturating_add(added);
        if state.used <= self.most && state.added <= self.most / LISTED_EACH {
            return Ok(());
        }
        let mut entries = self.list()?;
        entries.sort();
        let mut used: u64 = entries.iter().map(|(_, len, _)| len).sum();
        let kept = (self.most as f64 * KEPT) as u64;
        if used > self.most {
            for (_, len, path) in entries {
                if used <= kept {
                    break;
                }
                // Another process may have removed it.
                let _ = fs::remove_file(&path);
                if let Some(object) = path.parent() {
                    // Fails while the object has other entries.
                    let _ = fs::remove_dir(object);
                }
                used -= len;
            }
        }
        *state = State { used, added: 0 };
        Ok(())
    }

    /// Returns time of last use, size and path of each entry, and removes abandoned parts.
    fn list(&self) -> io::Result<Vec<(SystemTime, u64, PathBuf)>> {
        let mut entries = Vec::new();
        for found in fs::read_dir(&self.folder)? {
            let found = found?;
            if found.file_name().to_string_lossy().starts_with(".part-") {
                let age = found.metadata().and_then(|m| m.modified());
                let age = age.ok().and_then(|at| at.elapsed().ok());
                if age.is_some_and(|age| age > ABANDONED) {
                    let _ = fs::remove_file(found.path());
                }
                continue;
            }
            // Entries and objects may vanish while they are listed.
            let Ok(object) = fs::read_dir(found.path()) else {
                continue;
            };
            for entry in object.flatten() {
                if let Ok(meta) = entry.metadata()
                    && let Ok(used) = meta.modified()
                {
                    entries.push((used, meta.len(), entry.path()));
                }
            }
        }
        Ok(entries)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn object(n: u64) -> String {
        format!("{n:064x}")
    }

    async fn fill(cache: &Cache, objects: Range<u64>) {
        for n in objects {
            cache
                .put(&object(n), 0..1000, vec![n as u8; 1000].into())
                .await;
        }
    }

    #[tokio::test]
    async fn an_entry_is_returned_until_it_is_forgotten() {
        let folder = tempfile::tempdir().unwrap();
        let cache = Cache::open(folder.path(), 100_000).unwrap();
        fill(&cache, 0..3).await;
        assert_eq!(cache.get(&object(1), 0..1000).await.unwrap(), vec![1; 1000]);
        assert_eq!(cache.get(&object(1), 0..999).await, None);
        let again = Cache::open(folder.path(), 100_000).unwrap();
        assert_eq!(again.get(&object(2), 0..1000).await.unwrap(), vec![2; 1000]);
        again.forget(&object(2));
        assert_eq!(cache.get(&object(2), 0..1000).await, None);
    }

    #[tokio::test]
    async fn a_full_cache_drops_the_entries_used_longest_ago() {
        let folder = tempfile::tempdir().unwrap();
        let cache = Cache::open(folder.path(), 10_500).unwrap();
        fill(&cache, 0..8).await;
        // Times of files have a resolution of some milliseconds.
        tokio::time::sleep(Duration::from_millis(30)).await;
        cache.get(&object(0), 0..1000).await.unwrap();
        tokio::time::sleep(Duration::from_millis(30)).await;
        fill(&cache, 8..30).await;
        let used = cache.0.list().unwrap();
        let used: u64 = used.iter().map(|(_, len, _)| len).sum();
        assert!((5_000..=10_500).contains(&used), "{used} bytes");
        assert!(cache.get(&object(29), 0..1000).await.is_some());
        assert!(cache.get(&object(1), 0..1000).await.is_none());
        let folders = fs::read_dir(folder.path()).unwrap().count();
        assert_eq!(folders as u64, used / 1004, "an empty folder was left");
    }

    #[tokio::test]
    async fn a_used_entry_outlives_older_unused_ones() {
        let folder = tempfile::tempdir().unwrap();
        let cache = Cache::open(folder.path(), 10_500).unwrap();
        fill(&cache, 0..10).await;
        tokio::time::sleep(Duration::from_millis(30)).await;
        cache.get(&object(0), 0..1000).await.unwrap();
        tokio::time::sleep(Duration::from_millis(30)).await;
        fill(&cache, 10..11).await;
        assert!(cache.get(&object(0), 0..1000).await.is_some());
        assert!(cache.get(&object(1), 0..1000).await.is_none());
    }

    #[tokio::test]
    async fn a_damaged_entry_is_no_entry() {
        let folder = tempfile::tempdir().unwrap();
        let cache = Cache::open(folder.path(), 100_000).unwrap();
        fill(&cache, 0..2).await;
        let path = cache.0.entry(&object(0), &(0..1000));
        let mut bytes = fs::read(&path).unwrap();
        bytes[500] ^= 1;
        fs::write(&path, &bytes).unwrap();
        let cut = cache.0.entry(&object(1), &(0..1000));
        fs::write(&cut, [1; 3]).unwrap();
        assert_eq!(cache.get(&object(0), 0..1000).await, None);
        assert_eq!(cache.get(&object(1), 0..1000).await, None);
        assert!(!path.exists() && !cut.exists());
    }

    #[tokio::test]
    async fn a_cache_that_cannot_be_written_reports_it_once() {
        let folder = tempfile::tempdir().unwrap();
        let cache = Cache::open(&folder.path().join("c"), 100_000).unwrap();
        fs::remove_dir_all(folder.path().join("c")).unwrap();
        fs::write(folder.path().join("c"), "a file").unwrap();
        fill(&cache, 0..2).await;
        let trouble = cache.trouble().unwrap();
        assert!(trouble.contains("cannot write to the cache"), "{trouble}");
        assert_eq!(cache.trouble(), None);
        let unusable = Cache::open(&folder.path().join("c"), 1).unwrap_err();
        assert!(unusable.to_string().contains("cache"), "{unusable}");
    }
}
