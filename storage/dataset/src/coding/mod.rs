//! Encoding of numbers as bytes: codec profiles, Zarr codec chains, shards and tiles.

pub(crate) mod codec;
pub(crate) mod counts;
pub(crate) mod profile;
pub(crate) mod rounding;
pub mod shard;
pub(crate) mod squareroot;
pub(crate) mod tiles;
pub(crate) mod transient;
pub(crate) mod values;
