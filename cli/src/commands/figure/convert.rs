//! SVG to PNG and PDF, with a font of the program's own, so that every machine draws the same.

use std::sync::Arc;

use picofarm_figures::paper::Drawn;
use resvg::{
    tiny_skia::{Pixmap, Transform},
    usvg::{Options, Tree, fontdb::Database},
};

use super::Format;
use crate::error::{CliError, Code, Result};

/// Points in an inch, which is the unit of the parsed document.
const POINTS: f32 = 72.0;
/// The most pixels of a PNG.
const MOST: f64 = 400e6;

/// Returns the figure as PDF, or as PNG with this many pixels per inch.
///
/// # Errors
/// Fails for a PNG of too many pixels.
pub(super) fn convert(drawn: &Drawn, format: Format, dpi: u32) -> Result<Vec<u8>> {
    let mut fonts = Database::new();
    fonts.load_font_data(epaint_default_fonts::UBUNTU_LIGHT.to_vec());
    fonts.set_sans_serif_family("Ubuntu");
    let options = Options {
        dpi: POINTS,
        fontdb: Arc::new(fonts),
        ..Options::default()
    };
    let broken = |e: &dyn std::fmt::Display| {
        CliError::new(Code::Failed, format!("the figure cannot be converted: {e}"))
    };
    let tree = Tree::from_str(&drawn.svg, &options).map_err(|e| broken(&e))?;
    if format == Format::Pdf {
        let page = svg2pdf::PageOptions { dpi: POINTS };
        let conversion = svg2pdf::ConversionOptions::default();
        let pdf = svg2pdf::to_pdf(&tree, conversion, page).map_err(|e| broken(&e))?;
        return Ok(ordered(&pdf));
    }
    let pixels = |mm: f64| (mm / 25.4 * f64::from(dpi)).round().max(1.0);
    let (width, height) = (pixels(drawn.width_mm), pixels(drawn.height_mm));
    if width * height > MOST {
        let what = format!("--dpi {dpi}: the PNG would have {width} x {height} pixels");
        return Err(CliError::input(what).hint("choose a smaller --dpi or --width"));
    }
    let mut pixmap = Pixmap::new(width as u32, height as u32)
        .ok_or_else(|| broken(&"no room for its pixels"))?;
    let size = tree.size();
    let scale = Transform::from_scale(width as f32 / size.width(), height as f32 / size.height());
    resvg::render(&tree, scale, &mut pixmap.as_mut());
    with_density(pixmap, dpi)
}

/// Sorts the entries of each dictionary of resources. svg2pdf writes them in the order of a hash
/// map, which differs from run to run. Entries are whole lines, so no offset of an object changes.
fn ordered(pdf: &[u8]) -> Vec<u8> {
    let is_entry = |line: &[u8]| line.trim_ascii().starts_with(b"/") && line.ends_with(b" 0 R");
    let mut sorted: Vec<&[u8]> = Vec::new();
    let mut first = 0;
    let mut within_stream = false;
    for line in pdf.split(|b| *b == b'\n') {
        within_stream = match line {
            b"stream" => true,
            _ => within_stream && !line.ends_with(b"endstream"),
        };
        if within_stream || !is_entry(line) {
            if let Some(entries) = sorted.get_mut(first..) {
                entries.sort_unstable();
            }
            first = sorted.len() + 1;
        }
        sorted.push(line);
    }
    sorted.join(&b'\n')
}

/// Encodes the pixels, which cover the page, with their density.
fn with_density(pixmap: Pixmap, dpi: u32) -> Result<Vec<u8>> {
    let (width, height) = (pixmap.width(), pixmap.height());
    let rgb: Vec<u8> = pixmap
        .pixels()
        .iter()
        .flat_map(|p| [p.red(), p.green(), p.blue()])
        .collect();
    let metre = (f64::from(dpi) / 0.0254).round() as u32;
    Ok(picofarm_figures::rgb_png_with_density(
        width, height, &rgb, metre,
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn entries_of_resources_are_sorted_and_streams_are_kept() {
        let pdf = b"<<\n  /xo1 8 0 R\n  /xo0 9 0 R\n>>\nstream\n/b 1 0 R\n/a 1 0 R\nendstream\nend";
        let expected =
            b"<<\n  /xo0 9 0 R\n  /xo1 8 0 R\n>>\nstream\n/b 1 0 R\n/a 1 0 R\nendstream\nend";
        assert_eq!(ordered(pdf), expected);
    }
}
