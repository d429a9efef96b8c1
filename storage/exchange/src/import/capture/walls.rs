//! Scans of a relay wall: y-tal's and Zaragoza-NLOS's files.
//!
//! A regular grid of points on a plane is the image of a pinhole camera whose view is at a right
//! angle to the plane, wherever it stands: the camera is placed at the sensor, pixels are the
//! grid's points, and the principal point is the foot of the camera on the wall. Points that are
//! no regular grid have no such camera, and neither has a confocal scan, in which each pixel is
//! lit by a spot of its own.

use picofarm_dataset::{Gate, Intrinsics};
use picofarm_sensor::Resampler;

use super::super::ImportError;
use super::super::vector::{distance, dot, norm};
use super::arrays::{Part, Stated, Strided};
use super::describe::placed;
use super::h5::H5;

/// Largest distance of a point from the regular grid, in steps of the grid.
const STRAY_STEPS: f64 = 0.02;

type Point = [f64; 3];

/// A scan of a wall as a file has it.
struct Wall {
    sensor: Point,
    laser: Point,
    /// Points of the sensor, `[x][y]`, and their numbers.
    grid: Vec<Point>,
    sides: [usize; 2],
    spots: Vec<Point>,
    /// `[spot][x][y][bin]`.
    h: Strided,
    start_m: f64,
    width_m: f64,
    /// Whether times include the ways from the laser to the wall and from the wall to the sensor.
    whole_paths: bool,
    notes: Vec<String>,
}

