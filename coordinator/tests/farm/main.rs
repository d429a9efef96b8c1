//! A real coordinator on loopback, driven by scripted workers and clients over gRPC.

mod harness;
mod jobs;
mod leases;
mod logs;
mod sharing;
mod start;
