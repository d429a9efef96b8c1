//! The structure of a data set: its spec, arrays and metadata, scene records, and manifests.

pub(crate) mod arrays;
pub(crate) mod group;
pub(crate) mod manifest;
pub(crate) mod quantity;
pub(crate) mod record;
pub(crate) mod spec;
