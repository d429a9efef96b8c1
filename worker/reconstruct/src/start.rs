//! The start of the optimisation: the grid's box, and for every node a signed distance to the
//! visible surfaces and to the room's planes.

use picofarm_scene::Vec3;
use rayon::prelude::*;

use crate::{
    Depth, Measured,
    field::{EMPTY, Field, GAIN, SOLID, surface_logit},
    walls::Wall,
};

/// The state of a node before light paths are evaluated.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum State {
    /// Outside the camera's view.
    Outside,
    /// The camera looks through it.
    Free,
    /// Within 1.5 voxels of a surface that the camera sees.
    Band,
    /// Behind a visible surface, or without known depth.
    Unseen,
    /// Within 1.5 voxels of a plane of the room, or behind it.
    Wall,
}

/// The half width of the band around a visible surface, voxels.
const BAND: f32 = 1.5;
/// The share of the points excluded at each end of an axis when computing the box.
const OUTLIERS: f32 = 5e-3;
/// The margin of the box on each side, voxels.
const MARGIN: f32 = 4.0;
/// The number of supersampling positions along a side of a voxel where states change.
const PLACES: i32 = 3;
/// The number of positions of a voxel that must be in the band before unseen space counts as a
/// surface.
const LEAST_IN_BAND: u32 = 9;

/// Returns the bounding box of the visible points and of the camera itself, without outliers, with
/// a margin of four voxels.
pub fn bounds(measured: &Measured, depth: &Depth, nodes: usize) -> (Vec3, Vec3) {
    let mut axes: [Vec<f32>; 3] = Default::default();
    let known = |p: &usize| depth.range[*p].is_finite();
    let smooth = |p: &usize| depth.normal[*p] != Vec3::ZERO;
    let all = (0..depth.range.len()).filter(known).count();
    let few = 2 * (0..depth.range.len()).filter(known).filter(smooth).count() < all;
    for (p, &range) in depth.range.iter().enumerate() {
        // A surface has neighbours; a wrong time has none.
        if range.is_finite() && (few || depth.normal[p] != Vec3::ZERO) {
            let x = measured.camera.origin + measured.ray(p) * range;
            for (k, axis) in axes.iter_mut().enumerate() {
                axis.push(x[k]);
            }
        }
    }
    let (mut lo, mut hi) = (measured.camera.origin, measured.camera.origin);
    let quantile =
        |sorted: &[f32], share: f32| sorted[((sorted.len() - 1) as f32 * share) as usize];
    let mut ends = [[0.0f32; 2]; 3];
    for (k, axis) in axes.iter_mut().enumerate() {
        axis.sort_by(f32::total_cmp);
        let eye = measured.camera.origin[k];
        ends[k] = match axis.is_empty() {
            true => [eye - 0.5, eye + 0.5],
            false => [
                quantile(axis, OUTLIERS).min(eye),
                quantile(axis, 1.0 - OUTLIERS).max(eye),
            ],
        };
    }
    lo = lo.min(Vec3::new(ends[0][0], ends[1][0], ends[2][0]));
    hi = hi.max(Vec3::new(ends[0][1], ends[1][1], ends[2][1]));
    let size = hi - lo;
    let inner = (nodes.max(16) as f32 - 1.0 - 2.0 * MARGIN).max(1.0);
    let margin = Vec3::splat(MARGIN * size.x.max(size.y).max(size.z) / inner);
    (lo - margin, hi + margin)
}

/// The surfaces visible from one position.
struct Seen<'a> {
    measured: &'a Measured,
    depth: &'a Depth,
    walls: &'a [Wall],
    spacing: f32,
    surface: f32,
}

