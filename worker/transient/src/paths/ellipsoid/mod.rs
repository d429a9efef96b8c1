//! Narrow gates: ellipsoidal connections (Pediredla, Veeraraghavan and Gkioulekas, SIGGRAPH Asia
//! 2019).
//!
//! A path laser → spot → y → x → camera falls into the gate if y is between two ellipsoids with
//! foci at the spot and at x. Shared vertices are drawn there, on patches of the surfaces, in
//! proportion to the part of each patch within the shells of all spots and the tile's gather
//! points. The density of any such point is a table entry, so that this technique is combined with
//! the others by the balance heuristic. The other techniques cover what it misses, because the
//! shells are those of patches, not of points.
//!
//! Paths that cannot fall into the gate are neither lit nor connected nor counted.

pub(crate) mod patches;
pub(crate) mod shells;
pub(crate) mod window;
