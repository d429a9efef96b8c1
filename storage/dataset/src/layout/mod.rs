//! What a data set consists of: its spec, its arrays and their metadata, scenes as records, and manifests.

pub(crate) mod arrays;
pub(crate) mod group;
pub(crate) mod manifest;
pub(crate) mod published;
pub(crate) mod quantity;
pub(crate) mod record;
pub(crate) mod spec;
