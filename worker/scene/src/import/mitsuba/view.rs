//! Converts Mitsuba's sensor to the camera, and its narrow emitters to the laser's beams.

use crate::{
    Beam, Camera, Intrinsics, Laser, Vec3,
    export::mitsuba::text::{beam_text, sensor_text},
    import::quoted,
};

use super::{Reader, node::Node, properties};

/// The widest full angle of an emitter that counts as a beam, degrees.
const BEAM_DEG: f64 = 2.0;
/// Mitsuba's default film size.
const FILM: [f64; 2] = [768.0, 576.0];

impl Reader<'_> {
    pub(super) fn camera(&mut self, node: &Node) -> Result<Camera, String> {
        if let Some(extras) = &self.extras {
            if sensor_text(&extras.scene.camera) == node.text {
                return Ok(extras.scene.camera);
            }
            self.note(
                "camera",
                "edited since export; the sensor's parameters used",
            );
        }
        match node.kind.as_str() {
            "perspective" => {}
            "thinlens" => self.note("camera", "has a lens; a pinhole used"),
            other => {
                let what = format!("sensor {} is not supported; use perspective", quoted(other));
                return Err(node.fail(what));
            }
        }
        self.only(node, &properties::PERSPECTIVE)?;
        let mut film = FILM;
        let (mut crop, mut offset) = ([None; 2], [0.0; 2]);
        for child in self.children(node, "film")? {
            self.film(&child)?;
            for (k, name) in ["width", "height"].into_iter().enumerate() {
                film[k] = child.number(name)?.unwrap_or(film[k]);
            }
            for (k, name) in ["width", "height"].into_iter().enumerate() {
                crop[k] = child.number(&format!("crop_{name}"))?;
            }
            for (k, name) in ["x", "y"].into_iter().enumerate() {
                offset[k] = child.number(&format!("crop_offset_{name}"))?.unwrap_or(0.0);
            }
        }
        let whole = |x: f64| (1.0..=65536.0).contains(&x) && x.fract() == 0.0;
        if !film.iter().all(|&x| whole(x)) {
            return Err(node.fail("film: width and height must be whole numbers from 1 to 65536"));
        }
        let [width, height] = film;
        let inside = |k: usize| {
            let size = crop[k].unwrap_or(film[k]);
            whole(size)
                && offset[k] >= 0.0
                && offset[k].fract() == 0.0
                && offset[k] + size <= film[k]
        };
        if !(inside(0) && inside(1)) {
            return Err(node.fail("film: the crop window must be whole pixels inside the film"));
        }
        let diagonal = (width * width + height * height).sqrt();
        let fov = match (node.number("fov")?, self.focal_length_mm(node)?) {
            (Some(_), Some(_)) => return Err(node.fail("states both fov and focal_length")),
            (Some(fov), None) => fov,
            // As in Mitsuba, the focal length is that of a film of 36 mm by 24 mm, and its diagonal
            // is the film's.
            (None, focal) => {
                let mm = focal.unwrap_or(50.0);
                let half = libm::atan((36.0f64 * 36.0 + 24.0 * 24.0).sqrt() * 0.5 / mm);
                2.0 * half.to_degrees()
            }
        };
        let axis = match node.number("fov")? {
            Some(_) => node.text("fov_axis")?.unwrap_or("x"),
            None => "diagonal",
        };
        if !(0.001..=179.0).contains(&fov) {
            return Err(node.fail(format!("fov: {fov}; expected 0.001 to 179 degrees")));
        }
        let across = match axis {
            "x" => width,
            "y" => height,
            "diagonal" => diagonal,
            "smaller" => width.min(height),
            "larger" => width.max(height),
            other => {
                return Err(node.fail(format!(
                    "fov_axis: {}; use x, y, diagonal, smaller or larger",
                    quoted(other)
                )));
            }
        };
        let f = (across * 0.5 / libm::tan(fov.to_radians() * 0.5)) as f32;
        let principal = |name: &str| Ok::<_, String>(0.5 - node.number(name)?.unwrap_or(0.0));
        let pose = self.placed(&node.transform("to_world")?);
        let axis = |k: usize| {
            pose.axis(k)
                .ok_or_else(|| node.fail("to_world: has no inverse"))
        };
        Ok(Camera {
            intrinsics: Intrinsics {
                fx: f,
                fy: f,
                cx: (width * principal("principal_point_offset_x")? - offset[0]) as f32,
                cy: (height * principal("principal_point_offset_y")? - offset[1]) as f32,
                width: crop[0].unwrap_or(width) as u32,
                height: crop[1].unwrap_or(height) as u32,
            },
            origin: pose.affine().translation,
            right: -axis(0)?,
            down: -axis(1)?,
            forward: axis(2)?,
        })
    }

    /// Returns `focal_length`, a text such as `50mm`.
    fn focal_length_mm(&self, node: &Node) -> Result<Option<f64>, String> {
        let Some(text) = node.text("focal_length")? else {
            return Ok(None);
        };
        let number = text.trim().trim_end_matches("mm").trim().parse::<f64>();
        match number {
            Ok(mm) if mm > 0.0 && mm.is_finite() => Ok(Some(mm)),
            _ => Err(node.fail(format!(
                "focal_length: {}; expected millimetres such as 50mm",
                quoted(text)
            ))),
        }
    }

    /// Checks a film's properties. Adds a note for a gate, because gates belong to renders.
    fn film(&mut self, node: &Node) -> Result<(), String> {
        if node.kind == "specfilm" {
            self.note("film", "its bands are not used: renders state wavelengths");
        } else {
            self.only(node, &properties::FILM)?;
        }
        let Some((bins, width, start)) = gate(node)? else {
            return Ok(());
        };
        if !(1.0..=65536.0).contains(&bins) || bins.fract() != 0.0 {
            let what = format!("{bins} time bins; expected a whole number from 1 to 65536");
            return Err(node.fail(what));
        }
        if width.partial_cmp(&0.0) != Some(std::cmp::Ordering::Greater) {
            return Err(node.fail(format!("time bins of {width}; expected metres above 0")));
        }
        self.note(
            "gate",
            format!(
                "the film states {bins} bins of {width} m from {start} m, which are not used: render with --bins {bins} \
                 --bin-width-m {width} --gate-start-m {start} (bins, bin_width_m and gate_start_m in a job)"
            ),
        );
        Ok(())
    }

    /// Returns the laser from the emitters that are beams, or `None` without any.
    pub(super) fn laser(
        &mut self,
        emitters: &[std::rc::Rc<Node>],
    ) -> Result<Option<Laser>, String> {
        let mut beams: Vec<(Vec3, Vec3, &Node)> = Vec::new();
        for node in emitters {
            let angle = match node.kind.as_str() {
                "projector" => node.number("fov")?,
                "spot" => Some(2.0 * node.number("cutoff_angle")?.unwrap_or(20.0)),
                _ => None,
            };
            match angle {
                Some(angle) if angle <= BEAM_DEG => {
                    self.only(
                        node,
                        match node.kind.as_str() {
                            "spot" => &properties::SPOT,
                            _ => &properties::PROJECTOR,
                        },
                    )?;
                    let pose = self.placed(&node.transform("to_world")?);
                    let along = pose
                        .axis(2)
                        .ok_or_else(|| node.fail("to_world: has no inverse"))?;
                    beams.push((pose.affine().translation, along, node));
                }
                // Wider emitters are lamps.
                _ => self.note(
                    "emitters",
                    "other than beams are ignored; only the laser shines",
                ),
            }
        }
        if let Some(extras) = &self.extras {
            let ours = &extras.scene.laser;
            let same = ours.beams.len() == beams.len()
                && ours
                    .beams
                    .iter()
                    .zip(&beams)
                    .enumerate()
                    .all(|(k, (b, (_, _, node)))| beam_text(k, ours.origin, b) == node.text);
            if same {
                return Ok(Some(ours.clone()));
            }
            self.note(
                "laser",
                "edited since export; the emitters' parameters used",
            );
        }
        let Some(&(origin, _, _)) = beams.first() else {
            return Ok(None);
        };
        let powers = ["irradiance", "intensity", "scale"];
        let states_power = |n: &Node| powers.iter().any(|p| n.parameters.contains_key(*p));
        if beams.iter().any(|(_, _, node)| states_power(node)) {
            self.note(
                "beams",
                "of unit energy each, whatever power the file states",
            );
        }
        let reach = 1e-5 * (1.0 + origin.length());
        if let Some((other, _, node)) = beams
            .iter()
            .find(|(o, _, _)| (*o - origin).length() > reach)
        {
            return Err(node.fail(format!(
                "starts at {other:?}, the first beam at {origin:?}; a laser has one place"
            )));
        }
        let beams = beams.iter().map(|&(_, direction, _)| Beam {
            direction,
            spot: None,
        });
        Ok(Some(Laser {
            origin,
            beams: beams.collect(),
        }))
    }
}

/// Returns the time gate of a film: bins, metres of optical path of a bin, and of the start.
fn gate(node: &Node) -> Result<Option<(f64, f64, f64)>, String> {
    let states = |names: &[&str]| names.iter().any(|name| node.parameters.contains_key(*name));
    let transient = node.kind.starts_with("transient") || node.kind.starts_with("phasor");
    if transient || states(&["temporal_bins", "bin_width_opl", "start_opl"]) {
        // The default values are mitransient's.
        let bins = node.number("temporal_bins")?.unwrap_or(2048.0);
        let width = node.number("bin_width_opl")?.unwrap_or(0.003);
        return Ok(Some((
            bins,
            width,
            node.number("start_opl")?.unwrap_or(0.0),
        )));
    }
    if let (Some(first), Some(last), Some(width)) = (
        node.number("min_bound")?,
        node.number("max_bound")?,
        node.number("bin_width")?,
    ) {
        return Ok(Some((((last - first) / width).ceil(), width, first)));
    }
    if let (Some(bins), Some(width)) = (node.number("time")?, node.number("exposure_time")?) {
        return Ok(Some((
            bins,
            width,
            node.number("time_offset")?.unwrap_or(0.0),
        )));
    }
    Ok(None)
}
