//! Camera, laser, beams and true depth: what the description and the file say, combined.

use picofarm_dataset::{Gate, Intrinsics};
use serde_json::Value;

use super::super::super::files::Files;
use super::super::super::scene::{direction, intrinsics_from_fov};
use super::super::super::vector::{distance, norm};
use super::super::super::{ImportError, npy};
use super::super::Beam;
use super::super::arrays::Part;
use super::{Described, Description};

/// Most beams of a capture.
const MOST_BEAMS: usize = 1 << 14;

/// The calibration that a capture needs in addition to histograms.
pub(in super::super) struct Calibration {
    pub gate: Gate,
    pub intrinsics: Intrinsics,
    pub laser: [f32; 3],
    pub beams: Vec<Beam>,
    pub depth: Option<Vec<f32>>,
    pub notes: Vec<String>,
}

impl Description {
    /// For each of our axes (right, down, forward): index of the description's axis, and sign.
    fn frame(&self, described: &Described) -> Result<[(usize, f64); 3], ImportError> {
        let Some(names) = &self.frame else {
            return Ok([(0, 1.0), (1, 1.0), (2, 1.0)]);
        };
        let expected = "right or left, down or up, forward or backward, each once";
        let refused = || described.refused("frame", expected, format!("{names:?}"));
        let mut axes = [None; 3];
        for (from, name) in names.iter().enumerate() {
            let (to, sign) = match name.as_str() {
                "right" => (0, 1.0),
                "left" => (0, -1.0),
                "down" => (1, 1.0),
                "up" => (1, -1.0),
                "forward" => (2, 1.0),
                "backward" => (2, -1.0),
                _ => return Err(refused()),
            };
            axes[to] = Some((from, sign));
        }
        let [Some(x), Some(y), Some(z)] = axes else {
            return Err(refused());
        };
        Ok([x, y, z])
    }

    /// The laser in the camera's axes.
    pub(super) fn laser(&self, described: &Described) -> Result<Option<[f64; 3]>, ImportError> {
        let Some(laser) = self.laser_m else {
            return Ok(None);
        };
        let frame = self.frame(described)?;
        Ok(Some(frame.map(|(from, sign)| sign * laser[from])))
    }

    /// Points of the description in the camera's axes.
    fn points(
        &self,
        field: &str,
        value: &Value,
        described: &Described,
        reader: &Files,
    ) -> Result<Option<Vec<[f64; 3]>>, ImportError> {
        let expected = "a list of [x, y, z] in metres for each spot, e.g. [[-0.3, 0.1, 2.0], [0.25, 0.15, 2.1]], or the name of a .npy file [spots, 3]";
        let rows: Vec<[f64; 3]> = match value {
            Value::Null => return Ok(None),
            Value::String(name) => {
                let path = reader.named(&described.folder, name)?;
                let array = npy::parse(&path, &reader.bytes(&path)?)?;
                if array.shape.len() != 2 || array.shape[1] != 3 {
                    let found = format!("an array {:?} in {name}", array.shape);
                    return Err(described.refused(field, expected, found));
                }
                let rows = array.values.chunks_exact(3);
                rows.map(|r| [r[0], r[1], r[2]].map(f64::from)).collect()
            }
            list => serde_json::from_value(list.clone())
                .map_err(|e| described.refused(field, expected, e.to_string()))?,
        };
        if rows.is_empty() || rows.len() > MOST_BEAMS {
            let found = format!("{} rows", rows.len());
            return Err(described.refused(field, format!("1 to {MOST_BEAMS} rows"), found));
        }
        let frame = self.frame(described)?;
        let turn = |r: &[f64; 3]| frame.map(|(from, sign)| sign * r[from]);
        Ok(Some(rows.iter().map(turn).collect()))
    }

    /// Returns the camera's intrinsics.
    fn intrinsics(
        &self,
        (height, width): (usize, usize),
        described: &Described,
    ) -> Result<Option<Intrinsics>, ImportError> {
        let Some(c) = &self.camera else {
            return Ok(None);
        };
        let found = c.to_string();
        if let Some(fov) = c.fov_deg {
            if c.fx.or(c.fy).or(c.cx).or(c.cy).is_some() {
                let what = "fov_deg alone, or fx, fy, cx, cy";
                return Err(described.refused("camera", what, found));
            }
            if !(fov > 0.0 && fov < 180.0) {
                let what = "more than 0 and less than 180: the width of the view in degrees";
                return Err(described.refused("camera.fov_deg", what, fov.to_string()));
            }
            return Ok(Some(intrinsics_from_fov(width as u32, height as u32, fov)));
        }
        let Some(fx) = c.fx else {
            return Err(described.refused("camera", "fov_deg, or fx, fy, cx, cy in pixels", found));
        };
        let fy = c.fy.unwrap_or(fx);
        let (cx, cy) = (
            c.cx.unwrap_or(width as f64 / 2.0),
            c.cy.unwrap_or(height as f64 / 2.0),
        );
        if !(fx > 0.0 && fy > 0.0 && [fx, fy, cx, cy].iter().all(|x| x.is_finite())) {
            return Err(described.refused("camera", "positive focal lengths in pixels", found));
        }
        Ok(Some(Intrinsics {
            fx: fx as f32,
            fy: fy as f32,
            cx: cx as f32,
            cy: cy as f32,
        }))
    }

