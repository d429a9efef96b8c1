//! The room itself: walls, floor and ceiling of a box, or of an L-shaped room whose walls have an
//! open door to a second room and a glazed window.

use crate::{
    Material, Mesh, Vec3,
    layout::{Footprint, Room},
    rng::Rng,
    shape::Shape,
};

use super::{plan::Plan, surface};

/// The thickness of walls with openings, metres.
const WALL: f32 = 0.12;
/// The free floor in front of a door, metres.
const CLEARANCE: f32 = 0.55;
/// The shares of rooms that are L-shaped, have an open door, and have a glazed window.
const L_SHAPED: f32 = 0.5;
const OPEN_DOOR: f32 = 0.6;
const GLAZED: f32 = 0.6;

/// The corner that an L-shaped room lacks.
#[derive(Debug, Clone, Copy)]
struct Notch {
    /// The signs of x and z at the corner.
    corner: [f32; 2],
    /// Its extents along x and z, metres.
    size: [f32; 2],
}

/// A rectangular hole in a wall, and the space behind it.
#[derive(Debug, Clone, Copy)]
struct Opening {
    /// The wall: −z, +z, −x, +x.
    wall: usize,
    /// The first and last position along the wall's axis, metres.
    along: [f32; 2],
    /// The lowest and highest point, metres.
    heights: [f32; 2],
    /// The depth of the space behind it, metres.
    beyond: f32,
    /// How far that space reaches to both sides of the opening, metres.
    sides: [f32; 2],
    glazed: bool,
}

/// Builds the room of a varied floor plan into `plan`. Returns whether it has a door, and whether
/// it has a window.
pub(super) fn varied(
    rng: &mut Rng,
    plan: &mut Plan<'_>,
    [floor, ceiling, wall]: [Material; 3],
) -> [bool; 2] {
    let room = plan.room;
    let notch = rng.chance(L_SHAPED).then(|| Notch {
        corner: [sign(rng), sign(rng)],
        size: [
            room.width * rng.range(0.28, 0.45),
            room.depth * rng.range(0.28, 0.45),
        ],
    });
    plan.solid = notch.map(|n| n.footprint(&room));
    let door = rng.chance(OPEN_DOOR).then(|| {
        let size = [
            rng.range(0.8, 0.95),
            rng.range(1.98, 2.1).min(room.height - 0.1),
        ];
        (
            size,
            0.0,
            [
                rng.range(0.9, 2.4),
                rng.range(0.1, 1.2),
                rng.range(0.1, 1.2),
            ],
        )
    });
    let window = rng.chance(GLAZED).then(|| {
        let size = [rng.range(0.7, 1.3), rng.range(0.8, 1.2)];
        let sill = rng.range(0.85, 1.05).min(room.height - size[1] - 0.1);
        (
            size,
            sill,
            [
                rng.range(0.5, 2.0),
                rng.range(0.3, 1.5),
                rng.range(0.3, 1.5),
            ],
        )
    });
    let mut openings = Vec::new();
    for (wanted, glazed) in [(door, false), (window, true)] {
        let Some((size, sill, [beyond, left, right])) = wanted else {
            continue;
        };
        let found = (0..20).find_map(|_| {
            let (k, slide) = (rng.below(4), rng.range(-1.0, 1.0));
            let taken = openings.iter().any(|o: &Opening| o.wall == k);
            (!taken).then(|| place(plan, (k, slide), size, sill))?
        });
        let Some((wall, along)) = found else { continue };
        openings.push(Opening {
            wall,
            along,
            heights: [sill, sill + size[1]],
            beyond,
            sides: [left, right],
            glazed,
        });
    }
    for (label, mesh) in faces(&room, notch, &openings, [&floor, &ceiling, &wall]) {
        plan.fix(mesh, label);
    }
    for opening in &openings {
        let paint = [
            surface(rng, "floor", 0.3, 0.75),
            surface(rng, "wall", 0.45, 0.9),
        ];
        for (label, mesh) in opening.behind(&room, &wall, paint) {
            plan.fix(mesh, label);
        }
    }
    let has = |glazed: bool| openings.iter().any(|o| o.glazed == glazed);
    [has(false), has(true)]
}

fn sign(rng: &mut Rng) -> f32 {
    if rng.chance(0.5) { 1.0 } else { -1.0 }
}

/// Returns the wall and the interval of an opening, if no other opening and no missing corner is
/// there, and reserves the free floor in front of it.
fn place(
    plan: &mut Plan<'_>,
    (k, slide): (usize, f32),
    [width, height]: [f32; 2],
    sill: f32,
) -> Option<(usize, [f32; 2])> {
    let half = [width * 0.5 + 0.05, CLEARANCE * 0.5];
    let (at, yaw) = plan.room.against_wall(k, slide, half, 1e-3);
    let front = Footprint::new([at[0], sill, at[1]], yaw, half, height);
    plan.is_free(&front, None).then(|| {
        plan.reserved.push(front);
        let middle = if k < 2 { at[0] } else { at[1] };
        (k, [middle - width * 0.5, middle + width * 0.5])
    })
}

