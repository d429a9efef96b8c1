//! Selects the cells of a grid that a ray has to visit. A ray skips blocks of 8×8×8 cells that
//! contain none.

use picofarm_scene::Vec3;
use rayon::prelude::*;

use super::Field;

/// The number of cells along a side of a block.
const SIDE: usize = 8;

/// The cells of interest.
#[derive(Debug, Clone)]
pub struct Skip {
    cells: Vec<u8>,
    blocks: Vec<u8>,
    across: [usize; 3],
}

impl Skip {
    /// Selects cells with at least one node of interest among their eight.
    pub fn to_nodes(field: &Field, of_interest: impl Fn(usize) -> bool + Sync) -> Self {
        let [nx, ny, nz] = field.nodes;
        let [_, y, z] = field.strides();
        let wanted: Vec<u8> = (0..field.logit.len())
            .into_par_iter()
            .map(|i| u8::from(of_interest(i)))
            .collect();
        let mut cells = vec![0u8; field.logit.len()];
        let layers = cells.par_chunks_mut(z).enumerate().take(nz - 1);
        layers.for_each(|(k, layer)| {
            for j in 0..ny - 1 {
                let at = k * z + j * y;
                let row = |i: usize| wanted[i] | wanted[i + y] | wanted[i + z] | wanted[i + y + z];
                for i in 0..nx - 1 {
                    layer[j * y + i] = row(at + i) | row(at + i + 1);
                }
            }
        });
        let across = field.nodes.map(|n| n.div_ceil(SIDE));
        let mut blocks = vec![0u8; across.iter().product()];
        for (index, &cell) in cells.iter().enumerate() {
            if cell != 0 {
                let (i, j, k) = (index % nx, index / y % ny, index / z);
                blocks[((k / SIDE) * across[1] + j / SIDE) * across[0] + i / SIDE] = 1;
            }
        }
        Self {
            cells,
            blocks,
            across,
        }
    }

    #[inline(always)]
    pub(super) fn cell(&self, cell: usize) -> bool {
        self.cells[cell] != 0
    }

    #[inline(always)]
    pub(super) fn block(&self, i: usize, j: usize, k: usize) -> bool {
        self.blocks[((k / SIDE) * self.across[1] + j / SIDE) * self.across[0] + i / SIDE] != 0
    }

    /// Returns the distance in t from the grid position `p` to the point at which a ray leaves the
    /// block of cell (i, j, k); `slope` is t a voxel.
    #[inline(always)]
    pub(super) fn leave(&self, p: Vec3, slope: Vec3, (i, j, k): (usize, usize, usize)) -> f32 {
        let mut ahead = f32::INFINITY;
        for (axis, cell) in [i, j, k].into_iter().enumerate() {
            let block = cell / SIDE;
            let wall = if slope[axis] > 0.0 {
                (block + 1) * SIDE
            } else {
                block * SIDE
            };
            // A ray parallel to the wall has an infinite slope and leaves through another wall.
            let t = (wall as f32 - p[axis]) * slope[axis];
            if t < ahead {
                ahead = t;
            }
        }
        ahead
    }
}
