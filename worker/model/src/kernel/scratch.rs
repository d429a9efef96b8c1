//! Buffers that are reused between calls. Allocating new memory costs a page fault for every 4 KiB,
//! which for small layers takes as long as the computation.

use std::ops::{Deref, DerefMut};
use std::sync::{Mutex, PoisonError};

/// The greatest number of buffers in the pool.
const KEPT: usize = 32;
/// The length of the longest buffer in the pool: 64 MiB.
const LONGEST: usize = 16 << 20;

static POOL: Mutex<Vec<Vec<f32>>> = Mutex::new(Vec::new());

/// A buffer of a given length with **any** contents. The user must write all of it before reading.
pub(super) struct Scratch {
    buffer: Vec<f32>,
    len: usize,
}

impl Scratch {
    /// Takes the smallest buffer of the pool that is long enough, or allocates one.
    pub fn take(len: usize) -> Self {
        let mut pool = POOL.lock().unwrap_or_else(PoisonError::into_inner);
        let fits = (0..pool.len())
            .filter(|i| pool[*i].len() >= len)
            .min_by_key(|i| pool[*i].len());
        let buffer = match fits {
            Some(i) => pool.swap_remove(i),
            None => vec![0.0; len],
        };
        Self { buffer, len }
    }
}

impl Deref for Scratch {
    type Target = [f32];

    fn deref(&self) -> &[f32] {
        &self.buffer[..self.len]
    }
}

impl DerefMut for Scratch {
    fn deref_mut(&mut self) -> &mut [f32] {
        &mut self.buffer[..self.len]
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        if self.buffer.len() > LONGEST {
            return;
        }
        let mut pool = POOL.lock().unwrap_or_else(PoisonError::into_inner);
        pool.push(std::mem::take(&mut self.buffer));
        if pool.len() > KEPT {
            let least = (0..pool.len()).min_by_key(|i| pool[*i].len());
            pool.swap_remove(least.expect("the pool is not empty"));
        }
    }
}