impl Notch {
    fn footprint(&self, room: &Room) -> Footprint {
        let [x, z] = self.inner(room);
        let centre = [
            (x + self.corner[0] * room.width * 0.5) * 0.5,
            (z + self.corner[1] * room.depth * 0.5) * 0.5,
        ];
        let half = self.size.map(|s| s * 0.5);
        Footprint::new([centre[0], 0.0, centre[1]], 0.0, half, room.height)
    }

    /// Returns the corner of the notch inside the room.
    fn inner(&self, room: &Room) -> [f32; 2] {
        [
            self.corner[0] * (room.width * 0.5 - self.size[0]),
            self.corner[1] * (room.depth * 0.5 - self.size[1]),
        ]
    }
}

/// A point of a wall: its position along the wall, its height, and its distance behind the wall.
fn on_wall(room: &Room, wall: usize, [along, y, out]: [f32; 3]) -> Vec3 {
    let (x, z) = (room.width * 0.5 + out, room.depth * 0.5 + out);
    match wall {
        0 => Vec3::new(along, y, -z),
        1 => Vec3::new(along, y, z),
        2 => Vec3::new(-x, y, along),
        _ => Vec3::new(x, y, along),
    }
}

/// A mesh of one material whose quadrilaterals face a given point.
struct Facing {
    shape: Shape,
    material: u32,
}

impl Facing {
    fn new(label: &str, material: &Material) -> Self {
        let mut shape = Shape::new(label);
        let material = shape.material(material.clone());
        Self { shape, material }
    }

    fn quad(&mut self, mut corners: [Vec3; 4], seen_from: Vec3) {
        let [a, b, c, _] = corners;
        if (b - a).cross(c - a).dot(seen_from - a) < 0.0 {
            corners.reverse();
        }
        self.shape.quad(corners, self.material);
    }

    fn finish(self, label: &'static str) -> (&'static str, Mesh) {
        (label, self.shape.finish())
    }
}

/// Returns the room's own faces, with holes where the openings are.
fn faces(
    room: &Room,
    notch: Option<Notch>,
    openings: &[Opening],
    [floor, ceiling, wall]: [&Material; 3],
) -> Vec<(&'static str, Mesh)> {
    let (x, z, h) = (room.width * 0.5, room.depth * 0.5, room.height);
    let mut all = Vec::new();
    // The plan as rectangles [x0, x1, z0, z1].
    let parts = match notch {
        None => vec![[-x, x, -z, z]],
        Some(n) => {
            let [nx, nz] = n.inner(room);
            let long = if n.corner[1] > 0.0 { [-z, nz] } else { [nz, z] };
            let strip = if n.corner[1] > 0.0 { [nz, z] } else { [-z, nz] };
            let short = if n.corner[0] > 0.0 { [-x, nx] } else { [nx, x] };
            vec![
                [-x, x, long[0], long[1]],
                [short[0], short[1], strip[0], strip[1]],
            ]
        }
    };
    for (label, material, y) in [("floor", floor, 0.0), ("ceiling", ceiling, h)] {
        let mut face = Facing::new(label, material);
        for [x0, x1, z0, z1] in &parts {
            let corner = |x: f32, z: f32| Vec3::new(x, y, z);
            let corners = [
                corner(*x0, *z0),
                corner(*x1, *z0),
                corner(*x1, *z1),
                corner(*x0, *z1),
            ];
            face.quad(corners, Vec3::new(0.0, h * 0.5, 0.0));
        }
        all.push(face.finish(label));
    }
    for k in 0..4 {
        let extent = if k < 2 { x } else { z };
        let mut span = [-extent, extent];
        if let Some(n) = notch {
            let [across, along] = if k < 2 { [1, 0] } else { [0, 1] };
            let side = if k % 2 == 0 { -1.0 } else { 1.0 };
            if n.corner[across] == side {
                let end = usize::from(n.corner[along] > 0.0);
                span[end] = n.inner(room)[along];
            }
        }
        let mut face = Facing::new("wall", wall);
        let inside = Vec3::new(0.0, h * 0.5, 0.0);
        let mut patch = |[a, b]: [f32; 2], [lo, hi]: [f32; 2]| {
            if b - a > 1e-4 && hi - lo > 1e-4 {
                let at = |s: f32, y: f32| on_wall(room, k, [s, y, 0.0]);
                face.quad([at(a, lo), at(b, lo), at(b, hi), at(a, hi)], inside);
            }
        };
        let mut from = span[0];
        // A wall has one opening at most.
        for hole in openings.iter().filter(|o| o.wall == k) {
            patch([from, hole.along[0]], [0.0, h]);
            patch(hole.along, [0.0, hole.heights[0]]);
            patch(hole.along, [hole.heights[1], h]);
            from = hole.along[1];
        }
        patch([from, span[1]], [0.0, h]);
        all.push(face.finish("wall"));
    }
    if let Some(n) = notch {
        let [nx, nz] = n.inner(room);
        let [ex, ez] = [n.corner[0] * x, n.corner[1] * z];
        let mut face = Facing::new("wall", wall);
        let at = |x: f32, z: f32, y: f32| Vec3::new(x, y, z);
        let from = Vec3::new(nx - n.corner[0], h * 0.5, nz - n.corner[1]);
        for [[x0, z0], [x1, z1]] in [[[nx, nz], [nx, ez]], [[nx, nz], [ex, nz]]] {
            face.quad(
                [
                    at(x0, z0, 0.0),
                    at(x1, z1, 0.0),
                    at(x1, z1, h),
                    at(x0, z0, h),
                ],
                from,
            );
        }
        all.push(face.finish("wall"));
    }
    all
}

