//! The transient renderer: a scene in, time-resolved histograms and ground truth out. Knows nothing of
//! jobs, stores or files.

mod api;

pub use api::*;
