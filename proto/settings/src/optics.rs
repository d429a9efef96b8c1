//! The optics of a render: the laser's beams, its wavelength, and the pixels' sensitive area.

use serde::{Deserialize, Serialize};

use crate::{BeamWidth, Wavelength};

/// The optics of laser and pixels. Jobs, the command line and the renderer carry it whole, so a new
/// setting is declared here, read in a job file and by the command line, and used by the renderer.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Optics {
    /// The width of the laser's beams; `None` renders beams without a width. Spots and ground truth
    /// are always those of the beams' centres.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub beam: Option<BeamWidth>,
    /// Sensitive share of each pixel's area, 0.01 to 1: a square in the pixel's middle. Histograms
    /// are means over this square; the ground truth is always taken at the pixels' middles.
    #[serde(skip_serializing_if = "is_whole")]
    pub fill_factor: f64,
    /// Wavelength of the laser. Without one, materials reflect as at the laser's own wavelength.
    #[serde(skip_serializing_if = "Wavelength::is_none")]
    pub wavelengths_nm: Wavelength,
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "as serde passes it")]
fn is_whole(share: &f64) -> bool {
    *share == 1.0
}

impl Default for Optics {
    /// Returns beams without a width, fully sensitive pixels and no wavelength.
    fn default() -> Self {
        Self {
            beam: None,
            fill_factor: 1.0,
            wavelengths_nm: Wavelength::NONE,
        }
    }
}

impl Optics {
    /// Checks the fields against their limits.
    ///
    /// # Errors
    /// Returns the field, such as `beam.diameter_mm`, and the expected range.
    pub fn check(&self) -> Result<(), (String, String)> {
        if !(0.01..=1.0).contains(&self.fill_factor) {
            let what = format!(
                "is {}, expected 0.01 to 1 of a pixel's area; 1 is all of it",
                self.fill_factor
            );
            return Err(("fill_factor".into(), what));
        }
        let width = self.beam.map_or(Ok(()), |beam| beam.check());
        width.map_err(|(field, what)| (format!("beam.{field}"), what))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_default_passes_its_check_and_is_written_as_nothing() {
        let optics = Optics::default();
        assert_eq!(optics.check(), Ok(()));
        assert_eq!(serde_json::to_string(&optics).unwrap(), "{}");
        assert_eq!(serde_json::from_str::<Optics>("{}").unwrap(), optics);
    }

    #[test]
    fn a_field_outside_its_limits_is_named() {
        let field = |optics: Optics| optics.check().unwrap_err().0;
        for fill_factor in [0.0, -0.5, 0.009, 1.01, f64::NAN] {
            let optics = Optics {
                fill_factor,
                ..Optics::default()
            };
            assert_eq!(field(optics), "fill_factor");
        }
        let beam = Some(BeamWidth::default());
        let optics = Optics {
            beam,
            ..Optics::default()
        };
        assert_eq!(field(optics), "beam.diameter_mm");
    }
}
