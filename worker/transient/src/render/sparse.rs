//! Sparse values by pixel and slot.

use std::ops::Range;

use serde::{Deserialize, Serialize};

use crate::{api::RenderError, render::memory::room};

/// Values by pixel and slot.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct Sparse<V> {
    /// Start of each pixel's values, and the end of the last one's; empty if there are no values.
    pub starts: Vec<u32>,
    /// Slots of the values, ascending within a pixel.
    pub slots: Vec<u32>,
    pub values: Vec<V>,
}

/// A contribution that has not been added to the sums.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Waiting {
    /// Pixel within the block.
    pub pixel: u32,
    pub slot: u32,
    pub pass: u32,
    pub value: f32,
    pub spot: u16,
}

impl<V: Copy + Default> Sparse<V> {
    /// Returns the slots and values of a pixel.
    pub fn of(&self, pixel: usize) -> (&[u32], &[V]) {
        match self.starts.get(pixel..pixel + 2) {
            Some(&[start, end]) => {
                let range = start as usize..end as usize;
                (&self.slots[range.clone()], &self.values[range])
            }
            _ => (&[], &[]),
        }
    }

    pub fn fits(&self, pixels: usize, within: Range<u32>) -> bool {
        let count = self.slots.len();
        if self.values.len() != count {
            return false;
        }
        if self.starts.is_empty() {
            return count == 0;
        }
        self.starts.len() == pixels + 1
            && self.starts.is_sorted()
            && (self.starts[0], self.starts[pixels] as usize) == (0, count)
            && self.slots.iter().all(|slot| within.contains(slot))
            && (0..pixels).all(|k| self.of(k).0.is_sorted_by(|a, b| a < b))
    }

    /// Adds contributions, sorted by pixel and slot, to the values of `pixels` pixels. `add`
    /// receives all contributions to one slot.
    pub fn take(
        &mut self,
        pixels: usize,
        found: &[Waiting],
        add: impl Fn(&mut V, &[Waiting]),
    ) -> Result<(), RenderError> {
        let groups = found.chunk_by(|a, b| (a.pixel, a.slot) == (b.pixel, b.slot));
        let most = self.slots.len() + groups.clone().count();
        room::<(u32, V)>(most, "the sums over light paths")?;
        let mut groups = groups.peekable();
        let mut merged = Self {
            starts: Vec::with_capacity(pixels + 1),
            slots: Vec::with_capacity(most),
            values: Vec::with_capacity(most),
        };
        merged.starts.push(0);
        for pixel in 0..pixels {
            let (slots, values) = self.of(pixel);
            let mut old = slots.iter().copied().zip(values.iter().copied()).peekable();
            loop {
                let next = groups.peek().filter(|g| g[0].pixel as usize == pixel);
                let slot = match (old.peek(), next) {
                    (None, None) => break,
                    (Some((a, _)), Some(b)) => (*a).min(b[0].slot),
                    (Some((a, _)), None) => *a,
                    (None, Some(b)) => b[0].slot,
                };
                let mut value = match old.next_if(|(a, _)| *a == slot) {
                    Some((_, value)) => value,
                    None => V::default(),
                };
                let new = groups.next_if(|g| g[0].pixel as usize == pixel && g[0].slot == slot);
                if let Some(new) = new {
                    add(&mut value, new);
                }
                merged.slots.push(slot);
                merged.values.push(value);
            }
            merged.starts.push(merged.slots.len() as u32);
        }
        *self = merged;
        Ok(())
    }
}
