//! Ranges of tiles, to be rendered on several machines.

use std::ops::Range;

use serde::{Deserialize, Serialize};

use crate::render::{
    draws,
    image::{Image, OfTile},
    region::Region,
    stat::Stat,
};

/// A range of tiles taken out of an image.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Slice {
    /// The planes of [`Image::planes`], pixels in the order of the tiles.
    pub planes: Vec<Vec<f32>>,
    pub stats: Vec<Stat>,
    pub tiles: Vec<OfTile>,
    /// The number of passes over these tiles.
    pub passes: u32,
}

impl Image {
    /// Returns every plane of values by pixel and bin.
    pub fn planes(&mut self) -> Vec<&mut Vec<f32>> {
        let mut planes = vec![&mut self.transient];
        if let Some(s) = &mut self.split {
            planes.extend([
                &mut s.two,
                &mut s.two_se,
                &mut s.two_noise,
                &mut s.multi,
                &mut s.multi_se,
                &mut s.multi_noise,
            ]);
        }
        planes.extend(&mut self.groups);
        planes
    }

    /// Returns the pixels of a range of tiles as runs, one per tile row: first pixel and length.
    pub fn runs(&self, range: Range<usize>) -> Vec<(usize, usize)> {
        let width = self.width;
        let of_tile = |t: &Region| {
            let (col, cols) = (t.col as usize, t.cols as usize);
            let rows = t.row as usize..(t.row + t.rows) as usize;
            rows.map(move |row| (row * width + col, cols))
        };
        self.tiles[range].iter().flat_map(of_tile).collect()
    }

    /// Extracts a range of tiles.
    pub fn take(mut self, range: Range<usize>) -> Slice {
        let (runs, bins) = (self.runs(range.clone()), self.bins);
        let cut = |plane: &mut Vec<f32>| {
            let run =
                |&(first, count): &(usize, usize)| &plane[first * bins..(first + count) * bins];
            runs.iter().flat_map(run).copied().collect()
        };
        let planes = self.planes().into_iter().map(cut).collect();
        let stats = runs
            .iter()
            .flat_map(|&(first, count)| &self.stats[first..first + count]);
        Slice {
            planes,
            stats: stats.copied().collect(),
            tiles: self.of_tiles[range].to_vec(),
            passes: self.passes,
        }
    }

    /// Inserts a range of tiles. Returns `false` if the slice does not fit an image of this shape.
    /// Call [`Image::total`] after the last one.
    pub fn put(&mut self, range: Range<usize>, slice: &Slice) -> bool {
        let (runs, bins) = (self.runs(range.clone()), self.bins);
        let pixels: usize = runs.iter().map(|(_, count)| count).sum();
        let mut tiles = self.tiles[range.clone()].iter().zip(&slice.tiles);
        let watched = tiles.all(|(region, of)| {
            let count = draws::count(region);
            of.draws.len() == count && of.two_draws.len() == count
        });
        let planes = self.planes();
        if slice.tiles.len() != range.len()
            || !watched
            || slice.stats.len() != pixels
            || slice.planes.len() != planes.len()
            || slice.planes.iter().any(|p| p.len() != pixels * bins)
        {
            return false;
        }
        for (to, mut from) in planes.into_iter().zip(slice.planes.iter().map(|p| &p[..])) {
            for &(first, count) in &runs {
                let (run, rest) = from.split_at(count * bins);
                to[first * bins..(first + count) * bins].copy_from_slice(run);
                from = rest;
            }
        }
        let mut from = &slice.stats[..];
        for (first, count) in runs {
            let (run, rest) = from.split_at(count);
            self.stats[first..first + count].copy_from_slice(run);
            from = rest;
        }
        self.passes = slice.passes;
        self.of_tiles[range].clone_from_slice(&slice.tiles);
        true
    }
}
