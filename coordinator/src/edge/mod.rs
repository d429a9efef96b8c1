//! The side of the coordinator that faces the network: connections, the layers that each request
//! passes, the gRPC services, and the HTTP pages.

mod charged;
mod connections;
mod guard;
mod http;
mod rpc;
mod server;
mod timed;

pub use connections::Connections;
pub use server::{CoordinatorConfig, CoordinatorError, Running, serve};
