//! What pictures and pages of results are made with: a canvas, colour maps, PNG; numbers and texts in HTML. Knows nothing of
//! what is shown.

mod canvas;
mod colour;
pub mod number;
mod page;
mod rgb_png;
pub mod text;

pub use canvas::{Canvas, TEXT};
pub use colour::{inferno, viridis};
pub use page::{STYLE, data_url};
pub use rgb_png::rgb_png;
