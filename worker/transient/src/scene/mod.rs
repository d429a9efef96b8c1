//! Geometry and materials: what a ray hits, and how it scatters there.

pub(crate) mod beckmann;
pub(crate) mod bsdf;
pub(crate) mod bvh;
pub(crate) mod centres;
pub(crate) mod cut;
pub(crate) mod extent;
pub(crate) mod fresnel;
pub(crate) mod hit;
pub(crate) mod intersection;
pub(crate) mod load;
pub(crate) mod lobe;
pub(crate) mod lobes;
pub(crate) mod panes;
pub(crate) mod segments;
pub(crate) mod spectra;
pub(crate) mod stratified;
pub(crate) mod surface;
pub(crate) mod world;
