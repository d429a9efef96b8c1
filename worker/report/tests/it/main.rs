//! Tests of reports on networks that were really trained.

#[path = "../../../model/tests/it/common/mod.rs"]
mod common;
mod report;
