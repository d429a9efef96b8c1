//! Walls: planes of the room with their openings. A room need not be convex: a corridor, a door or
//! the other arm of an L-shaped room is behind the plane of a wall. So each plane is divided into
//! cells, and the pixels vote: a cell is closed where they see the plane, and open where they see
//! through it. Cells without votes are as the nearest cell with votes. A few wrong depths behind a
//! wall are outvoted, and do not remove it.

use picofarm_scene::Vec3;

use crate::{Depth, Measured, Plane, planes::Candidate};

/// The side of a cell, metres.
const CELL_M: f32 = 0.12;
/// The least share of the area with votes that must be closed. Less is the front or top of
/// furniture.
const LEAST_CLOSED: f32 = 0.5;
/// The least area that must be closed, m².
const LEAST_M2: f32 = 0.3;
/// The greatest number of cells along a side.
const MOST_CELLS: usize = 256;
/// The distance from which points are behind a plane, as a multiple of the tolerance.
const BEHIND: f32 = 3.0;
/// The open area from which an opening is noted, m².
const NOTED_M2: f32 = 0.5;

/// A plane of the room, and where it is closed.
#[derive(Debug, Clone)]
pub(crate) struct Wall {
    pub plane: Plane,
    /// The middle of cell 0, and the directions of rows and columns.
    frame: [Vec3; 3],
    size: [usize; 2],
    closed: Vec<bool>,
    /// The areas that pixels see closed and open, m².
    pub seen_m2: [f32; 2],
}

impl Wall {
    /// Returns whether the wall is closed at the foot of a position, or around the foot.
    pub fn is_closed(&self, x: Vec3) -> bool {
        let [i, j] = cell(&self.frame, x).map(|c| c.round());
        let [i, j] =
            [(i, self.size[0]), (j, self.size[1])].map(|(c, n)| (c.max(0.0) as usize).min(n - 1));
        self.closed[i * self.size[1] + j]
    }

    /// Returns the distance into the room, metres; negative behind the wall, and infinite at its
    /// openings.
    pub fn inside(&self, x: Vec3) -> f32 {
        match self.is_closed(x) {
            true => self.plane.inside(x),
            false => f32::INFINITY,
        }
    }

    /// Returns the distance from `origin` along `ray` to the wall, or `None` if the ray misses it
    /// or passes an opening.
    pub fn hit(&self, origin: Vec3, ray: Vec3) -> Option<f32> {
        let slope = self.plane.normal.dot(ray);
        let range = self.plane.inside(origin) / slope;
        (slope > 0.05 && range > 0.0 && self.is_closed(origin + ray * range)).then_some(range)
    }
}

/// Returns the position in a plane's cells.
fn cell(frame: &[Vec3; 3], x: Vec3) -> [f32; 2] {
    let way = x - frame[0];
    [way.dot(frame[1]) / CELL_M, way.dot(frame[2]) / CELL_M]
}

/// Returns the walls among planes, and notes on the planes that are none and on openings. The
/// lengths are those of the scene times `factor`.
pub(crate) fn walls(
    measured: &Measured,
    depth: &Depth,
    (planes, close): (&[Candidate], f32),
    factor: f32,
) -> (Vec<Wall>, Vec<String>) {
    let points: Vec<(usize, Vec3)> = (0..depth.range.len())
        .filter(|&p| depth.range[p].is_finite() && !measured.is_doubtful(p))
        .map(|p| (p, measured.camera.origin + measured.ray(p) * depth.range[p]))
        .collect();
    let (mut found, mut notes) = (Vec::new(), Vec::new());
    for candidate in planes {
        let Some(wall) = divided(measured, depth, (&candidate.plane, close), &points) else {
            continue;
        };
        let [closed, open] = wall.seen_m2;
        let [shut, through] = wall.seen_m2.map(|m2| area(m2 / (factor * factor)));
        if closed < LEAST_M2 || closed < LEAST_CLOSED * (closed + open) {
            if closed >= LEAST_M2 {
                notes.push(format!(
                    "a plane that {:.1} % of the pixels see is no wall: {shut} of it are closed, and {through} are open",
                    100.0 * candidate.share
                ));
            }
            continue;
        }
        if open >= NOTED_M2 {
            notes.push(format!(
                "a wall is open: {shut} of its plane are closed, and {through} are open"
            ));
        }
        found.push(wall);
    }
    (found, notes)
}

/// Formats an area.
fn area(m2: f32) -> String {
    match m2 < 0.1 {
        true => format!("{:.0} cm²", 1e4 * m2),
        false => format!("{m2:.1} m²"),
    }
}

