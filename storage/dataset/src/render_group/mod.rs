//! Single renders as small Zarr groups in a local folder.

pub(crate) mod read;
pub(crate) mod write;