impl Seen<'_> {
    fn logit(&self, inside_solid: f32) -> f32 {
        (GAIN * inside_solid / self.spacing + self.surface).clamp(EMPTY, SOLID)
    }

    fn at(&self, x: Vec3) -> (State, f32) {
        let h = self.spacing;
        let wall = self
            .walls
            .iter()
            .map(|p| p.inside(x))
            .fold(f32::INFINITY, f32::min);
        let of_wall = self.logit(-wall);
        let camera = &self.measured.camera;
        let i = &camera.intrinsics;
        let q = camera.to_camera(x);
        let (u, v) = (i.fx * q.x / q.z + i.cx, i.fy * q.y / q.z + i.cy);
        let in_view =
            q.z > 0.02 && u >= 0.0 && v >= 0.0 && u < i.width as f32 && v < i.height as f32;
        if !in_view {
            return (State::Outside, of_wall);
        }
        let p = v as usize * i.width as usize + u as usize;
        let range = self.depth.range[p];
        if !range.is_finite() {
            return match wall < BAND * h {
                true => (State::Wall, of_wall),
                false => (State::Unseen, SOLID),
            };
        }
        let ray = self.measured.ray(p);
        let far = (x - camera.origin).length();
        let normal = self.depth.normal[p];
        let known = normal != Vec3::ZERO;
        let slope = if known { -normal.dot(ray) } else { 0.7 };
        // The distance to the surface on the camera's side, metres: to its tangent plane nearby,
        // and along the ray further away.
        let front = if known && (range - far).abs() < 4.0 * h {
            normal.dot(x - (camera.origin + ray * range))
        } else {
            (range - far) * slope.max(0.3)
        };
        match () {
            () if front > BAND * h => (State::Free, EMPTY),
            () if front > -BAND * h => (State::Band, self.logit(-front)),
            () if wall < BAND * h => (State::Wall, of_wall),
            () => (State::Unseen, SOLID),
        }
    }

    /// Returns the mean over positions in the voxel of a node if its state differs from those of
    /// its neighbours. This places an edge between nodes to a fraction of a voxel. `None` = leave
    /// the node unchanged.
    fn averaged(&self, x: Vec3, own: State) -> Option<(State, f32)> {
        let (mut sum, mut count, mut free, mut band) = (0.0f32, 0u32, 0u32, 0u32);
        let limit = GAIN * 0.77;
        for k in 0..PLACES.pow(3) {
            let place = [k % PLACES, k / PLACES % PLACES, k / (PLACES * PLACES)];
            let [a, b, c] = place.map(|i| (i - PLACES / 2) as f32 / PLACES as f32 * self.spacing);
            let (state, u) = self.at(x + Vec3::new(a, b, c));
            sum += match state {
                State::Outside | State::Wall => continue,
                State::Unseen => limit,
                _ => u.clamp(-limit, limit),
            };
            count += 1;
            free += u32::from(state == State::Free);
            band += u32::from(state == State::Band);
        }
        match count {
            0 => None,
            _ if free == count => Some((State::Free, EMPTY)),
            _ if band < LEAST_IN_BAND && own != State::Band => None,
            _ => Some((State::Band, sum / count as f32)),
        }
    }
}

/// Sets the logits of every node, and returns the nodes' states.
pub fn start(field: &mut Field, measured: &Measured, depth: &Depth, walls: &[Wall]) -> Vec<State> {
    let seen = Seen {
        measured,
        depth,
        walls,
        spacing: field.spacing,
        surface: surface_logit(),
    };
    let all = 0..field.logit.len();
    let first: Vec<(State, f32)> = all.into_par_iter().map(|i| seen.at(field.at(i))).collect();
    let strides = field.strides();
    let finer = |i: usize| -> (State, f32) {
        let own = first[i];
        let edge = strides[2]..first.len() - strides[2];
        if matches!(own.0, State::Outside | State::Wall) || !edge.contains(&i) {
            return own;
        }
        let alike = |s: &usize| first[i - s].0 == own.0 && first[i + s].0 == own.0;
        match strides.iter().all(alike) {
            true => own,
            false => seen.averaged(field.at(i), own.0).unwrap_or(own),
        }
    };
    let all: Vec<(State, f32)> = (0..first.len()).into_par_iter().map(finer).collect();
    for (u, found) in field.logit.iter_mut().zip(&all) {
        *u = found.1;
    }
    all.into_iter().map(|found| found.0).collect()
}
