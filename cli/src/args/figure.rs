//! The arguments of `figure`.

use std::path::PathBuf;

use clap::{Args, ValueEnum};

/// A panel of a figure.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum PanelArg {
    Image,
    Depth,
    Range,
    Normals,
    Labels,
    Masks,
    /// The mask of one spot.
    Mask(usize),
    Mirrors,
    Error,
    Light,
    Transient,
    Histogram,
}

/// The names of panels, for messages.
const PANELS: &str = "image, depth, range, normals, labels, masks, mask:SPOT, mirrors, error, \
                      light, transient or histogram";

#[derive(Args)]
pub struct Figure {
    /// Folder of `picofarm scene render`, or folder or URL of a data set
    #[arg(value_parser = crate::args::location::parse)]
    pub render: String,
    /// Scene of a data set, by its number
    #[arg(long, default_value_t = 0, value_name = "N", value_parser = super::ranges::whole)]
    pub scene: u64,
    /// Panels in their order: image, depth, range, normals, labels, masks (the number of spots that
    /// light a pixel), mask:SPOT (one spot's), mirrors, error (of a render with --split), light
    /// (all of it), transient (light in flight at --times), histogram (of --pixel)
    #[arg(long, value_delimiter = ',', value_name = "PANEL,…", value_parser = panel, default_values = ["image", "depth", "light", "masks", "transient", "histogram"])]
    pub panels: Vec<PanelArg>,
    /// Times of light in flight, after the pulse leaves the laser [default: when 10, 40 and 75 % of
    /// the light have arrived]
    #[arg(long, value_delimiter = ',', value_name = "8ns,10ns,…", value_parser = time)]
    pub times: Vec<f64>,
    /// Pixel of the histogram, counted from 0 at the top left [default: the middle]
    #[arg(long, value_name = "COLUMN,ROW", value_parser = pixel)]
    pub pixel: Option<[usize; 2]>,
    /// File to write; its extension .svg, .pdf or .png is the format; without one, all three
    #[arg(long, short, value_name = "FILE", required_unless_present = "animate")]
    pub output: Option<PathBuf>,
    /// Also write light in flight as an animated GIF
    #[arg(long, value_name = "FILE.gif")]
    pub animate: Option<PathBuf>,
    /// Width of the figure
    #[arg(long, default_value = "180mm", value_name = "85mm", value_parser = width)]
    pub width: f64,
    /// Panels in a row [default: as many as are 42 mm wide]
    #[arg(long, value_name = "N", value_parser = columns)]
    pub columns: Option<usize>,
    /// Resolution of PNG in pixels per inch
    #[arg(long, default_value_t = 300, value_name = "DPI", value_parser = clap::value_parser!(u32).range(36..=2400))]
    pub dpi: u32,
    /// Colour map of depth, counts, errors and light
    #[arg(long, value_enum, default_value_t = ColoursArg::Viridis)]
    pub colours: ColoursArg,
    /// Replace files that exist
    #[arg(long)]
    pub overwrite: bool,
}

/// A perceptually uniform colour map.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum ColoursArg {
    Viridis,
    Inferno,
}

fn panel(text: &str) -> Result<PanelArg, String> {
    Ok(match text.trim() {
        "image" => PanelArg::Image,
        "depth" => PanelArg::Depth,
        "range" => PanelArg::Range,
        "normals" => PanelArg::Normals,
        "labels" => PanelArg::Labels,
        "masks" => PanelArg::Masks,
        "mirrors" => PanelArg::Mirrors,
        "error" => PanelArg::Error,
        "light" => PanelArg::Light,
        "transient" => PanelArg::Transient,
        "histogram" => PanelArg::Histogram,
        other => {
            let spot = other.strip_prefix("mask:").and_then(|n| n.parse().ok());
            PanelArg::Mask(spot.ok_or(format!("expected {PANELS}"))?)
        }
    })
}

/// Parses a number with a unit.
fn with_unit(text: &str, units: &[(&str, f64)]) -> Option<f64> {
    let text = text.trim();
    let (number, factor) = units
        .iter()
        .find_map(|(unit, factor)| Some((text.strip_suffix(unit)?, *factor)))?;
    let number: f64 = number.trim().parse().ok()?;
    let value = number * factor;
    (value.is_finite() && value > 0.0).then_some(value)
}

/// Parses a time into nanoseconds.
fn time(text: &str) -> Result<f64, String> {
    with_unit(text, &[("ns", 1.0), ("ps", 1e-3)])
        .ok_or_else(|| "expected a time such as 8ns or 8250ps".into())
}

/// Parses a width into millimetres.
fn width(text: &str) -> Result<f64, String> {
    with_unit(text, &[("mm", 1.0), ("cm", 10.0), ("in", 25.4)])
        .filter(|mm| (20.0..=1000.0).contains(mm))
        .ok_or_else(|| "expected a width of 20 mm to 1 m, such as 85mm, 8.5cm or 3.35in".into())
}

fn pixel(text: &str) -> Result<[usize; 2], String> {
    let (column, row) = text
        .split_once(',')
        .ok_or("expected COLUMN,ROW, such as 32,20")?;
    let number = |text: &str| {
        let number = text.trim().parse::<usize>();
        number.map_err(|_| format!("{text:?}: expected a whole number, counted from 0"))
    };
    Ok([number(column)?, number(row)?])
}

fn columns(text: &str) -> Result<usize, String> {
    let number = text.trim().parse::<usize>().ok();
    number
        .filter(|n| (1..=20).contains(n))
        .ok_or_else(|| "expected 1 to 20 panels in a row".into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lengths_times_and_pixels_need_their_units() {
        assert_eq!(width("85mm"), Ok(85.0));
        assert_eq!(width("3in").map(|mm| (mm * 10.0).round()), Ok(762.0));
        assert_eq!(time(" 8 ns"), Ok(8.0));
        assert_eq!(time("500ps"), Ok(0.5));
        assert_eq!(pixel("3, 4"), Ok([3, 4]));
        for wrong in ["85", "-3mm", "nanmm", "2km", "1mm"] {
            assert!(width(wrong).unwrap_err().contains("85mm"), "{wrong}");
        }
        assert!(time("8").is_err() && time("-1ns").is_err());
        assert!(pixel("3").is_err() && pixel("a,1").is_err());
        assert_eq!(panel("mask:3"), Ok(PanelArg::Mask(3)));
        assert!(panel("mask:").unwrap_err().contains("depth"));
    }
}