fn sub(a: Point, b: Point) -> Point {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

fn cross(a: Point, b: Point) -> Point {
    [
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    ]
}

fn unit(a: Point) -> Point {
    let length = norm(a);
    a.map(|x| x / length)
}

/// Reads y-tal's layout (`tal.io`, `NLOSCaptureData`). Lengths of paths are in metres.
pub(super) fn tal(h5: &H5<'_>) -> Result<Part, ImportError> {
    let (shape, values) = h5.array("H")?;
    let (grid, sides) = grid(h5, "sensor_grid_xyz", false)?;
    let (spots, _) = grid_of_any(h5, "laser_grid_xyz")?;
    let count = spots.len();
    let [x, y] = sides;
    let values: Vec<f32> = values.into_iter().map(|v| v as f32).collect();
    let bins = shape.first().copied().unwrap_or(0);
    match &shape[..] {
        // T, Sx, Sy with one laser point.
        &[_, a, b] if [a, b] == sides && count == 1 => {}
        &[_, a, b] if [a, b] == sides => return Err(confocal(h5, count)),
        // T, Lx, Ly, Sx, Sy.
        &[_, lx, ly, a, b] if [a, b] == sides && lx * ly == count => {}
        other => {
            let expected = format!(
                "[bins, {x}, {y}], or [bins, laser x, laser y, {x}, {y}] with {count} laser points"
            );
            return Err(h5.refused("H", expected, format!("{other:?}")));
        }
    }
    let pixels = x * y;
    let h = Strided {
        shape: vec![count, x, y, bins],
        strides: vec![pixels, y, 1, count * pixels],
        values,
    };
    let whole = h5.number("t_accounts_first_and_last_bounces")? != 0.0;
    place(
        h5,
        "y-tal",
        Wall {
            sensor: h5.point("sensor_xyz")?,
            laser: h5.point("laser_xyz")?,
            grid,
            sides,
            spots,
            h,
            start_m: h5.number("t_start")?,
            width_m: h5.number("delta_t")?,
            whole_paths: whole,
            notes: Vec::new(),
        },
    )
}

/// Reads Zaragoza-NLOS's layout (Galindo et al. 2019). Colours and bounces are summed.
pub(super) fn zaragoza(h5: &H5<'_>) -> Result<Part, ImportError> {
    let (shape, values) = h5.array("data")?;
    let (grid, sides) = grid(h5, "cameraGridPositions", true)?;
    let (spots, _) = grid_of_any(h5, "laserGridPositions")?;
    let [x, y] = sides;
    if shape.len() == 5 {
        return Err(confocal(h5, spots.len()));
    }
    let row_major = Strided::rows(shape.clone(), Vec::new()).strides;
    // Either colours, bins, bounces, sensor x and y, laser x and y, or the reverse, as MATLAB and
    // C order write it.
    let order: Option<[usize; 7]> = match shape[..] {
        [_, _, _, a, b, lx, ly] if [a, b] == sides && lx * ly == spots.len() => {
            Some([0, 1, 2, 3, 4, 5, 6])
        }
        [ly, lx, b, a, _, _, _] if [a, b] == sides && lx * ly == spots.len() => {
            Some([6, 5, 4, 3, 2, 1, 0])
        }
        _ => None,
    };
    let Some([colour, bin, bounce, sx, sy, lx, ly]) = order else {
        let expected = format!(
            "[colours, bins, bounces, {x}, {y}, laser x, laser y] with {} laser points, or the reverse",
            spots.len()
        );
        return Err(h5.refused("data", expected, format!("{shape:?}")));
    };
    let [bins, columns] = [shape[bin], shape[ly]];
    let mut summed = vec![0.0f32; spots.len() * x * y * bins];
    for (at, out) in summed.iter_mut().enumerate() {
        let (spot, a, b, t) = (
            at / (x * y * bins),
            at / (y * bins) % x,
            at / bins % y,
            at % bins,
        );
        let base = spot / columns * row_major[lx]
            + spot % columns * row_major[ly]
            + a * row_major[sx]
            + b * row_major[sy]
            + t * row_major[bin];
        let mut sum = 0.0;
        for c in 0..shape[colour] {
            for n in 0..shape[bounce] {
                sum += values[base + c * row_major[colour] + n * row_major[bounce]];
            }
        }
        *out = sum as f32;
    }
    let notes = vec![format!(
        "{} colours and {} classes of bounces summed",
        shape[colour], shape[bounce]
    )];
    place(
        h5,
        "zaragoza-nlos",
        Wall {
            sensor: h5.point("cameraPosition")?,
            laser: h5.point("laserPosition")?,
            h: Strided::rows(vec![spots.len(), x, y, bins], summed),
            grid,
            sides,
            spots,
            start_m: h5.number("t0")?,
            width_m: h5.number("deltaT")?,
            whole_paths: true,
            notes,
        },
    )
}

/// Points of a grid `[x, y, 3]` or, `transposed`, also `[3, y, x]`.
fn grid(
    h5: &H5<'_>,
    name: &str,
    transposed: bool,
) -> Result<(Vec<Point>, [usize; 2]), ImportError> {
    let (shape, v) = h5.array(name)?;
    match &shape[..] {
        &[x, y, 3] => {
            let points = v.chunks_exact(3).map(|p| [p[0], p[1], p[2]]).collect();
            Ok((points, [x, y]))
        }
        &[3, y, x] if transposed => {
            let n = x * y;
            let point = |at: usize| {
                let from = at % y * x + at / y;
                [v[from], v[n + from], v[2 * n + from]]
            };
            Ok(((0..n).map(point).collect(), [x, y]))
        }
        other => {
            let expected = "a grid [x, y, 3]; a list of points has no rows and columns";
            Err(h5.refused(name, expected, format!("{other:?}")))
        }
    }
}

/// Points of a grid, a list, or a single point.
fn grid_of_any(h5: &H5<'_>, name: &str) -> Result<(Vec<Point>, usize), ImportError> {
    let (shape, v) = h5.array(name)?;
    let points: Vec<Point> = match shape.last() {
        Some(3) => v.chunks_exact(3).map(|p| [p[0], p[1], p[2]]).collect(),
        _ => return grid(h5, name, true).map(|(points, [x, y])| (points, x * y)),
    };
    let count = points.len();
    Ok((points, count))
}

fn confocal(h5: &H5<'_>, spots: usize) -> ImportError {
    let what = format!(
        "is a confocal scan: each pixel is lit by a laser point of its own ({spots} points). A capture of picofarm has spots that light all pixels, and shadows compare pixels of one spot, so this scan has neither"
    );
    let hint = "record with a fixed laser point, or a few, and the sensor's whole grid for each; for confocal scans use a solver for hidden scenes, such as y-tal";
    ImportError::unreadable(h5.file, what, hint)
}

/// Places the camera and turns the scan into a capture.
fn place(h5: &H5<'_>, format: &str, wall: Wall) -> Result<Part, ImportError> {
    let [nx, ny] = wall.sides;
    let irregular = |found: String| {
        let expected = "points of a regular grid with square corners on a plane, of at least 2x2: only these are the image of a pinhole camera";
        h5.refused("the sensor's grid", expected, found)
    };
    if nx < 2 || ny < 2 {
        return Err(irregular(format!("{nx}x{ny} points")));
    }
    let point = |i: usize, j: usize| wall.grid[i * ny + j];
    let origin = point(0, 0);
    let step = |to: Point, n: usize| sub(to, origin).map(|x| x / (n - 1) as f64);
    let (u, v) = (step(point(nx - 1, 0), nx), step(point(0, ny - 1), ny));
    let (du, dv) = (norm(u), norm(v));
    let small = du.min(dv);
    if !(small > 0.0 && small.is_finite()) {
        return Err(irregular("points on top of each other".into()));
    }
    if dot(u, v).abs() > STRAY_STEPS * du * dv {
        return Err(irregular("rows and columns at an oblique angle".into()));
    }
    for i in 0..nx {
        for j in 0..ny {
            let expected: Point =
                std::array::from_fn(|k| origin[k] + i as f64 * u[k] + j as f64 * v[k]);
            let off = distance(expected, point(i, j));
            if off > STRAY_STEPS * small {
                return Err(irregular(format!(
                    "point ({i}, {j}) is {off:.4} m off the grid"
                )));
            }
        }
    }
    // Columns follow x; rows follow y in the direction that keeps the axes right-handed.
    let right = unit(u);
    let away = dot(sub(origin, wall.sensor), cross(right, unit(v)));
    let turned = away < 0.0;
    let down = unit(v).map(|x| if turned { -x } else { x });
    let forward = cross(right, down);
    let depth = away.abs();
    if depth < small {
        let found = format!("a sensor {depth:.4} m from the wall's plane");
        let expected = "a sensor in front of the wall";
        return Err(h5.refused("the sensor's position", expected, found));
    }
    let first = sub(point(0, if turned { ny - 1 } else { 0 }), wall.sensor);
    let focal = [depth / du, depth / dv];
    let intrinsics = Intrinsics {
        fx: focal[0] as f32,
        fy: focal[1] as f32,
        cx: (0.5 - focal[0] * dot(first, right) / depth) as f32,
        cy: (0.5 - focal[1] * dot(first, down) / depth) as f32,
    };
    let seen = |p: Point| {
        let way = sub(p, wall.sensor);
        [dot(way, right), dot(way, down), dot(way, forward)]
    };
    let laser = seen(wall.laser);
    let beams = wall.spots.iter().map(|s| placed(seen(*s), laser)).collect();
    let mut notes = wall.notes.clone();
    notes.push(format!(
        "camera placed at the sensor, at a right angle to the wall {depth:.3} m away; pixels are the {nx}x{ny} points of the grid"
    ));
    notes.push("the first surface of every pixel is the relay wall: depth shows the wall, not what it hides".into());
    let (dims, values, gate, outside) = arranged(h5, &wall, turned, &mut notes)?;
    Ok(Part {
        file: h5.file.to_owned(),
        format: format.into(),
        dims,
        apart: true,
        values,
        stated: Stated {
            gate: Some([gate.start_m, gate.bin_width_m]),
            intrinsics: Some(intrinsics),
            laser: Some(laser),
            beams: Some(beams),
            depth: None,
        },
        notes,
        outside,
        binned: false,
    })
}

/// Histograms `[spot][row][column][bin]` over whole paths.
fn arranged(
    h5: &H5<'_>,
    wall: &Wall,
    turned: bool,
    notes: &mut Vec<String>,
) -> Result<([usize; 4], Vec<f32>, Gate, f64), ImportError> {
    let [nx, ny] = wall.sides;
    let (spots, bins) = (wall.spots.len(), wall.h.shape[3]);
    let from = Gate {
        start_m: wall.start_m,
        bin_width_m: wall.width_m,
        bins: bins as u32,
    };
    if !(from.start_m.is_finite() && from.bin_width_m > 0.0 && bins > 0) {
        return Err(h5.refused(
            "the time axis",
            "bins of a positive width",
            format!("{from:?}"),
        ));
    }
    let delay = |spot: usize, i: usize, j: usize| match wall.whole_paths {
        true => 0.0,
        false => {
            distance(wall.laser, wall.spots[spot]) + distance(wall.grid[i * ny + j], wall.sensor)
        }
    };
    let places =
        || (0..spots).flat_map(|s| (0..nx).flat_map(move |i| (0..ny).map(move |j| (s, i, j))));
    let delays = || places().map(|(s, i, j)| delay(s, i, j));
    let (least, most) = (
        delays().fold(f64::INFINITY, f64::min),
        delays().fold(f64::NEG_INFINITY, f64::max),
    );
    let more = libm::ceil((most - least) / from.bin_width_m - 1e-6).max(0.0) as u32;
    let to = Gate {
        start_m: from.start_m + least,
        bins: from.bins + more,
        ..from
    };
    if most > 0.0 {
        notes.push(format!(
            "ways between laser, wall and sensor added to the times: {least:.3} to {most:.3} m of path"
        ));
    }
    let new = to.bins as usize;
    let mut values = vec![0.0f32; spots * nx * ny * new];
    let (mut pixel, mut sums, mut outside) = (vec![0.0f32; bins], vec![0.0f64; new], 0.0);
    let s = &wall.h.strides;
    for (spot, i, j) in places() {
        let base = spot * s[0] + i * s[1] + j * s[2];
        for (bin, x) in pixel.iter_mut().enumerate() {
            *x = wall.h.values[base + bin * s[3]];
        }
        let row = if turned { ny - 1 - j } else { j };
        let out = &mut values[((spot * ny + row) * nx + i) * new..][..new];
        if most == 0.0 {
            out.copy_from_slice(&pixel);
            continue;
        }
        let shift = Resampler::new(&from, &to, 1.0, delay(spot, i, j));
        let shift = shift.map_err(|e| h5.refused("the time axis", "bins", e.to_string()))?;
        sums.fill(0.0);
        outside += shift.add(&pixel, &mut sums);
        for (out, sum) in out.iter_mut().zip(&sums) {
            *out = *sum as f32;
        }
    }
    Ok(([spots, ny, nx, new], values, to, outside))
}
