//! Single renders in a local folder, and small Zarr groups of plain arrays.

pub(crate) mod read;
pub(crate) mod single;
pub(crate) mod write;
