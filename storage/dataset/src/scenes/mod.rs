//! Data sets and their scenes: creating, publishing, reading, and listing by splits and snapshots.

mod cached;
pub(crate) mod dataset;
pub(crate) mod derive;
pub(crate) mod encode;
pub(crate) mod parts;
pub(crate) mod publish;
pub(crate) mod read;
pub(crate) mod snapshot;
pub(crate) mod splits;
pub(crate) mod summary;
pub(crate) mod window;
