//! Memory between the tensors of a step and those of the next.
//!
//! A step frees some hundred megabytes and asks for as many in the next. The allocator gives free memory back to the system after a
//! second, page by page as it finds it, and the next tensor has each page cleared again: a quarter of the time of a SwinIR's step
//! (measured). While a network is trained or asked, it keeps free memory for ten seconds. Not always: other tasks, which
//! free what they do not need again, would hold a third more than they say.

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

/// How long free memory is kept, milliseconds.
const KEPT_MS: c_long = 10_000;

/// How many ask for it, and what the option was before the first.
static ASKED: Mutex<(usize, c_long)> = Mutex::new((0, 0));

// SAFETY of the two calls below: both read or write one number in a table, for any option below the table's length (47 in mimalloc
// 3), at any time and from any thread; mimalloc reads it anew whenever it frees.

fn delay() -> c_long {
    unsafe { mi_option_get(PURGE_DELAY) }
}

fn set_delay(ms: c_long) {
    unsafe { mi_option_set(PURGE_DELAY, ms) };
}

/// While one lives, free memory is kept for longer. Where the program has another allocator, nothing changes.
#[derive(Debug)]
pub struct Kept(());

impl Kept {
    /// From now on.
    pub fn from_now() -> Self {
        let mut asked = ASKED.lock().unwrap_or_else(PoisonError::into_inner);
        if asked.0 == 0 {
            asked.1 = delay();
            // Who has set it for longer, or switched it off (-1), is left alone.
            if (0..KEPT_MS).contains(&asked.1) {
                set_delay(KEPT_MS);
            }
        }
        asked.0 += 1;
        Self(())
    }
}

impl Drop for Kept {
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
    use super::{KEPT_MS, Kept, delay};

    /// Also that the number is still that option's: its default is a second.
    #[test]
    fn free_memory_is_kept_for_longer_while_anybody_asks() {
        assert_eq!(delay(), 1000, "unset MIMALLOC_PURGE_DELAY");
        let one = Kept::from_now();
        let other = Kept::from_now();
        drop(one);
        assert_eq!(delay(), KEPT_MS);
        drop(other);
        assert_eq!(delay(), 1000);
    }
}
