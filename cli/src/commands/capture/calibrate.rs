//! `picofarm capture check` and `capture calibrate`: the faults of a capture, and the same capture
//! with a corrected calibration.

use std::path::Path;

use picofarm_calibrate::{
    Cause, Checked, Fault, Measurement, Report, VERSION, Verdict, check as judge,
    geometry as stated,
};
use picofarm_demultiplex as flash;
use picofarm_exchange::capture::{Beam, Capture};
use picofarm_scene::{Camera, Intrinsics, Vec3};
use serde_json::{Value, json};

use super::{calibration_picture, read, write};
use crate::{
    error::{CliError, Code, Result},
    output::{
        Output,
        files::{free_folder, save, write_atomically},
    },
};

/// Width of a pulse at half its height below which only that it is narrow is sure, bins.
const NARROW: f64 = 0.5;
/// What to check where no correction explains the times.
const BY_HAND: &str = "check by hand the camera (fov_deg in degrees, cx, cy), the order of rows and columns (axes), the unit and axes of spots_m and laser_m (metres; frame), and t0; then import the capture again";

/// What to do where the capture shows too little.
const MISSING: &str = "measure what is missing as said above, or use the capture as it is: `reconstruct` and `demultiplex` print whether their own results agree";
/// What to do where one file stands for two spots.
const AGAIN: &str = "correct what is named above, and import the capture again";

/// Returns what to do about a capture that nothing corrects.
fn why(report: &Report) -> &'static str {
    let has = |fault| report.causes.iter().any(|c| c.fault == fault);
    match () {
        () if has(Fault::EqualHistograms) => AGAIN,
        () if has(Fault::Evidence) => MISSING,
        () => BY_HAND,
    }
}

/// The report and its picture in a capture's folder: `dataset verify` expects them there.
const REPORT: &str = "render/calibration.json";
const PICTURE: &str = "render/calibration.png";

/// Checks a capture.
///
/// # Errors
/// A folder that is no capture, or damaged; a capture whose results would be wrong.
pub fn check(folder: &Path, output: Output) -> Result<()> {
    let capture = read(folder)?;
    let checked = checked(&capture, folder)?;
    let facts = facts(&checked.report);
    output.result(&facts, || {
        format!("{}: {}", folder.display(), describe(&checked.report))
    });
    match checked.report.verdict {
        Verdict::Good | Verdict::Usable => Ok(()),
        Verdict::CannotTell => {
            let what = format!(
                "{}: the capture does not show whether its calibration is right",
                folder.display()
            );
            Err(CliError::new(Code::Failed, what).hint(MISSING))
        }
        Verdict::Wrong => {
            let what = format!("{}: the capture would give wrong results", folder.display());
            let wrong = checked.report.causes.iter();
            let mut wrong = wrong.filter(|c| c.severity == Verdict::Wrong);
            let hint = match () {
                () if checked.report.unexplained() => why(&checked.report).into(),
                () if wrong.all(|c| c.corrected) => format!(
                    "picofarm capture calibrate {} --out DIR corrects it",
                    picofarm_proto::show::path(folder)
                ),
                () => AGAIN.into(),
            };
            Err(CliError::new(Code::Failed, what).hint(hint))
        }
    }
}

/// Corrects a capture.
///
/// # Errors
/// A folder that is no capture, or damaged; a folder that is taken; a capture whose times no
/// correction explains.
pub fn calibrate(folder: &Path, out: &Path, output: Output) -> Result<()> {
    free_folder(out)?;
    let mut capture = read(folder)?;
    let checked = checked(&capture, folder)?;
    if checked.report.unexplained() {
        output.result(&facts(&checked.report), || {
            format!("{}: {}", folder.display(), describe(&checked.report))
        });
        let what = format!(
            "{}: no correction can be trusted, so that nothing is written",
            folder.display()
        );
        return Err(CliError::new(Code::Failed, what).hint(why(&checked.report)));
    }
    let picture = calibration_picture::draw(&checked, &capture);
    correct(&mut capture, &checked);
    write(&capture, out)?;
    let mut facts = facts(&checked.report);
    let text = serde_json::to_vec_pretty(&facts).expect("a report is plain data");
    write_atomically(&out.join(REPORT), &text)?;
    save(&picture, &out.join(PICTURE))?;
    facts["out"] = json!(out);
    output.result(&facts, || {
        format!(
            "{}: {}  {}: {}\n  picture: {}\n",
            folder.display(),
            describe(&checked.report),
            match checked.report.causes.iter().any(|c| c.corrected) {
                true => "corrected",
                false => "nothing to correct, a copy with this report",
            },
            out.display(),
            out.join(PICTURE).display()
        )
    });
    Ok(())
}

