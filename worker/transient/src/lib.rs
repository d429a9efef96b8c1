//! The transient renderer: turns a scene into time-resolved histograms and ground truth. It does
//! not depend on jobs, stores or files.
//!
//! # Which technique finds which light
//!
//! A path is laser → spot → surfaces → camera. The spot counts as its first bounce.
//!
//! | light | technique | module |
//! | --- | --- | --- |
//! | one bounce | analytic: each spot is a point of light | `paths::one_bounce` |
//! | two bounces | strata of a pixel, each connected to every spot | `paths::two_bounce` |
//! | three and more | vertices shared by pixels, and walks | `paths::path_reuse`, `paths::walk` |
//! | by planar near-mirrors | aims at the mirror images of spots | `light::mirror_images` |
//! | by near-mirrors, many spots | aims of gather points at the mirrors | `light::reflectors` |
//! | by curved or several near-mirrors | light paths from the spots | `light::caustics` |
//! | near a spot that almost touches a surface | light paths within a zone | `light::contacts` |
//! | turned by panes or bodies of glass | camera and light paths of their own | `paths::glass` |
//! | in a narrow gate | vertices between ellipsoids | `paths::ellipsoid` |
//!
//! Techniques that find the same path are weighted by the balance heuristic; all others divide the
//! paths by their geometry, so that each path is found by one of them. Straight legs through thin
//! glass only lose light, so every technique multiplies its contributions by the transmittance.
//!
//! # How a render runs
//!
//! 1. `render::prepare` checks the settings, loads the scene in render units (`scene::load`),
//!    follows the beams to their spots (`light::beam`), and decides which techniques pay.
//! 2. `render::driver` makes rounds of passes until the budget is used or the error is reached.
//! 3. In each round, `render::tile` renders the tiles of the image on all threads: two bounces
//!    once, then pass by pass the light of three bounces and more. `render::sources` draws the
//!    light paths that cross tiles.
//! 4. `render::join` joins the new passes with the earlier ones, weighted by their number, and
//!    `render::error` estimates the error and the passes that are missing.
//! 5. `render::ready` adds the one-bounce peaks, the ground truth (`truth`) and the plan.
//!
//! Random numbers depend on seed, pixel and pass only, and every sum has a fixed order. So the
//! result has the same bits on any machine and with any number of threads.
//!
//! # Layers
//!
//! `render` → `paths`, `truth` → `light` → `scene`, `film` → `numeric`, `tuning`, `api`. A folder
//! imports only from layers to its right, and files never import each other in circles
//! (`tests/it/imports.rs`). Numbers chosen by benchmarks are in [`Tuning`].
//!
//! # Examples
//!
//! ```
//! use picofarm_scene::primitive::{PrimitiveSettings, generate};
//! use picofarm_transient::{Budget, Gate, Progress, Settings, render};
//!
//! struct Quiet;
//!
//! impl Progress for Quiet {
//!     fn at(&self, _done: f32) -> bool {
//!         true
//!     }
//! }
//!
//! let room = PrimitiveSettings { width: 8, height: 8, ..PrimitiveSettings::default() };
//! let gate = Gate { start_m: 0.0, bin_width_m: 0.5, bins: 64 };
//! let rendered = render(&generate(3, &room)?, &Settings::new(gate, Budget::Samples(2)), &Quiet)?;
//! assert_eq!(rendered.transient.len(), 8 * 8 * 64);
//! assert!(rendered.transient.iter().sum::<f32>() > 0.0);
//! # Ok::<(), picofarm_transient::RenderError>(())
//! ```

mod api;
mod film;
mod light;
mod numeric;
mod paths;
mod render;
mod scene;
mod truth;
mod tuning;

pub use api::*;
pub use light::beam::trace_spots;
pub use render::{
    driver::{plan, render, render_tuned, render_within},
    forecast::Forecast,
    part::{Part, PartOf, join_parts, render_part},
    variance::{ClassVariance, variance},
};
pub use scene::bvh::{
    nodes::Kernel,
    tree::{Bvh, Stack},
};
pub use tuning::{
    BeamTuning, CausticTuning, ContactTuning, EllipsoidTuning, ErrorTuning, GlassTuning,
    MirrorTuning, PathReuseTuning, ReflectorTuning, RoundTuning, TileEffort, Tuning,
    TwoBounceTuning, WalkTuning,
};
