//! Repair of stores: finds orphaned and lost objects, and regenerates them.

pub(crate) mod collect;
pub(crate) mod listing;
pub(crate) mod recipe;
pub(crate) mod restore;
pub(crate) mod root;
pub(crate) mod unfounded;
