//! Decoded scenes in memory, the latest used ones, up to a number of bytes.

use std::{
    collections::VecDeque,
    sync::{Arc, Mutex},
};

/// Values by their keys, the least recently used first.
pub struct Cache<K, V> {
    entries: Mutex<VecDeque<Entry<K, V>>>,
    limit: usize,
}

struct Entry<K, V> {
    key: K,
    value: Arc<V>,
    bytes: usize,
}

impl<K: PartialEq, V> Cache<K, V> {
    /// Returns an empty cache of at most `limit` bytes. One value may exceed it.
    pub fn new(limit: usize) -> Self {
        Self {
            entries: Mutex::default(),
            limit,
        }
    }

    /// Returns a value, which is then the latest used.
    pub fn get(&self, key: &K) -> Option<Arc<V>> {
        let mut entries = self.entries.lock().expect("no holder panics");
        let at = entries.iter().position(|entry| entry.key == *key)?;
        let entry = entries.remove(at)?;
        let value = Arc::clone(&entry.value);
        entries.push_back(entry);
        Some(value)
    }

    /// Adds a value of a size, and removes others until all fit.
    pub fn insert(&self, key: K, value: Arc<V>, bytes: usize) {
        let mut entries = self.entries.lock().expect("no holder panics");
        entries.retain(|entry| entry.key != key);
        let mut held: usize = entries.iter().map(|entry| entry.bytes).sum();
        while held + bytes > self.limit
            && let Some(old) = entries.pop_front()
        {
            held -= old.bytes;
        }
        entries.push_back(Entry { key, value, bytes });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_least_recently_used_values_leave_when_the_bytes_do_not_fit() {
        let cache = Cache::new(10);
        for (key, bytes) in [("a", 4), ("b", 4)] {
            cache.insert(key, Arc::new(key), bytes);
        }
        assert!(cache.get(&"a").is_some());
        cache.insert("c", Arc::new("c"), 5);
        assert!(cache.get(&"b").is_none() && cache.get(&"a").is_some());
        cache.insert("d", Arc::new("d"), 99);
        assert!(cache.get(&"a").is_none() && cache.get(&"c").is_none());
        assert_eq!(cache.get(&"d").as_deref(), Some(&"d"));
    }
}
