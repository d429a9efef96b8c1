//! Light that glass turns: reflected by panes, or reflected and refracted by bodies of glass.
//!
//! Surfaces scatter, but glass turns a ray without a choice of direction, so no connection between
//! two points finds such a path. Such light therefore has paths of its own, drawn into the
//! image in addition to all other techniques, for which thin glass only transmits and bodies are
//! black. Call the path between two surface points a *leg*, including the camera's first and the
//! spot's last. A leg is *turned* if glass reflects or refracts light on it. Paths without a turned
//! leg belong to the other techniques. The rest are divided as follows:
//!
//! 1. Paths whose last leg is straight, or turned by the reflection of one planar pane alone, are
//!    camera paths. They are connected to the spots and to their [`images`]. If straight legs alone
//!    lead from a spot to a Lambertian point, and a pane's reflection leads from there to the next
//!    point, the path is connected to that point's image instead ([`lit`]).
//! 2. The others are light paths. Read from the camera, the first straight leg joins the two: if it
//!    is the camera's own leg, the light path is drawn into the image; otherwise camera paths with
//!    only turned legs are connected to the light path's vertices.
//!
//! If no leg is straight, light paths with only turned legs and camera paths with a turned first
//! leg join on a surface: see [`photons`]. This technique is the only approximation: it blurs its
//! result over about a pixel. It includes the spots themselves if the camera sees them in bodies of
//! glass or via several panes; a spot that a single planar pane shows is a point of light
//! ([`images`]). Each class is sampled by one technique, so nothing is weighted and nothing is
//! counted twice. A reflection counts as a bounce, and refraction does not; a spot that the camera
//! sees by refraction alone, with one bounce, is left out.
//!
//! Camera paths that scatter aim half of their directions at glass: see [`aim`].
//!
//! On a leg every pane in the way may reflect, and the transmitted light goes on. Until the first
//! turn, a reflection is chosen more often than its share of the light, because only such paths
//! contribute.

pub(crate) mod aim;
pub(crate) mod arrive;
pub(crate) mod buffers;
pub(crate) mod camera;
pub(crate) mod contribution;
pub(crate) mod images;
pub(crate) mod light_paths;
pub(crate) mod lit_points;
pub(crate) mod photons;
pub(crate) mod point;
pub(crate) mod ray;
pub(crate) mod straight;
pub(crate) mod technique;
