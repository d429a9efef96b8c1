//! Reuses memory between the tensors of consecutive steps.
//!
//! A step frees some hundred megabytes and the next step allocates as many. By default, the
//! allocator returns free memory to the system after one second, page by page, and the system
//! clears each page again for the next tensor. This takes a quarter of the time of a SwinIR's step
//! (measured). While a network is trained or evaluated, the allocator therefore retains free memory
//! for ten seconds. This does not apply to other tasks: they do not reuse the memory they free, and
//! would take a third more memory than they reserve.

#![expect(
    unsafe_code,
    reason = "the allocator's options are C functions; proof below"
)]

use std::{
    ffi::c_long,
    sync::{Mutex, PoisonError},
};

use libmimalloc_sys::{mi_option_get, mi_option_set, mi_option_t};

/// mimalloc's `mi_option_purge_delay`, which its Rust crate does not name.
const PURGE_DELAY: mi_option_t = 15;

/// The time for which free memory is held, milliseconds.
const KEPT_MS: c_long = 10_000;

/// The number of live [`RetainedMemory`] guards, and the option's value before the first.
static ASKED: Mutex<(usize, c_long)> = Mutex::new((0, 0));

// SAFETY of the two calls below: both read or write one number in a table and are valid for any
// option below the table's length (47 in mimalloc 3), at any time and from any thread. mimalloc
// reads the option each time it frees memory.

fn delay() -> c_long {
    unsafe { mi_option_get(PURGE_DELAY) }
}

fn set_delay(ms: c_long) {
    unsafe { mi_option_set(PURGE_DELAY, ms) };
}

/// A guard: while one exists, free memory is held for longer. If the program uses another
/// allocator, the guard has no effect.
#[derive(Debug)]
pub struct RetainedMemory(());

impl RetainedMemory {
    /// Creates a guard that takes effect immediately.
    pub fn from_now() -> Self {
        let mut asked = ASKED.lock().unwrap_or_else(PoisonError::into_inner);
        if asked.0 == 0 {
            asked.1 = delay();
            // A longer time, or a disabled option (-1), set by the user is not changed.
            if (0..KEPT_MS).contains(&asked.1) {
                set_delay(KEPT_MS);
            }
        }
        asked.0 += 1;
        Self(())
    }
}

impl Drop for RetainedMemory {
    fn drop(&mut self) {
        let mut asked = ASKED.lock().unwrap_or_else(PoisonError::into_inner);
        asked.0 -= 1;
        if asked.0 == 0 {
            set_delay(asked.1);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{KEPT_MS, RetainedMemory, delay};

    /// Also checks that the number still belongs to that option: its default is one second.
    #[test]
    fn free_memory_is_kept_for_longer_while_anybody_asks() {
        assert_eq!(delay(), 1000, "unset MIMALLOC_PURGE_DELAY");
        let one = RetainedMemory::from_now();
        let other = RetainedMemory::from_now();
        drop(one);
        assert_eq!(delay(), KEPT_MS);
        drop(other);
        assert_eq!(delay(), 1000);
    }
}
