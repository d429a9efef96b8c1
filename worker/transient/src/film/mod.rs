//! The gate as slots, and the forms in which techniques hand over light.

pub(crate) mod blocks;
pub(crate) mod class;
pub(crate) mod sink;
pub(crate) mod slots;
pub(crate) mod splat;
pub(crate) mod technique;
