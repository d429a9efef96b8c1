//! Distances between the reconstructed and the true surfaces, and matter in empty space.

use kdtree::{KdTree, distance::squared_euclidean};
use picofarm_scene::Vec3;
use rayon::prelude::*;
use serde::Serialize;

use crate::{
    ReconstructError,
    field::Field,
    mesh::Surface,
    world::{World, sample},
};

/// The number of points on each surface.
const POINTS: usize = 100_000;
/// The number of points on the true surfaces from which the distance of floating matter is
/// measured.
const DENSE: usize = 400_000;
/// Matter at a larger distance from any surface floats, metres.
const FLOATS_M: f32 = 0.05;
/// The distance within which points match, metres.
const CLOSE_M: f64 = 0.05;
/// The share of light that matter stops over one voxel.
const OPAQUE: f32 = 0.5;
/// The number of points in a leaf of a tree.
const LEAF: usize = 16;

/// The distances between two surfaces.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct MeshScore {
    /// The mean of the two mean distances, metres.
    pub chamfer_m: f64,
    /// The mean distance from the reconstruction to the truth, metres.
    pub accuracy_m: f64,
    /// The mean distance from the truth to the reconstruction, metres.
    pub completeness_m: f64,
    /// The harmonic mean of precision and recall at `close_m`.
    pub f_score: f64,
    /// The share of the reconstruction's points within `close_m` of the truth.
    pub precision: f64,
    /// The share of the truth's points within `close_m` of the reconstruction.
    pub recall: f64,
    /// The distance of the F-score, metres.
    pub close_m: f64,
    /// The number of points on each surface before they are limited to the box.
    pub points: usize,
}

/// Matter that floats in free space.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Floaters {
    /// The volume, m³.
    pub volume_m3: f64,
    /// The density from which a node counts, 1/m: half the light is stopped over one voxel.
    pub threshold_per_m: f64,
    /// The least distance to any surface, metres.
    pub farther_than_m: f64,
}

type Tree = KdTree<f64, u32, [f64; 3]>;

fn point(x: Vec3) -> [f64; 3] {
    [x.x, x.y, x.z].map(f64::from)
}

fn tree(points: &[Vec3]) -> Result<Tree, ReconstructError> {
    let mut tree = KdTree::with_capacity(3, LEAF);
    for (k, x) in points.iter().enumerate() {
        let added = tree.add(point(*x), k as u32);
        added.map_err(|e| {
            ReconstructError::invalid(
                format!("points[{k}]"),
                format!("{e}; expected finite points"),
            )
        })?;
    }
    Ok(tree)
}

fn distance(tree: &Tree, x: Vec3) -> f64 {
    let nearest = tree.nearest(&point(x), 1, &squared_euclidean);
    let first = nearest.ok().and_then(|found| found.first().map(|f| f.0));
    first.map_or(f64::INFINITY, f64::sqrt)
}

/// Computes the distances between a reconstructed surface and the true ones within the grid's box,
/// as means over points uniform by area. The truth's points include invisible surfaces (the inside
/// of a seat against its legs).
///
/// # Errors
/// [`ReconstructError::Invalid`] if either has no surface.
pub fn mesh_score(
    surface: &Surface,
    world: &World,
    field: &Field,
    seed: u64,
) -> Result<MeshScore, ReconstructError> {
    let truth = world.surface_points(POINTS, seed, field.origin, field.end());
    let found = sample(&surface.corners(), POINTS, seed);
    if truth.is_empty() || found.is_empty() {
        let what = "has no surface inside the grid; nothing can be compared";
        return Err(ReconstructError::invalid(
            if found.is_empty() { "mesh" } else { "scene" },
            what,
        ));
    }
    let measure = |from: &[Vec3], to: &[Vec3]| -> Result<(f64, f64), ReconstructError> {
        let tree = tree(to)?;
        let all: Vec<f64> = from.par_iter().map(|x| distance(&tree, *x)).collect();
        let close = all.iter().filter(|d| **d <= CLOSE_M).count();
        Ok((
            all.iter().sum::<f64>() / all.len() as f64,
            close as f64 / all.len() as f64,
        ))
    };
    let (accuracy_m, precision) = measure(&found, &truth)?;
    let (completeness_m, recall) = measure(&truth, &found)?;
    Ok(MeshScore {
        chamfer_m: 0.5 * (accuracy_m + completeness_m),
        accuracy_m,
        completeness_m,
        f_score: 2.0 * precision * recall / (precision + recall).max(1e-9),
        precision,
        recall,
        close_m: CLOSE_M,
        points: POINTS,
    })
}

/// Computes the matter farther than 5 cm from any surface, within the bounding box of the scene's
/// surfaces and outside solids. Planes of the room that extend beyond an open side are therefore
/// not counted.
///
/// # Errors
/// [`ReconstructError::Invalid`] if the scene has no surface inside the grid.
pub fn floaters(field: &Field, world: &World, seed: u64) -> Result<Floaters, ReconstructError> {
    let truth = world.surface_points(DENSE, seed, field.origin, field.end());
    if truth.is_empty() {
        let what = "has no surface inside the grid; nothing can be compared";
        return Err(ReconstructError::invalid("scene", what));
    }
    let tree = tree(&truth)?;
    let (lo, hi) = world.bounds();
    let within = |x: Vec3| (0..3).all(|k| x[k] >= lo[k] && x[k] <= hi[k]);
    let threshold = -libm::logf(1.0 - OPAQUE) / field.spacing;
    let dense: Vec<usize> = (0..field.logit.len())
        .filter(|&i| field.density(i) > threshold && within(field.at(i)))
        .collect();
    let count: usize = dense
        .par_chunks(1024)
        .map(|some| {
            let mut stack = world.stack();
            let floats = |i: &&usize| {
                let x = field.at(**i);
                distance(&tree, x) > f64::from(FLOATS_M) && !world.buried(&mut stack, x)
            };
            some.iter().filter(floats).count()
        })
        .sum();
    Ok(Floaters {
        volume_m3: count as f64 * f64::from(field.spacing).powi(3),
        threshold_per_m: f64::from(threshold),
        farther_than_m: f64::from(FLOATS_M),
    })
}
