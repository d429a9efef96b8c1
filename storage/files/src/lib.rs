//! The only way to open files with names from elsewhere: from a job, a scene file, an import or a
//! furniture list. A file is opened only if it is inside the allowed folders, after resolving
//! symbolic links.

mod bounded;
mod error;
mod opener;

pub use bounded::{read_bounded, read_entry};
pub use error::FileError;
pub use opener::Opener;
