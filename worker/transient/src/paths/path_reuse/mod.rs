//! Path reuse: three bounces and more for a tile of neighbouring pixels at once.
//!
//! Every pixel of a tile has one *gather point*: the first surface point along a camera path that
//! is not a near-mirror. *Shared vertices* are drawn from the scattering of the gather points and
//! of the spots, and every gather point is connected to every shared vertex (Bekaert, Sbert and
//! Halton, EGWR 2002; vertices from the light side as in Segovia et al., EGSR 2006). They are
//! chosen among several times as many candidates, by the direct light that each is likely to bring.
//! A shared vertex sends out its direct light from all spots, computed exactly, and the light that
//! random walks bring. It starts more walks if the gather points receive more of its light. One
//! shadow ray carries a whole list of arrivals to a pixel. All techniques that draw a shared vertex
//! are combined by the balance heuristic with visibility in the densities, so both 1/d²
//! singularities, at the gather point and at the spot, stay bounded.
//!
//! Light that only one pixel can see, namely via a near-mirror or a glossy surface, is walked for
//! that pixel alone.

pub(crate) mod arrivals;
pub(crate) mod candidates;
pub(crate) mod choose;
pub(crate) mod connect;
pub(crate) mod draw;
pub(crate) mod effort;
pub(crate) mod gather;
pub(crate) mod gloss;
pub(crate) mod lengths;
pub(crate) mod light_up;
pub(crate) mod light_vertices;
pub(crate) mod pass;
pub(crate) mod shared;
pub(crate) mod sharing;
pub(crate) mod spread;
pub(crate) mod tile;
