//! What all pages of reports have: how they look, and pictures inside of them.

use base64::{Engine, engine::general_purpose::STANDARD};

/// How a page looks: light and dark, on screen and on paper.
pub const STYLE: &str = include_str!("page.css");

/// A PNG as a URL that holds it.
pub fn data_url(png: &[u8]) -> String {
    format!("data:image/png;base64,{}", STANDARD.encode(png))
}
