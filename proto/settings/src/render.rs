//! The renderer's budget and techniques.

use serde::{Deserialize, Serialize};

/// The amount of multi-bounce work.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Budget {
    /// Camera paths per pixel.
    Samples(u32),
    /// Stops when the median per-pixel relative standard error has fallen to this fraction (0.1 =
    /// 10 %).
    Error(f64),
}

/// Techniques chosen by hand; by default the renderer chooses them for the scene. Every choice
/// gives the same expected result, some with far more noise.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Strategy {
    /// Side in pixels of the tiles that share vertices, 1 to 32; at 1, each pixel is separate.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub path_reuse: Option<u32>,
    /// Whether walks connect to light vertices drawn from the spots.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub light_vertices: Option<bool>,
    /// Whether to aim at the spots' mirror images in planar near-mirrors.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mirror_images: Option<bool>,
    /// Whether to trace light paths from the spots for light from near-mirrors without mirror
    /// images: curved ones, and several in a row.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub caustics: Option<bool>,
    /// Whether to search for light in the ellipsoidal shells of a narrow gate. Light outside the
    /// gate is then not searched for, so that the overflow stated by a render is a lower bound.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ellipsoidal: Option<bool>,
}

/// A choice by hand of one of [`Strategy::NAMES`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Choice {
    /// Used or not.
    On(bool),
    /// A size, in the unit that the name implies.
    Size(u32),
}

impl Strategy {
    /// The names of the techniques in job files and `--strategy`.
    pub const NAMES: [&str; 5] = [
        "path_reuse",
        "light_vertices",
        "mirror_images",
        "caustics",
        "ellipsoidal",
    ];

    /// Returns whether every technique is left to the renderer.
    pub fn is_default(&self) -> bool {
        *self == Self::default()
    }

    /// Chooses one technique by its name.
    ///
    /// # Errors
    /// Returns a message about an unknown name or a choice of the wrong kind.
    pub fn choose(&mut self, name: &str, choice: Choice) -> Result<(), String> {
        let way = match name {
            "path_reuse" => {
                let Choice::Size(side) = choice else {
                    return Err(format!("{name:?} takes a number"));
                };
                self.path_reuse = Some(side);
                return Ok(());
            }
            "light_vertices" => &mut self.light_vertices,
            "mirror_images" => &mut self.mirror_images,
            "caustics" => &mut self.caustics,
            "ellipsoidal" => &mut self.ellipsoidal,
            _ => {
                let names = Self::NAMES.join(", ");
                return Err(format!("{name:?} is unknown; there are {names}"));
            }
        };
        let Choice::On(on) = choice else {
            return Err(format!("{name:?} is either on (true) or off (false)"));
        };
        *way = Some(on);
        Ok(())
    }
}

/// The width of a laser's beams, as data sheets state it: Gaussian, by the diameter at which the
/// intensity has fallen to 1/e². At a distance z it is √(`diameter_mm`² + (`divergence_mrad` · z in
/// metres)²) millimetres.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct BeamWidth {
    /// Diameter at the laser, millimetres.
    pub diameter_mm: f64,
    /// Divergence, full angle, milliradians.
    pub divergence_mrad: f64,
    /// Rays that represent a beam, each with an equal fraction of its light, like additional spots.
    /// More rays take more time.
    pub points: u32,
}

impl Default for BeamWidth {
    fn default() -> Self {
        Self {
            diameter_mm: 0.0,
            divergence_mrad: 0.0,
            points: 16,
        }
    }
}

impl BeamWidth {
    /// Checks the fields against their limits.
    ///
    /// # Errors
    /// Returns the field and the expected range.
    pub fn check(&self) -> Result<(), (&'static str, String)> {
        let range = |field, value: f64, most: f64, unit: &str| match (0.0..=most).contains(&value) {
            true => Ok(()),
            false => Err((field, format!("is {value}, expected 0 to {most} {unit}"))),
        };
        let (wide, angle) = (self.diameter_mm, self.divergence_mrad);
        range("diameter_mm", wide, 1000.0, "mm (1/e² of the intensity)")?;
        range("divergence_mrad", angle, 500.0, "mrad (full angle, 1/e²)")?;
        if wide == 0.0 && angle == 0.0 {
            let what = "is 0, and so is divergence_mrad; give one of them, or leave the beam out: without it beams have no width";
            return Err(("diameter_mm", what.into()));
        }
        match self.points {
            4..=64 => Ok(()),
            n => Err((
                "points",
                format!("is {n}, expected 4 to 64 rays for each beam"),
            )),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_width_without_a_size_or_beyond_any_laser_is_refused_by_its_field() {
        let of = |diameter_mm, divergence_mrad, points| {
            let width = BeamWidth {
                diameter_mm,
                divergence_mrad,
                points,
            };
            width.check().map_err(|(field, _)| field)
        };
        assert_eq!(of(4.0, 0.0, 16), Ok(()));
        assert_eq!(of(0.0, 1.5, 64), Ok(()));
        assert_eq!(of(0.0, 0.0, 16), Err("diameter_mm"));
        assert_eq!(of(-1.0, 1.0, 16), Err("diameter_mm"));
        assert_eq!(of(f64::NAN, 1.0, 16), Err("diameter_mm"));
        assert_eq!(of(1.0, 501.0, 16), Err("divergence_mrad"));
        assert_eq!(of(1.0, 1.0, 3), Err("points"));
        assert_eq!(of(1.0, 1.0, 65), Err("points"));
    }

    #[test]
    fn every_field_is_a_name_and_takes_one_kind_of_choice() {
        let mut all = Strategy::default();
        for name in Strategy::NAMES {
            let of = |choice| Strategy::default().choose(name, choice).is_ok();
            assert!(of(Choice::On(true)) != of(Choice::Size(2)), "{name}");
            all.choose(name, Choice::On(true))
                .or_else(|_| all.choose(name, Choice::Size(2)))
                .unwrap();
        }
        let written = serde_json::to_value(all).unwrap();
        let mut fields: Vec<_> = written.as_object().unwrap().keys().collect();
        let mut names = Strategy::NAMES.to_vec();
        fields.sort_unstable();
        names.sort_unstable();
        assert_eq!(fields, names);
        assert_eq!(serde_json::from_value::<Strategy>(written).unwrap(), all);
    }

    #[test]
    fn an_unknown_way_is_refused_with_the_names_there_are() {
        let error = Strategy::default().choose("lobes", Choice::On(true));
        assert!(error.unwrap_err().contains("path_reuse, light_vertices"));
    }
}
