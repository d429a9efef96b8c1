//! The inner chunks of a transient: their pixels and bins, and the order of values inside.

use std::ops::Range;

use crate::layout::arrays::Layout;
use crate::layout::spec::DatasetSpec;

/// Number of columns reordered at a time. Their targets fit into the first-level cache.
const BLOCK: usize = 32;

/// The inner chunks of a transient, numbered by planes, rows, columns and bins. A shard has them in
/// this order, so that all bins of a pixel are next to each other and a crop takes few requests.
/// Inside a chunk, values are stored bin by bin: neighbouring pixels see similar light, so they
/// compress better next to each other than neighbouring bins do.
pub(crate) struct Tiles {
    /// Number of images, stacked vertically: row r of plane p has the index p·rows + r.
    planes: usize,
    /// Size of one image in pixels (rows, columns).
    image: [usize; 2],
    /// Tile size: rows, columns, bins.
    side: [usize; 3],
    /// Number of tiles down, across, and along the bins.
    grid: [usize; 3],
    bins: usize,
}

/// One row of a tile's pixels inside the image.
pub(crate) struct Run {
    /// Index of the first pixel, counted through all planes.
    pub pixel: usize,
    /// Index of the first pixel within the tile.
    pub tile: usize,
    /// Image row (counted through all planes), first column and number of columns.
    pub row: usize,
    pub column: usize,
    pub columns: usize,
}

/// A part of a transient. Rows are counted through all planes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Part {
    pub rows: Range<usize>,
    pub columns: Range<usize>,
    pub bins: Range<usize>,
}

impl Part {
    /// Returns the number of values in it.
    pub fn len(&self) -> usize {
        self.rows.len() * self.row_len()
    }

    /// Returns the number of values in one of its rows.
    pub fn row_len(&self) -> usize {
        self.columns.len() * self.bins.len()
    }
}

impl Tiles {
    pub fn new(spec: &DatasetSpec, layout: &Layout) -> Self {
        let inner = layout.inner.as_ref().expect("transients are sharded");
        let image = [spec.height as usize, spec.width as usize];
        let bins = spec.gate.bins as usize;
        let [.., along, down, across] = inner[..] else {
            unreachable!("transients have bins, rows and columns");
        };
        let side = [down, across, along].map(|n| n as usize);
        Self {
            planes: layout.planes(),
            image,
            side,
            grid: [
                image[0].div_ceil(side[0]),
                image[1].div_ceil(side[1]),
                bins.div_ceil(side[2]),
            ],
            bins,
        }
    }

    pub fn count(&self) -> usize {
        self.planes * self.grid.iter().product::<usize>()
    }

    /// Returns the tile's place in the shard's index, which has the order of the array's axes:
    /// planes, bins, rows and columns.
    pub fn place(&self, tile: usize) -> usize {
        let [down, across, along] = self.grid;
        let (row, column, slab) = (self.row_of(tile), tile / along % across, tile % along);
        ((row / down * along + slab) * down + row % down) * across + column
    }

    /// Returns the flat index in the array of a pixel's bin. Pixels are counted through all planes.
    pub fn flat(&self, pixel: usize, bin: usize) -> u64 {
        let pixels = self.image[0] * self.image[1];
        ((pixel / pixels * self.bins + bin) * pixels + pixel % pixels) as u64
    }

    /// Returns the pixel, counted through all planes, and the bin of a flat index in the array.
    fn pixel_and_bin(&self, flat: u64) -> (usize, usize) {
        let pixels = self.image[0] * self.image[1];
        let (image, pixel) = (flat as usize / pixels, flat as usize % pixels);
        (image / self.bins * pixels + pixel, image % self.bins)
    }

    /// Returns the whole transient as a part.
    pub fn whole(&self) -> Part {
        Part {
            rows: 0..self.planes * self.image[0],
            columns: 0..self.image[1],
            bins: 0..self.bins,
        }
    }

    pub fn tile_len(&self) -> usize {
        self.side.iter().product()
    }

    /// Returns the number of bins of a histogram in a tile, including padding after the last bin.
    pub fn slab_len(&self) -> usize {
        self.side[2]
    }

    /// Returns the number of the tile's range of bins.
    pub fn slab_of(&self, tile: usize) -> usize {
        tile % self.grid[2]
    }

    /// Returns the tiles that overlap the part, in order.
    pub fn touching(&self, part: &Part) -> Vec<usize> {
        let tiles = 0..self.count();
        tiles.filter(|tile| self.touches(*tile, part)).collect()
    }

    /// Returns the place in a part of a flat index in the array: row, column and bin.
    pub fn within(&self, flat: u64, part: &Part) -> Option<[usize; 3]> {
        let (pixel, bin) = self.pixel_and_bin(flat);
        let (row, column) = (pixel / self.image[1], pixel % self.image[1]);
        let inside =
            |at: usize, range: &Range<usize>| range.contains(&at).then(|| at - range.start);
        Some([
            inside(row, &part.rows)?,
            inside(column, &part.columns)?,
            inside(bin, &part.bins)?,
        ])
    }

