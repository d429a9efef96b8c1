//! Chooses a camera for a scene that has none: inside a room, or in front of an object.

use std::fmt;

use crate::{Camera, Intrinsics, Material, Object, Vec3, tree::Tree};

/// The number of directions in which a point's surroundings are probed.
const PROBES: u32 = 96;
/// A point is indoors if at least this share of the probes hit something,
const ENCLOSED: f32 = 0.95;
/// and at least this share of those meet a front side. Points inside a solid object meet backs.
const FRONTS: f32 = 0.7;
/// The least diagonal of a scene with an indoors, metres. Smaller hollow things, such as a helmet,
/// are seen from outside.
const LEAST_ROOM_M: f32 = 1.5;
/// The nearest surface to a camera indoors, as a share of the scene's diagonal.
const CLEARANCE: f32 = 0.02;
/// Candidate positions of a camera indoors, as shares of the scene's extents.
const ALONG: [f32; 7] = [0.08, 0.2, 0.35, 0.5, 0.65, 0.8, 0.92];
const HEIGHTS: [f32; 3] = [0.35, 0.5, 0.65];
/// The number of candidates whose views are compared, and of the directions of each.
const COMPARED: usize = 12;
const YAWS: u32 = 16;
/// The downward slope of a view indoors.
const SLOPE: f32 = 0.15;
/// A scene that is this many times larger than 99 % of its surface contains stray triangles.
const STRAY: f32 = 10.0;
/// The margin around an object in front of the camera.
const MARGIN: f32 = 1.05;

/// Facts of a viewpoint.
pub(crate) struct Viewpoint {
    /// The camera's position.
    pub(crate) from: Option<Vec3>,
    /// A point in the middle of the image.
    pub(crate) at: Option<Vec3>,
    /// The direction that is upwards in the image.
    pub(crate) up: Vec3,
}

/// How a viewpoint was chosen.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Kind {
    Stated,
    Indoors,
    InFront,
}

impl fmt::Display for Kind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Stated => "stated",
            Self::Indoors => "indoors",
            Self::InFront => "in front of the objects",
        })
    }
}

impl Viewpoint {
    /// Returns a camera for these objects. The error is a fault of the objects or the options.
    pub(crate) fn camera(
        &self,
        objects: &[Object],
        intrinsics: Intrinsics,
    ) -> Result<(Camera, Kind), String> {
        let up = self.up.normalized();
        if !up.is_finite() {
            return Err("up: expected a direction, such as 0,1,0".into());
        }
        if let (Some(from), Some(at)) = (self.from, self.at) {
            return Ok((look(from, at, up, intrinsics)?, Kind::Stated));
        }
        let surroundings = Surroundings::new(objects)
            .ok_or("has no triangles with finite corners; export a mesh with faces")?;
        let (lo, hi) = surroundings.bounds;
        if let Some(from) = self.from {
            return Ok((look(from, (lo + hi) * 0.5, up, intrinsics)?, Kind::Stated));
        }
        if let Some(at) = self.at {
            let from = in_front((lo, hi), at, up, intrinsics)?;
            return Ok((look(from, at, up, intrinsics)?, Kind::InFront));
        }
        if (hi - lo).length() >= LEAST_ROOM_M
            && let Some((from, at)) = surroundings.indoors(up)
        {
            return Ok((look(from, at, up, intrinsics)?, Kind::Indoors));
        }
        let at = (lo + hi) * 0.5;
        let from = in_front((lo, hi), at, up, intrinsics)?;
        Ok((look(from, at, up, intrinsics)?, Kind::InFront))
    }
}

/// Returns a camera at a point that looks at another.
fn look(from: Vec3, at: Vec3, up: Vec3, intrinsics: Intrinsics) -> Result<Camera, String> {
    let forward = (at - from).normalized();
    if !forward.is_finite() {
        return Err("look-from and look-at: are the same point; expected two points".into());
    }
    let mut right = forward.cross(up);
    if right.length() < 1e-4 {
        // Straight up or down: any horizontal direction will do.
        let other = match up.x.abs() < 0.9 {
            true => Vec3::new(1.0, 0.0, 0.0),
            false => Vec3::new(0.0, 0.0, 1.0),
        };
        right = forward.cross(other);
    }
    let right = right.normalized();
    Ok(Camera {
        intrinsics,
        origin: from,
        right,
        down: forward.cross(right),
        forward,
    })
}

/// Returns two horizontal unit directions: to the right of the scene's front, and its front (+z if
/// +y is upwards, as in glTF; −y if +z is).
fn horizontal(up: Vec3) -> [Vec3; 2] {
    let front = match up.z.abs() > 0.9 {
        true => Vec3::new(0.0, -1.0, 0.0),
        false => Vec3::new(0.0, 0.0, 1.0),
    };
    let right = up.cross(front).normalized();
    [right, right.cross(up).normalized()]
}

