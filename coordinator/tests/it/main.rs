//! Tests of the coordinator, in one executable because each one links the whole crate.

mod connections;
mod farm;
mod hostile_messages;
mod layers;
mod open_files;
mod protocol_model;
mod rights;
