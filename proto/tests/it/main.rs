//! Tests of the job model and the wire, in one executable because each one links the whole crate.

mod calibrate;
mod demultiplex;
mod generated;
mod graphs;
mod infer;
mod job_settings;
mod ranges;
mod reprocess;
mod scenes;
mod split;
mod sweep;
mod texts;
mod train;
