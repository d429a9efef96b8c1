//! The one way to files whose names come from elsewhere: from a job, a scene file, an import, a furniture list. A file is
//! opened only if it lies below the folders allowed, wherever links lead.

mod bounded;
mod error;
mod opener;

pub use bounded::{read_bounded, read_entry};
pub use error::FileError;
pub use opener::Opener;
