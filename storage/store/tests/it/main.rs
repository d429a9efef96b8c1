//! Tests of object stores and of what is published in them, in one executable because each one
//! links the whole crate.

mod published;
mod tricky;
