//! Common parts of all report pages: their style, and embedded pictures.

use base64::{Engine, engine::general_purpose::STANDARD};

/// The style sheet: light and dark, for screen and paper.
pub const STYLE: &str = include_str!("page.css");

/// Returns a data URL with a PNG.
pub fn data_url(png: &[u8]) -> String {
    format!("data:image/png;base64,{}", STANDARD.encode(png))
}
