//! A real coordinator on loopback, driven by scripted workers and clients over gRPC.

mod catalog_trouble;
mod examine;
mod harness;
mod jobs;
mod leases;
mod listing;
mod logs;
mod poison;
mod results;
mod sharing;
mod start;
mod usage;
mod verified;
