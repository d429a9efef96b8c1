//! The vocabulary of the farm and its wire: typed ids, the checked specs of jobs, the messages, and
//! the generated protobuf types with their conversions. No I/O.

pub mod codec;
pub mod compatibility;
pub mod convert;
pub mod ids;
pub mod key;
pub mod messages;
pub mod show;
pub mod spec;
pub mod split;
pub mod trace;

/// Generated protobuf and gRPC types, package `picofarm.v1`. They stay inside the rpc modules.
#[expect(missing_docs, reason = "generated from the schema, which documents it")]
pub mod wire {
    include!("generated/picofarm.v1.rs");
}

pub use compatibility::PROTOCOL;