impl Opening {
    /// Returns the reveal of the opening, its pane if it is glazed, and the space behind it.
    fn behind(
        &self,
        room: &Room,
        wall: &Material,
        [floor, paint]: [Material; 2],
    ) -> Vec<(&'static str, Mesh)> {
        let ([a, b], [lo, hi]) = (self.along, self.heights);
        let at = |s: f32, y: f32, out: f32| on_wall(room, self.wall, [s, y, out]);
        let mut all = Vec::new();
        let mut reveal = Facing::new("wall", wall);
        let middle = at((a + b) * 0.5, (lo + hi) * 0.5, WALL * 0.5);
        for [[s0, y0], [s1, y1]] in [
            [[a, lo], [a, hi]],
            [[b, lo], [b, hi]],
            [[a, lo], [b, lo]],
            [[a, hi], [b, hi]],
        ] {
            let corners = [
                at(s0, y0, 0.0),
                at(s1, y1, 0.0),
                at(s1, y1, WALL),
                at(s0, y0, WALL),
            ];
            reveal.quad(corners, middle);
        }
        all.push(reveal.finish(if self.glazed { "window" } else { "door" }));
        if self.glazed {
            let mut pane = Facing::new("window", &Material::glass("pane"));
            let out = WALL * 0.5;
            pane.quad(
                [
                    at(a, lo, out),
                    at(b, lo, out),
                    at(b, hi, out),
                    at(a, hi, out),
                ],
                at(a, lo, 0.0),
            );
            all.push(pane.finish("window"));
        }
        // The space behind: a box of its own, open where the hole is.
        // It stays within the ends of the wall, so that it meets no space behind another wall.
        let end = if self.wall < 2 {
            room.width
        } else {
            room.depth
        } * 0.5;
        let s0 = (a - self.sides[0]).max(-end);
        let s1 = (b + self.sides[1]).min(end);
        let h = room.height;
        let (near, far) = (WALL, WALL + self.beyond);
        let centre = at((s0 + s1) * 0.5, h * 0.5, (near + far) * 0.5);
        let mut ground = Facing::new("floor", &floor);
        ground.quad(
            [
                at(s0, 0.0, near),
                at(s1, 0.0, near),
                at(s1, 0.0, far),
                at(s0, 0.0, far),
            ],
            centre,
        );
        all.push(ground.finish("floor"));
        let mut top = Facing::new("ceiling", &paint);
        top.quad(
            [
                at(s0, h, near),
                at(s1, h, near),
                at(s1, h, far),
                at(s0, h, far),
            ],
            centre,
        );
        all.push(top.finish("ceiling"));
        let mut walls = Facing::new("wall", &paint);
        walls.quad(
            [
                at(s0, 0.0, far),
                at(s1, 0.0, far),
                at(s1, h, far),
                at(s0, h, far),
            ],
            centre,
        );
        for s in [s0, s1] {
            walls.quad(
                [
                    at(s, 0.0, near),
                    at(s, h, near),
                    at(s, h, far),
                    at(s, 0.0, far),
                ],
                centre,
            );
        }
        for ([u0, u1], [v0, v1]) in [
            ([s0, a], [0.0, h]),
            ([b, s1], [0.0, h]),
            ([a, b], [0.0, lo]),
            ([a, b], [hi, h]),
        ] {
            if v1 - v0 > 1e-4 {
                let corners = [
                    at(u0, v0, near),
                    at(u1, v0, near),
                    at(u1, v1, near),
                    at(u0, v1, near),
                ];
                walls.quad(corners, centre);
            }
        }
        all.push(walls.finish("wall"));
        all
    }
}