/// The capture's camera: its axes are the capture's.
fn camera(capture: &Capture) -> Camera {
    let i = capture.intrinsics;
    Camera {
        intrinsics: Intrinsics {
            fx: i.fx,
            fy: i.fy,
            cx: i.cx,
            cy: i.cy,
            width: capture.width,
            height: capture.height,
        },
        origin: Vec3::ZERO,
        right: Vec3::new(1.0, 0.0, 0.0),
        down: Vec3::new(0.0, 1.0, 0.0),
        forward: Vec3::new(0.0, 0.0, 1.0),
    }
}

/// A beam as the methods take it; `None` if it meets nothing.
fn spot(beam: &Beam, laser: Vec3) -> Option<flash::Spot> {
    match beam {
        Beam::Spot { position, path_m } => {
            let point = Vec3::from(*position);
            Some(flash::Spot {
                direction: point - laser,
                place: Some(flash::Place {
                    point,
                    path_m: *path_m,
                }),
            })
        }
        Beam::Direction(way) => Some(flash::Spot {
            direction: Vec3::from(*way),
            place: None,
        }),
        Beam::Nothing => None,
    }
}

/// Returns what shows in a calibration without any light, one sentence each.
pub fn geometry(capture: &Capture) -> Vec<String> {
    let laser = Vec3::from(capture.laser);
    let beams = capture.beams.iter();
    let spots: Vec<flash::Spot> = beams.filter_map(|beam| spot(beam, laser)).collect();
    let camera = camera(capture);
    let causes = stated(&flash::Capture {
        histogram: &capture.sum,
        gate: capture.gate,
        camera: &camera,
        laser,
        spots: &spots,
    });
    let said = |c: Cause| format!("{}: {}", c.finding, c.advice);
    causes.into_iter().map(said).collect()
}

fn checked(capture: &Capture, folder: &Path) -> Result<Checked> {
    let laser = Vec3::from(capture.laser);
    let beams = capture.beams.iter().enumerate();
    let spots: Vec<flash::Spot> = beams
        .map(|(k, beam)| {
            spot(beam, laser).ok_or_else(|| {
                let what = format!(
                    "{}: spot {k} has neither a place nor a direction, so that its times cannot be judged",
                    folder.display()
                );
                CliError::input(what).hint("import the capture without its histogram")
            })
        })
        .collect::<Result<_>>()?;
    let camera = camera(capture);
    let measurement = Measurement {
        capture: flash::Capture {
            histogram: &capture.sum,
            gate: capture.gate,
            camera: &camera,
            laser,
            spots: &spots,
        },
        per_spot: capture.per_spot.as_deref(),
        masks: None,
        pulses: None,
    };
    judge(&measurement).map_err(|e| CliError::input(format!("{}: {e}", folder.display())))
}

/// Puts the corrected calibration and histograms into the capture.
fn correct(capture: &mut Capture, checked: &Checked) {
    let found = &checked.corrected;
    capture.gate = found.gate;
    let i = found.camera.intrinsics;
    capture.intrinsics.fx = i.fx;
    capture.intrinsics.fy = i.fy;
    capture.intrinsics.cx = i.cx;
    capture.intrinsics.cy = i.cy;
    let array = |v: Vec3| [v.x, v.y, v.z];
    capture.laser = array(found.laser);
    let beams = found.spots.iter().map(|spot| match spot.place {
        Some(place) => Beam::Spot {
            position: array(place.point),
            path_m: place.path_m,
        },
        None => Beam::Direction(array(spot.direction.normalized())),
    });
    capture.beams = beams.collect();
    match &mut capture.per_spot {
        Some(each) => {
            *each = found.histograms(each);
            let mut sum = vec![0.0f64; capture.sum.len()];
            for h in each.chunks(sum.len()) {
                sum.iter_mut().zip(h).for_each(|(s, x)| *s += f64::from(*x));
            }
            capture.sum = sum.into_iter().map(|s| s as f32).collect();
        }
        None => capture.sum = found.histograms(&capture.sum),
    }
    if let Some(depth) = &mut capture.depth {
        *depth = found.image(depth);
    }
    let causes = checked.report.causes.iter().filter(|c| c.corrected);
    let notes = causes.map(|c| format!("calibrated: {}", c.finding));
    capture.origin.conversions.extend(notes);
}

fn facts(report: &Report) -> Value {
    let mut facts = serde_json::to_value(report).expect("a report is plain data");
    facts["version"] = json!(VERSION);
    facts
}

