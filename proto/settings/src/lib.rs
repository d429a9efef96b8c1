//! The plain settings shared by jobs, data sets, the renderer and the networks. Each is declared
//! once in this crate, and all other crates use its type. [`random`] has the random numbers that
//! all of them share.

mod gate;
mod gpus;
mod network;
mod optics;
pub mod random;
mod reconstruct;
mod render;
mod resolution;
mod rooms;
pub mod sensor;
mod spots;
mod wavelengths;

pub use gate::Gate;
pub use gpus::Gpus;
pub use network::{
    Architecture, EvidenceForm, Precision, Schedule, ShadowVariant, StemForm, Swin, Target,
    TimeProjection,
};
pub use optics::Optics;
pub use reconstruct::{FieldKind, GridSettings, MOST_NODES, MlpSettings, ShadowLoss, Shadows};
pub use render::{BeamWidth, Budget, Choice, Strategy};
pub use resolution::Resolution;
pub use rooms::{FloorPlan, MirrorWall, PrimitiveRooms, Sizes};
pub use sensor::{
    Afterpulsing, Crosstalk, DeadTime, Jitter, PS_PER_M, Preset, Pulse, Scale, Sensor, SensorError,
    TimeGate, Zones,
};
pub use spots::Spots;
pub use wavelengths::{WAVELENGTHS_NM, Wavelength};
