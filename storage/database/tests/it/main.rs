//! Tests of the catalog on SQLite and Postgres, in one executable because each one links the whole
//! crate.

mod after;
mod away;
mod backup;
mod conformance;
mod graphs;
mod listing;
mod rights;
mod sqlite;
mod usage;