    /// Combines what the description and the file say. The description has precedence.
    pub fn calibration(
        &self,
        part: &Part,
        described: &Described,
        reader: &Files,
    ) -> Result<Calibration, ImportError> {
        let [spots, height, width, bins] = part.dims;
        let mut notes = Vec::new();
        let mut overridden = |what: &str| {
            notes.push(format!("{what} of the file replaced by the description's"));
        };
        let gate = match part.binned {
            true => part.stated.gate,
            false => {
                let ours = self.gate_m(described)?;
                if ours.is_some() && part.stated.gate.is_some() {
                    overridden("the gate");
                }
                ours.or(part.stated.gate)
            }
        };
        let camera = self.intrinsics((height, width), described)?;
        let laser = self.laser(described)?;
        let places = self.points("spots_m", &self.spots_m, described, reader)?;
        let ways = self.points("directions", &self.directions, described, reader)?;
        for (what, ours, theirs) in [
            (
                "the camera",
                camera.is_some(),
                part.stated.intrinsics.is_some(),
            ),
            ("the laser", laser.is_some(), part.stated.laser.is_some()),
            (
                "the spots",
                places.is_some() || ways.is_some(),
                part.stated.beams.is_some(),
            ),
        ] {
            if ours && theirs {
                overridden(what);
            }
        }
        let camera = camera.or(part.stated.intrinsics);
        let laser = laser.or(part.stated.laser);
        let beams = match (places, ways) {
            (Some(_), Some(_)) => {
                return Err(described.refused("spots_m", "spots_m or directions", "both"));
            }
            (Some(places), None) => {
                let laser = laser.unwrap_or_default();
                Some(places.iter().map(|p| placed(*p, laser)).collect())
            }
            (None, Some(ways)) => {
                let towards: Result<Vec<Beam>, ImportError> = ways
                    .iter()
                    .enumerate()
                    .map(|(k, way)| {
                        directed(*way).ok_or_else(|| {
                            let what = "a direction that is not zero";
                            described.refused(format!("directions[{k}]"), what, format!("{way:?}"))
                        })
                    })
                    .collect();
                Some(towards?)
            }
            (None, None) => part.stated.beams.clone(),
        };
        let lacking: Vec<&str> = [
            ("gate", gate.is_none()),
            ("camera", camera.is_none()),
            ("laser_m", laser.is_none()),
            ("spots_m (or directions)", beams.is_none()),
        ]
        .into_iter()
        .filter_map(|(name, lacks)| lacks.then_some(name))
        .collect();
        let (Some([start_m, bin_width_m]), Some(intrinsics), Some(laser), Some(beams)) =
            (gate, camera, laser, beams)
        else {
            let found = format!(
                "{} histograms of {height}x{width} pixels and {bins} bins in {}",
                spots,
                reader.name(&part.file)
            );
            return Err(described.refused(
                lacking.join(", "),
                "a value: the files do not say it",
                found,
            ));
        };
        if part.apart && beams.len() != spots {
            let what = format!(
                "{spots}, one for each histogram of [spot, row, column, bin] = {:?} in {}",
                part.dims,
                reader.name(&part.file)
            );
            let hint = "correct the list, or, if the array has other axes, name them in their order in \"axes\", for example [\"row\", \"column\", \"spot\", \"bin\"]";
            return Err(ImportError::refused(
                &described.file,
                "spots_m, directions",
                what,
                beams.len().to_string(),
                hint,
            ));
        }
        if let Some(given) = self
            .gate
            .bins
            .filter(|b| !part.binned && *b as usize != bins)
        {
            return Err(described.refused(
                "gate.bins",
                format!("{bins}, as the file has"),
                given.to_string(),
            ));
        }
        let depth = self.depth(intrinsics, (height, width), described, reader)?;
        let depth = depth.or_else(|| part.stated.depth.clone());
        Ok(Calibration {
            gate: Gate {
                start_m,
                bin_width_m,
                bins: bins as u32,
            },
            intrinsics,
            laser: laser.map(|x| x as f32),
            beams,
            depth,
            notes,
        })
    }

    /// The true z-depth.
    fn depth(
        &self,
        intrinsics: Intrinsics,
        (height, width): (usize, usize),
        described: &Described,
        reader: &Files,
    ) -> Result<Option<Vec<f32>>, ImportError> {
        let (field, name) = match (&self.depth_m, &self.range_m) {
            (None, None) => return Ok(None),
            (Some(name), None) => ("depth_m", name),
            (None, Some(name)) => ("range_m", name),
            (Some(_), Some(_)) => {
                return Err(described.refused("depth_m", "depth_m or range_m", "both"));
            }
        };
        let path = reader.named(&described.folder, name)?;
        let array = npy::parse(&path, &reader.bytes(&path)?)?;
        if array.shape != [height, width] {
            let expected = format!("an image [{height}, {width}]");
            let turned = match array.shape == [width, height] {
                true => {
                    ": rows and columns of the histograms are exchanged in \"axes\", or those of the image"
                }
                false => "",
            };
            let found = format!("{:?}{turned}", array.shape);
            return Err(described.refused(field, expected, found));
        }
        let z = |(pixel, value): (usize, &f32)| {
            let ray = direction(intrinsics, pixel / width, pixel % width);
            match () {
                () if !value.is_finite() || *value <= 0.0 => 0.0,
                () if field == "depth_m" => *value,
                () => value / norm(ray) as f32,
            }
        };
        Ok(Some(array.values.iter().enumerate().map(z).collect()))
    }
}

/// A spot that a straight beam reaches; nothing for a point that is not finite.
pub(in super::super) fn placed(point: [f64; 3], laser: [f64; 3]) -> Beam {
    match point.iter().all(|x| x.is_finite()) {
        true => Beam::Spot {
            position: point.map(|x| x as f32),
            path_m: distance(point, laser) as f32,
        },
        false => Beam::Nothing,
    }
}

/// A beam of a direction, which need not be a unit vector.
fn directed(way: [f64; 3]) -> Option<Beam> {
    let length = norm(way);
    (length.is_finite() && length > 0.0).then(|| Beam::Direction(way.map(|x| (x / length) as f32)))
}