/// Describes a report in a few lines.
fn describe(report: &Report) -> String {
    let mut text = format!("{}\n", report.verdict.name());
    for cause in &report.causes {
        text += &format!(
            "  {}: {}\n    {}{}\n",
            cause.severity.name(),
            cause.finding,
            cause.advice,
            if cause.corrected {
                ""
            } else {
                " (calibrate cannot correct it)"
            }
        );
    }
    if let (Some(stated), Some(corrected)) = (report.stated, report.corrected) {
        text += &format!(
            "  two-bounce times within a bin: {:.0} %, rms {:.1} mm as stated; {:.0} %, rms {:.1} mm corrected\n",
            100.0 * stated.share,
            1e3 * stated.rms_m,
            100.0 * corrected.share,
            1e3 * corrected.rms_m
        );
    }
    for guess in &report.guesses {
        text += &format!("  a guess that nothing confirms: {}\n", guess.finding);
    }
    text += &match report.pulse {
        Some(p) if p.shape.fwhm_bins() < NARROW => format!(
            "  pulse: narrower than a bin (about {:.0} ps at half its height)\n",
            p.fwhm_ps
        ),
        Some(p) => format!("  pulse: {:.0} ps wide at half its height\n", p.fwhm_ps),
        None => "  pulse: not measured\n".into(),
    };
    if let Some(background) = report.background {
        text += &format!("  background: {background:.3} a bin in the sum of all spots\n");
    }
    for note in &report.notes {
        text += &format!("  note: {note}\n");
    }
    text
}

#[cfg(test)]
mod tests {
    use picofarm_dataset::{Gate, Intrinsics};
    use picofarm_exchange::capture::Origin;
    use picofarm_scene::plato::{PlatoObject, PlatoSettings, generate};
    use picofarm_transient::{Budget, Progress, Settings, render};

    use super::*;

    struct Unstopped;

    impl Progress for Unstopped {
        fn at(&self, _: f32) -> bool {
            true
        }
    }

    /// A rendered capture whose laser is stated 10 cm to the right of its place.
    fn with_a_wrong_laser() -> Capture {
        let scene = generate(&PlatoSettings {
            object: PlatoObject::Armchair,
            spots: 16,
            resolution: 32,
        })
        .expect("a room");
        let gate = Gate {
            start_m: 1.0,
            bin_width_m: 0.0384,
            bins: 400,
        };
        let settings = Settings {
            one_bounce: true,
            groups: (0..16).map(|k| vec![k]).collect(),
            ..Settings::new(gate, Budget::Samples(8))
        };
        let made = render(&scene, &settings, &Unstopped).expect("a render");
        let camera = scene.camera;
        let local = |p: Vec3| {
            let q = camera.to_camera(p);
            [q.x, q.y, q.z]
        };
        let [x, y, z] = local(scene.laser.origin);
        let laser = [x + 0.1, y, z];
        let beams = made.spots.iter().map(|spot| {
            let position = local(spot.as_ref().expect("a wall").point);
            Beam::Spot {
                position,
                path_m: (Vec3::from(position) - Vec3::from(laser)).length(),
            }
        });
        let i = camera.intrinsics;
        Capture {
            name: "lab".into(),
            height: 32,
            width: 32,
            gate,
            sum: made.transient,
            per_spot: Some(made.groups.concat()),
            intrinsics: Intrinsics {
                fx: i.fx,
                fy: i.fy,
                cx: i.cx,
                cy: i.cy,
            },
            laser,
            beams: beams.collect(),
            depth: None,
            origin: Origin::default(),
        }
    }

    #[test]
    fn a_wrong_laser_fails_the_check_and_passes_it_after_the_calibration() {
        let folder = tempfile::tempdir().expect("a folder");
        let (lab, right) = (folder.path().join("lab"), folder.path().join("right"));
        write(&with_a_wrong_laser(), &lab).expect("a free folder");
        let output = Output { json: true };
        let refused = check(&lab, output).expect_err("a wrong laser");
        assert_eq!(refused.code, Code::Failed);
        assert!(
            refused
                .hint
                .expect("a way out")
                .contains("capture calibrate")
        );
        calibrate(&lab, &right, output).expect("a capture");
        check(&right, output).expect("a corrected capture");
        let found = read(&right).expect("a capture");
        assert!((found.laser[0]).abs() < 0.005, "{:?}", found.laser);
        let text = std::fs::read_to_string(right.join(REPORT)).expect("a report");
        let report: Value = serde_json::from_str(&text).expect("JSON");
        assert_eq!(report["verdict"], "wrong");
        assert_eq!(report["causes"][0]["fault"], "laser");
        assert!(right.join(PICTURE).exists());
        assert_eq!(
            calibrate(&lab, &right, output).expect_err("taken").code,
            Code::Input
        );
    }

    #[test]
    fn a_capture_that_no_correction_explains_is_not_written() {
        let folder = tempfile::tempdir().expect("a folder");
        let (lab, right) = (folder.path().join("lab"), folder.path().join("right"));
        let mut capture = with_a_wrong_laser();
        capture.intrinsics.fx *= 30.0;
        capture.intrinsics.fy *= 30.0;
        assert!(geometry(&capture)[0].contains("degrees wide"));
        write(&capture, &lab).expect("a free folder");
        let output = Output { json: true };
        for refused in [check(&lab, output), calibrate(&lab, &right, output)] {
            let refused = refused.expect_err("a view of three degrees");
            assert_eq!(refused.code, Code::Failed);
            assert!(refused.hint.expect("a way out").contains("by hand"));
        }
        assert!(!right.exists());
    }
}