/// Returns the position from which a camera that looks at `at` sees all of a box, from the front,
/// right and above.
fn in_front(
    (lo, hi): (Vec3, Vec3),
    at: Vec3,
    up: Vec3,
    intrinsics: Intrinsics,
) -> Result<Vec3, String> {
    let [right, front] = horizontal(up);
    let away = (front + right * 0.5 + up * 0.4).normalized();
    let camera = look(at + away, at, up, intrinsics)?;
    let slopes = [
        intrinsics.width as f32 * 0.5 / intrinsics.fx,
        intrinsics.height as f32 * 0.5 / intrinsics.fy,
    ];
    let mut distance = 0.0f32;
    for k in 0..8u32 {
        let side = |axis: usize| {
            if k >> axis & 1 == 1 {
                hi[axis]
            } else {
                lo[axis]
            }
        };
        let corner = Vec3::new(side(0), side(1), side(2)) - at;
        let c = camera.direction_to_camera(corner);
        let needed = (c.x.abs() / slopes[0]).max(c.y.abs() / slopes[1]) - c.z;
        distance = distance.max(needed);
    }
    Ok(at + away * (distance * MARGIN).max(1e-3))
}

/// A scene's geometry in world space, ready for rays.
pub(crate) struct Surroundings {
    tree: Tree,
    /// The smallest and largest coordinates, without stray triangles.
    bounds: (Vec3, Vec3),
}

/// The intersection of a ray with a scene.
pub(crate) struct Met {
    /// The ray parameter in units of the direction's length.
    pub(crate) t: f32,
    /// The normal of the facet by the order of its corners, not normalised.
    normal: Vec3,
}

impl Surroundings {
    /// Builds the tree. Returns `None` without triangles with finite corners.
    pub(crate) fn new(objects: &[Object]) -> Option<Self> {
        Self::of(objects, |_| true)
    }

    /// Builds the tree of the surfaces that laser spots appear on: all but glass, or all if there
    /// is only glass.
    pub(crate) fn opaque(objects: &[Object]) -> Option<Self> {
        Self::of(objects, |material| !material.transmits()).or_else(|| Self::new(objects))
    }

    fn of(objects: &[Object], is_wanted: impl Fn(&Material) -> bool) -> Option<Self> {
        let mut triangles = Vec::new();
        for object in objects {
            let mesh = &object.mesh;
            let wanted: Vec<bool> = mesh.materials.iter().map(&is_wanted).collect();
            for (k, t) in mesh.triangles.iter().enumerate() {
                let material = mesh.triangle_material.get(k);
                if material.is_some_and(|&m| wanted.get(m as usize) == Some(&false)) {
                    continue;
                }
                let corners = t.map(|v| object.to_world.point(mesh.positions[v as usize]));
                if corners.iter().all(|p| p.is_finite()) {
                    triangles.push(corners);
                }
            }
        }
        let bounds = main_part(&triangles)?;
        Some(Self {
            tree: Tree::new(triangles),
            bounds,
        })
    }

    /// Returns the closest intersection with t > 0.
    pub(crate) fn closest(&self, from: Vec3, direction: Vec3) -> Option<Met> {
        let (t, [a, b, c]) = self.tree.closest(from, direction)?;
        Some(Met {
            t,
            normal: (b - a).cross(c - a),
        })
    }

    /// Returns position and target of a camera indoors, or `None` outdoors and in front of lone
    /// objects.
    fn indoors(&self, up: Vec3) -> Option<(Vec3, Vec3)> {
        let (lo, hi) = self.bounds;
        let size = hi - lo;
        let diagonal = size.length();
        let axis = |k: usize| up[k].abs() > 0.9;
        let (vertical, [a, b]) = match (axis(0), axis(1)) {
            (true, _) => (0, [1, 2]),
            (_, true) => (1, [0, 2]),
            _ => (2, [0, 1]),
        };
        let mut candidates: Vec<(f32, Vec3)> = Vec::new();
        for height in HEIGHTS {
            // Measured from the floor, also if upwards is a negative axis.
            let height = if up[vertical] < 0.0 {
                1.0 - height
            } else {
                height
            };
            for u in ALONG {
                for v in ALONG {
                    let mut share = [0.0; 3];
                    (share[vertical], share[a], share[b]) = (height, u, v);
                    let point =
                        lo + Vec3::new(size.x * share[0], size.y * share[1], size.z * share[2]);
                    if let Some(open) = self.openness(point, CLEARANCE * diagonal) {
                        candidates.push((open, point));
                    }
                }
            }
        }
        candidates.sort_by(|p, q| q.0.total_cmp(&p.0));
        candidates.truncate(COMPARED);
        let [right, front] = horizontal(up);
        let mut best: Option<(f32, Vec3, Vec3)> = None;
        for (_, from) in candidates {
            for yaw in 0..YAWS {
                let angle = std::f64::consts::TAU * f64::from(yaw) / f64::from(YAWS);
                let (s, c) = (libm::sin(angle) as f32, libm::cos(angle) as f32);
                let ahead = front * c + right * s - up * SLOPE;
                let view = self.depth_of_view(from, ahead.normalized(), up);
                if best.is_none_or(|(known, ..)| view > known) {
                    best = Some((view, from, from + ahead));
                }
            }
        }
        best.map(|(_, from, at)| (from, at))
    }

