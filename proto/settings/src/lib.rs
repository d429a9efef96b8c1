//! The plain settings that jobs, data sets, the renderer and the networks share: each is declared here once, and every
//! other crate uses this one type. Nothing here computes, reads or sends anything.

mod gate;
mod gpus;
mod network;
mod reconstruct;
mod render;
pub mod sensor;

pub use gate::Gate;
pub use gpus::Gpus;
pub use network::{
    Architecture, Precision, Schedule, ShadowVariant, StemForm, Swin, Target, TimeProjection,
};
pub use reconstruct::{FieldKind, GridSettings, MOST_NODES, MlpSettings, ShadowLoss, Shadows};
pub use render::{Budget, Choice, Strategy};
pub use sensor::{DeadTime, Jitter, PS_PER_M, Pulse, Scale, Sensor, SensorError};
