//! Reads arrays of data sets and renders without our code.

use std::{path::Path, sync::Arc};

use zarrs::{array::Array, filesystem::FilesystemStore};

/// Returns the shape and the values of an array. Transients of data sets are reordered from
/// `[bin][row][column]` to `[row][column][bin]`, the order of single histograms.
pub fn array(group: &Path, name: &str) -> (Vec<u64>, Vec<f32>) {
    let store = Arc::new(FilesystemStore::new(group).unwrap());
    let array = Array::open(store, &format!("/{name}")).unwrap_or_else(|e| panic!("{name}: {e}"));
    let data: Vec<f32> = array.retrieve_array_subset(&array.subset_all()).unwrap();
    let mut shape = array.shape().to_vec();
    let names = array.dimension_names().as_ref().unwrap();
    let names: Vec<&str> = names.iter().map(|n| n.as_deref().unwrap()).collect();
    if !names.ends_with(&["bin", "row", "column"]) {
        return (shape, data);
    }
    let axes = shape.len() - 3;
    let (bins, pixels) = (shape[axes], shape[axes + 1] * shape[axes + 2]);
    shape[axes..].rotate_left(1);
    let images = data.chunks_exact((bins * pixels) as usize);
    let by_pixel = images.flat_map(|image| {
        let of_pixel = move |p| image.iter().skip(p).step_by(pixels as usize);
        (0..pixels as usize).flat_map(of_pixel)
    });
    (shape, by_pixel.copied().collect())
}
