//! Techniques that join camera and light: one bounce, two bounces, path reuse, walks, glass.

pub(crate) mod connect;
pub(crate) mod ellipsoid;
pub(crate) mod glass;
pub(crate) mod one_bounce;
pub(crate) mod path_reuse;
pub(crate) mod scratch;
pub(crate) mod step;
pub(crate) mod tracer;
pub(crate) mod two_bounce;
pub(crate) mod vertex;
pub(crate) mod walk;
