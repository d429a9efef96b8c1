//! Tests of the catalog on SQLite and Postgres, in one executable because each one links the whole
//! crate.

mod away;
mod conformance;
mod graphs;
mod listing;
mod rights;
mod sqlite;
