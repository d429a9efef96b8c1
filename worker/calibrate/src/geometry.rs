//! Faults of a stated calibration that show without any light: spots, camera and gate that do not
//! fit together.

use picofarm_demultiplex::Capture;

use crate::{
    causes::Found,
    model::Model,
    numeric::length,
    report::{Cause, Fault},
};

/// Narrowest and widest usual view, degrees.
const VIEW_DEG: [f64; 2] = [5.0, 175.0];
/// Share of the spots from which on a fault of spots is named.
const MOST: f64 = 0.5;

/// Returns the impossible and unusual parts of a stated calibration: spots behind the camera or
/// outside of the view, light of spots after the gate's end, a principal point outside of the
/// image, a very narrow or wide view. No histogram is read.
pub fn geometry(capture: &Capture) -> Vec<Cause> {
    let model = Model::new(capture);
    let i = &capture.camera.intrinsics;
    let (columns, rows) = (f64::from(i.width), f64::from(i.height));
    let mut causes = Vec::new();
    let mut add = |fault, wrong, value, unit: &str, finding, advice: &str| {
        let found = Found {
            fault,
            wrong,
            value,
            error: 0.0,
            unit,
            finding,
            advice,
            corrected: false,
        };
        causes.push(found.cause());
    };
    let [fx, fy, cx, cy] = model.lens;
    for (size, focal, what) in [(columns, fx, "wide"), (rows, fy, "high")] {
        let degrees = 2.0 * libm::atan2(0.5 * size, focal).to_degrees();
        if !(VIEW_DEG[0]..=VIEW_DEG[1]).contains(&degrees) {
            add(
                Fault::Camera,
                false,
                degrees,
                "degrees",
                format!(
                    "the view is {degrees:.2} degrees {what}, expected {} to {}",
                    VIEW_DEG[0], VIEW_DEG[1]
                ),
                "state fov_deg in degrees, not radians, and fx and fy in pixels",
            );
        }
    }
    if !(0.0..=columns).contains(&cx) || !(0.0..=rows).contains(&cy) {
        let away = |x: f64, size: f64| (-x).max(x - size).max(0.0);
        add(
            Fault::Camera,
            false,
            away(cx, columns).max(away(cy, rows)),
            "pixels",
            format!(
                "the principal point is column {cx:.1}, row {cy:.1}, outside of the image of {columns} columns and {rows} rows"
            ),
            "state cx (columns) and cy (rows) in pixels of this image, unless it is a part of a larger one",
        );
    }
    let placed: Vec<usize> = (0..model.beams.len())
        .filter(|k| model.beams[*k].point.is_some())
        .collect();
    let all = placed.len();
    let most = |n: usize| n > 0 && n as f64 > MOST * all as f64;
    let film = |k: &usize| model.film(model.spot(*k).0);
    let behind = placed.iter().filter(|k| film(k).is_none()).count();
    if most(behind) {
        add(
            Fault::Spots,
            true,
            behind as f64,
            "spots",
            format!("{behind} of {all} spots are behind the camera"),
            "state spots in the axes right, down, forward, or name the axes of spots in frame",
        );
    }
    let within = |[x, y]: [f64; 2]| (0.0..=columns).contains(&x) && (0.0..=rows).contains(&y);
    let outside = placed.iter().filter_map(film).filter(|p| !within(*p));
    let outside = outside.count();
    if most(outside) {
        add(
            Fault::Spots,
            false,
            outside as f64,
            "spots",
            format!("{outside} of {all} spots are in front of the camera, but outside of its view"),
            "check the field of view, the principal point, and the unit (metres) and axes of spots",
        );
    }
    causes.extend(late(capture));
    causes
}

/// Names spots whose light comes after the gate's end.
pub(crate) fn late(capture: &Capture) -> Option<Cause> {
    let model = Model::new(capture);
    // No light of a spot comes before the straight way from the laser to the spot and the camera.
    let end = capture.gate.end_m();
    let placed = (0..model.beams.len()).filter(|k| model.beams[*k].point.is_some());
    let first: Vec<f64> = placed
        .map(|k| {
            let (point, path) = model.spot(k);
            path + length(point)
        })
        .collect();
    let (late, all) = (first.iter().filter(|x| **x > end).count(), first.len());
    let nearest = first.iter().copied().fold(f64::INFINITY, f64::min);
    let cause = || Found {
        fault: Fault::Spots,
        wrong: true,
        value: late as f64,
        error: 0.0,
        unit: "spots",
        finding: format!(
            "the light of {late} of {all} spots comes after the gate's end: the earliest path of a spot is {nearest:.3} m, and the gate ends at {end:.3} m"
        ),
        advice: "state spots and laser in metres, and check the bin width and t0",
        corrected: false,
    };
    (late > 0 && late as f64 > MOST * all as f64).then(|| cause().cause())
}

/// The earliest light of any spot, metres of path; `None` unless all spots have places.
pub(crate) fn earliest(model: &Model) -> Option<f64> {
    let mut all = Vec::new();
    for (k, beam) in model.beams.iter().enumerate() {
        beam.point?;
        let (point, path) = model.spot(k);
        all.push(path + length(point));
    }
    all.into_iter().reduce(f64::min)
}