/// Divides a plane into cells by the votes of pixels. Returns `None` if the camera is behind it.
fn divided(
    measured: &Measured,
    depth: &Depth,
    (plane, close): (&Plane, f32),
    points: &[(usize, Vec3)],
) -> Option<Wall> {
    let eye = measured.camera.origin;
    if plane.inside(eye) <= 0.0 {
        return None;
    }
    // Where each vote is, and whether it is for closed.
    let vote = |&(p, x): &(usize, Vec3)| -> Option<(Vec3, bool)> {
        let far = plane.inside(x);
        let normal = depth.normal[p];
        if far.abs() < 2.0 * close && normal.dot(plane.normal) < -0.8 {
            return Some((x, true));
        }
        let passed = plane.inside(eye) / (plane.inside(eye) - far);
        // A wrong time has no surface around it.
        let seen = far < -BEHIND * close && normal != Vec3::ZERO;
        seen.then(|| (eye + (x - eye) * passed, false))
    };
    let votes: Vec<(Vec3, bool)> = points.iter().filter_map(vote).collect();
    let across = match plane.normal.x.abs() < 0.7 {
        true => Vec3::new(1.0, 0.0, 0.0),
        false => Vec3::new(0.0, 1.0, 0.0),
    };
    let a = plane.normal.cross(across).normalized();
    let b = plane.normal.cross(a);
    let foot = eye + plane.normal * plane.inside(eye);
    let mut frame = [foot, a, b];
    let at = |x: Vec3| cell(&[foot, a, b], x);
    let (mut lo, mut hi) = ([f32::INFINITY; 2], [f32::NEG_INFINITY; 2]);
    for (x, _) in &votes {
        for (k, c) in at(*x).into_iter().enumerate() {
            (lo[k], hi[k]) = (lo[k].min(c.round()), hi[k].max(c.round()));
        }
    }
    if votes.is_empty() {
        return None;
    }
    let size = [0, 1].map(|k| ((hi[k] - lo[k]) as usize + 1).min(MOST_CELLS));
    frame[0] = foot + a * (lo[0] * CELL_M) + b * (lo[1] * CELL_M);
    let mut counts = vec![[0u32; 2]; size[0] * size[1]];
    for (x, closed) in &votes {
        let [i, j] = cell(&frame, *x).map(|c| c.round().max(0.0) as usize);
        let at = i.min(size[0] - 1) * size[1] + j.min(size[1] - 1);
        counts[at][usize::from(!closed)] += 1;
    }
    let around = |i: usize, j: usize| -> [u32; 2] {
        let mut sum = [0; 2];
        for i in i.saturating_sub(1)..(i + 2).min(size[0]) {
            for j in j.saturating_sub(1)..(j + 2).min(size[1]) {
                let [c, o] = counts[i * size[1] + j];
                sum = [sum[0] + c, sum[1] + o];
            }
        }
        sum
    };
    let mut labels: Vec<Option<bool>> = Vec::with_capacity(counts.len());
    let mut seen = [0.0f32; 2];
    for i in 0..size[0] {
        for j in 0..size[1] {
            let own = counts[i * size[1] + j];
            let label = (own != [0, 0]).then(|| {
                let [closed, open] = around(i, j);
                closed >= open
            });
            if let Some(closed) = label {
                seen[usize::from(!closed)] += CELL_M * CELL_M;
            }
            labels.push(label);
        }
    }
    Some(Wall {
        plane: *plane,
        frame,
        size,
        closed: spread(labels, size),
        seen_m2: seen,
    })
}

/// Gives cells without a label that of the nearest one, by steps along rows and columns. Closed
/// cells spread first.
fn spread(mut labels: Vec<Option<bool>>, [rows, columns]: [usize; 2]) -> Vec<bool> {
    let mut edge: Vec<usize> = (0..labels.len()).filter(|i| labels[*i].is_some()).collect();
    edge.sort_by_key(|i| labels[*i] != Some(true));
    while !edge.is_empty() {
        let mut next = Vec::new();
        for at in edge {
            let (i, j) = (at / columns, at % columns);
            let beside = [
                (i > 0).then(|| at - columns),
                (i + 1 < rows).then(|| at + columns),
                (j > 0).then(|| at - 1),
                (j + 1 < columns).then(|| at + 1),
            ];
            for n in beside.into_iter().flatten() {
                if labels[n].is_none() {
                    labels[n] = labels[at];
                    next.push(n);
                }
            }
        }
        edge = next;
    }
    labels.into_iter().map(|l| l.unwrap_or(true)).collect()
}
