//! Tools for pictures and pages of results: a canvas, colour maps, PNG, GIF; numbers and texts in
//! HTML. [`scene`] draws stored scenes, [`paper`] figures for papers; the rest is independent of
//! the content.

mod animation;
mod canvas;
mod colour;
pub mod number;
mod page;
pub mod paper;
mod rgb_png;
pub mod scene;
pub mod text;

pub use animation::animation;
pub use canvas::{Canvas, TEXT};
pub use colour::{inferno, viridis};
pub use page::{STYLE, data_url};
pub use rgb_png::{rgb_png, rgb_png_with_density};
