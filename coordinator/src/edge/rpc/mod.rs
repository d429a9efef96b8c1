//! The gRPC services. Protobuf types stay in this module; the rest uses the checked model.

mod beats;
mod examinations;
mod examine;
mod farm;
mod jobs;
mod link;
mod look;
mod requests;
mod rights;
mod watch;

pub(crate) use farm::FarmService;
pub(crate) use jobs::JobsService;
pub(crate) use link::Link;