    fn touches(&self, tile: usize, part: &Part) -> bool {
        let overlap = |a: &Range<usize>, b: &Range<usize>| a.start < b.end && b.start < a.end;
        let left = self.left_of(tile);
        overlap(&self.rows_of(tile), &part.rows)
            && overlap(&(left..left + self.side[1]), &part.columns)
            && overlap(&self.bins_of(tile), &part.bins)
    }

    /// Returns the tile's row in the grid of tiles, counted through all planes.
    pub fn row_of(&self, tile: usize) -> usize {
        tile / (self.grid[1] * self.grid[2])
    }

    /// Returns the image rows of a tile, cut at the image's edge.
    pub fn rows_of(&self, tile: usize) -> Range<usize> {
        let (plane, band) = (
            self.row_of(tile) / self.grid[0],
            self.row_of(tile) % self.grid[0],
        );
        let top = plane * self.image[0] + band * self.side[0];
        top..(top + self.side[0]).min((plane + 1) * self.image[0])
    }

    /// Returns the bins of a tile, cut at the last one.
    pub fn bins_of(&self, tile: usize) -> Range<usize> {
        let first = tile % self.grid[2] * self.side[2];
        first..(first + self.side[2]).min(self.bins)
    }

    fn left_of(&self, tile: usize) -> usize {
        tile / self.grid[2] % self.grid[1] * self.side[1]
    }

    pub fn runs(&self, tile: usize) -> impl Iterator<Item = Run> + '_ {
        let left = self.left_of(tile);
        let columns = self.side[1].min(self.image[1] - left);
        self.rows_of(tile).enumerate().map(move |(r, row)| Run {
            pixel: row * self.image[1] + left,
            tile: r * self.side[1],
            row,
            column: left,
            columns,
        })
    }

    /// Reorders a tile's values from histogram by histogram to stored order.
    pub fn to_stored<T: bytemuck::Pod>(&self, values: &[T]) -> Vec<T> {
        let mut stored = vec![T::zeroed(); values.len()];
        let pixels = values.len() / self.side[2];
        let matrix = Matrix {
            values,
            stride: self.side[2],
        };
        matrix.transpose(0..pixels, 0..self.side[2], &mut stored, pixels);
        stored
    }

    /// Returns a run's values at one of the tile's bins, pixel by pixel. `bin` is relative to the
    /// tile's first bin.
    pub fn of_bin<'a, T>(&self, stored: &'a [T], run: &Run, bin: usize) -> &'a [T] {
        let at = bin * self.side[0] * self.side[1] + run.tile;
        &stored[at..at + run.columns]
    }

    /// Copies some bins of some columns of a run, histogram by histogram, from a stored tile.
    /// `columns` are relative to the image, and `bins` to the transient.
    pub fn of_run<T: bytemuck::Pod>(
        &self,
        stored: &[T],
        run: &Run,
        columns: Range<usize>,
        bins: Range<usize>,
        target: &mut Vec<T>,
    ) {
        target.clear();
        let first = run.tile + columns.start - run.column;
        let pixels = first..first + columns.len();
        let slab = bins.start % self.side[2];
        let slab = slab..slab + bins.len();
        target.resize(columns.len() * bins.len(), T::zeroed());
        let matrix = Matrix {
            values: stored,
            stride: self.side[0] * self.side[1],
        };
        matrix.transpose(slab, pixels, target, bins.len());
    }
}

/// A matrix with rows of `stride` values.
struct Matrix<'a, T> {
    values: &'a [T],
    stride: usize,
}

impl<T: Copy> Matrix<'_, T> {
    /// Writes the given columns as rows of `stride` values. The first values of each are those of
    /// the given rows.
    fn transpose(&self, rows: Range<usize>, columns: Range<usize>, to: &mut [T], stride: usize) {
        // Reads are contiguous; writes go to a block that stays in the cache.
        for c0 in columns.clone().step_by(BLOCK) {
            let c1 = (c0 + BLOCK).min(columns.end);
            let to = &mut to[(c0 - columns.start) * stride..];
            for r in rows.clone() {
                let source = &self.values[r * self.stride..][c0..c1];
                let places = to[r - rows.start..].iter_mut().step_by(stride);
                places.zip(source).for_each(|(to, from)| *to = *from);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_transposed_part_of_a_matrix_has_rows_for_columns() {
        let values: Vec<u16> = (0..70 * 90).collect();
        let matrix = Matrix {
            values: &values,
            stride: 90,
        };
        let mut to = vec![0; 50 * 64];
        matrix.transpose(3..67, 20..70, &mut to, 64);
        for (c, row) in to.chunks_exact(64).enumerate() {
            for (r, value) in row.iter().enumerate() {
                assert_eq!(usize::from(*value), (r + 3) * 90 + c + 20);
            }
        }
    }
}