    /// Returns the mean distance to what surrounds a point (the harmonic mean, which counts near
    /// surfaces), or `None` if the point is not indoors.
    fn openness(&self, point: Vec3, clearance: f32) -> Option<f32> {
        let (mut hits, mut fronts, mut inverse) = (0u32, 0u32, 0.0f32);
        for k in 0..PROBES {
            // A spiral of nearly equal areas (Vogel 1979).
            let z = 1.0 - (2.0 * k as f32 + 1.0) / PROBES as f32;
            let angle = f64::from(k) * 2.399_963_229_728_653;
            let r = (1.0 - z * z).sqrt();
            let direction = Vec3::new(r * libm::cos(angle) as f32, r * libm::sin(angle) as f32, z);
            let Some(hit) = self.closest(point, direction) else {
                continue;
            };
            if hit.t < clearance {
                return None;
            }
            hits += 1;
            fronts += u32::from(hit.normal.dot(direction) < 0.0);
            inverse += 1.0 / hit.t;
        }
        let enclosed = hits as f32 >= ENCLOSED * PROBES as f32;
        let outside = fronts as f32 >= FRONTS * hits as f32;
        (enclosed && outside).then(|| hits as f32 / inverse)
    }

    /// Returns the mean distance over a coarse view of 60°, harmonic as [`Self::openness`]; 0 if a
    /// ray leaves the scene.
    fn depth_of_view(&self, from: Vec3, forward: Vec3, up: Vec3) -> f32 {
        let right = forward.cross(up).normalized();
        let down = forward.cross(right);
        let (mut count, mut inverse) = (0u32, 0.0f32);
        for row in -3i8..=3 {
            for column in -3i8..=3 {
                let step = 0.577 / 3.0;
                let ray =
                    forward + right * (f32::from(column) * step) + down * (f32::from(row) * step);
                match self.closest(from, ray) {
                    Some(hit) => inverse += 1.0 / hit.t,
                    None => return 0.0,
                }
                count += 1;
            }
        }
        count as f32 / inverse
    }
}

/// Returns the bounding box of triangles. A box that is mostly empty because few small triangles
/// are far away is replaced by that of the rest.
fn main_part(all: &[[Vec3; 3]]) -> Option<(Vec3, Vec3)> {
    let first = all.first()?[0];
    let (lo, hi) = all
        .iter()
        .flatten()
        .fold((first, first), |(lo, hi), p| (lo.min(*p), hi.max(*p)));
    let triangles: Vec<(Vec3, f64)> = all
        .iter()
        .map(|[a, b, c]| {
            let area = f64::from((*b - *a).cross(*c - *a).length());
            ((*a + *b + *c) * (1.0 / 3.0), area)
        })
        .collect();
    let total: f64 = triangles.iter().map(|(_, a)| a).sum();
    // The range that holds all but a hundredth of the area, along each axis.
    let ranges = [0, 1, 2].map(|axis: usize| {
        let mut order: Vec<(f32, f64)> = triangles.iter().map(|(c, a)| (c[axis], *a)).collect();
        order.sort_by(|p, q| p.0.total_cmp(&q.0));
        let quantile = |share: f64| {
            let mut sum = 0.0;
            let found = order.iter().find(|(_, a)| {
                sum += a;
                sum >= share * total
            });
            found.or(order.last()).map_or(lo[axis], |(x, _)| *x)
        };
        [quantile(0.005), quantile(0.995)]
    });
    let span = ranges.iter().fold(0.0f32, |m, [from, to]| m.max(to - from));
    let (mut low, mut high) = (<[f32; 3]>::from(lo), <[f32; 3]>::from(hi));
    for (axis, [from, to]) in ranges.into_iter().enumerate() {
        // Triangles extend beyond their centres, so only gross differences count.
        if span > 0.0 && hi[axis] - lo[axis] > STRAY * span {
            low[axis] = (from - 0.2 * span).max(low[axis]);
            high[axis] = (to + 0.2 * span).min(high[axis]);
        }
    }
    Some((low.into(), high.into()))
}
