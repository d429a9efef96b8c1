//! The paper's primitive rooms: a cube, a cylinder and a mirror in a bare room of varying scale,
//! seen by a camera with random position and field of view. The rooms have the size of living
//! rooms, or of a box on a desk.

use std::{collections::BTreeMap, f32::consts::TAU, sync::Arc};

use picofarm_settings::{MirrorWall, PrimitiveRooms, Sizes, Spots};
use serde::{Deserialize, Serialize};

use crate::{
    Affine, Aim, Camera, Intrinsics, Material, Mesh, Object, Provenance, Scene, SceneError, Vec3,
    box_view::depths_in_box,
    label::{label_id, vocabulary},
    layout::{Footprint, Room},
    rng::Rng,
    shape::Shape,
    trace::{Model, World},
    view::{acceptance, beams_land, coarse_view},
};

/// Changes whenever the same seed would give another scene.
pub const GENERATOR_VERSION: &str = "primitive-2";

/// The number of rooms to try for one seed.
const ATTEMPTS: u32 = 64;
/// The number of cameras to try for one room.
const CAMERAS: u32 = 24;
/// The number of meshes of a room's shell.
const WALLS: usize = 6;
/// The wall in view of the cameras ([`Room::against_wall`]).
const BACK: usize = 0;

/// The settings of a primitive room.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PrimitiveSettings {
    /// The laser spots.
    pub spots: Spots,
    /// The laser's position in the camera's frame (x right, y down, z forward), metres.
    pub laser_m: [f32; 3],
    /// The image width in pixels.
    pub width: u32,
    /// The image height in pixels.
    pub height: u32,
    /// The middle of the range of the horizontal field of view, degrees.
    pub fov_deg: f32,
    /// The sizes of rooms and objects, bounds of depth, the mirror's wall, and the variation of the
    /// field of view.
    pub rooms: PrimitiveRooms,
}

impl Default for PrimitiveSettings {
    fn default() -> Self {
        Self {
            spots: Spots::Grid(25),
            laser_m: [0.0; 3],
            width: 256,
            height: 256,
            fov_deg: 90.0,
            rooms: PrimitiveRooms::LIVING,
        }
    }
}

impl PrimitiveSettings {
    /// Returns settings for a box on a desk, as in the laboratory of appendix F.1: 46° wide, 16
    /// spots.
    pub fn desktop() -> Self {
        Self {
            spots: Spots::Grid(16),
            fov_deg: 46.0,
            rooms: PrimitiveRooms::DESKTOP,
            ..Self::default()
        }
    }
}

/// Generates the primitive room of `seed`: the same scene, bit for bit, on every machine.
///
/// # Errors
/// [`SceneError::Invalid`] for settings out of range, [`SceneError::Exhausted`] if no camera of any
/// sub-seed has its depth within the bounds of [`PrimitiveRooms::depth_m`].
///
/// # Examples
/// ```
/// use picofarm_scene::primitive::{PrimitiveSettings, generate};
///
/// let room = PrimitiveSettings { width: 8, height: 8, ..PrimitiveSettings::default() };
/// let scene = generate(3, &room)?;
/// assert_eq!(scene.laser.beams.len(), 25);
/// assert!(scene.validate().is_ok());
/// # Ok::<(), picofarm_scene::SceneError>(())
/// ```
pub fn generate(seed: u64, settings: &PrimitiveSettings) -> Result<Scene, SceneError> {
    let aim = settings.check(seed)?;
    for attempt in 0..ATTEMPTS {
        let mut rng = Rng::new(seed, u64::from(attempt));
        if let Some(scene) = attempt_room(seed, attempt, settings, &aim, &mut rng) {
            return Ok(scene);
        }
    }
    Err(SceneError::Exhausted {
        generator: GENERATOR_VERSION.into(),
        seed,
        attempts: ATTEMPTS,
    })
}

impl PrimitiveSettings {
    fn check(&self, seed: u64) -> Result<Aim, SceneError> {
        let invalid = |field: &str, what: String| SceneError::Invalid {
            scene: GENERATOR_VERSION.into(),
            field: field.into(),
            what,
        };
        let jitter = self.rooms.fov_jitter_deg as f32;
        self.rooms
            .check()
            .map_err(|(field, what)| invalid(&format!("rooms.{field}"), what))?;
        crate::camera::check_view(self.width, self.height, self.fov_deg)
            .and_then(|()| {
                crate::camera::check_view(self.width, self.height, self.fov_deg + jitter)
            })
            .and_then(|()| {
                crate::camera::check_view(self.width, self.height, self.fov_deg - jitter)
            })
            .and_then(|()| Aim::of(&self.spots, seed).map_err(|what| ("spots", what)))
            .map_err(|(field, what)| invalid(field, what))
    }
}

fn drawn(rng: &mut Rng, [lo, hi]: [f64; 2]) -> f32 {
    rng.range(lo as f32, hi as f32)
}

/// Returns half a width, and a height.
fn size(rng: &mut Rng, sizes: &Sizes) -> (f32, f32) {
    (drawn(rng, sizes.width_m) * 0.5, drawn(rng, sizes.height_m))
}

fn grey(rng: &mut Rng, name: &str) -> Material {
    let level = rng.range(0.3, 0.85);
    let tint = |rng: &mut Rng| level * rng.range(0.85, 1.0);
    let rgb = [tint(rng), tint(rng), tint(rng)];
    Material::diffuse(name, rgb)
}

fn cube(rng: &mut Rng, sizes: &Sizes) -> Mesh {
    let (half, height) = size(rng, sizes);
    let mut shape = Shape::new("cube");
    let m = shape.material(grey(rng, "cube"));
    shape.cuboid([-half, 0.0, -half], [half, height, half], m);
    shape.finish()
}

fn cylinder(rng: &mut Rng, sizes: &Sizes) -> Mesh {
    let (radius, height) = size(rng, sizes);
    let mut shape = Shape::new("cylinder");
    let m = shape.material(grey(rng, "cylinder"));
    shape.cylinder([0.0; 2], [0.0, height], [radius, radius], 48, m);
    shape.finish()
}

/// Builds a thin planar near-mirror (α = 0.01) with its back at z = 0 and its front towards +z.
fn mirror(rng: &mut Rng, sizes: &Sizes) -> Mesh {
    let (half, height) = size(rng, sizes);
    let mut shape = Shape::new("mirror");
    let m = shape.material(Material::mirror("mirror", 0.01));
    shape.cuboid([-half, 0.0, -0.01], [half, height, 0.01], m);
    shape.finish()
}

fn attempt_room(
    seed: u64,
    attempt: u32,
    settings: &PrimitiveSettings,
    aim: &Aim,
    rng: &mut Rng,
) -> Option<Scene> {
    let rooms = &settings.rooms;
    let scale = drawn(rng, rooms.scale);
    let room = Room {
        width: 3.6 * scale * rng.range(0.9, 1.1),
        depth: 3.6 * scale * rng.range(0.9, 1.1),
        height: 2.6 * scale,
    };
    let mut objects: Vec<Object> = Vec::new();
    let mut world = World::default();
    let mut put = |mesh: Mesh, label: &str, to_world: Affine| {
        let model = Arc::new(Model::new(mesh).expect("primitives have triangles"));
        objects.push(Object {
            mesh: model.mesh.clone(),
            to_world,
            label: label_id(label),
            name: format!("{label}-{}", objects.len()),
        });
        world.add(model, to_world);
    };
    let wall = grey(rng, "wall");
    for (label, mesh) in room.shell(grey(rng, "floor"), grey(rng, "ceiling"), wall) {
        put(mesh, label, Affine::IDENTITY);
    }
    let mut taken: Vec<Footprint> = Vec::new();
    for label in ["cube", "cylinder", "mirror"] {
        let mesh = match label {
            "cube" => cube(rng, &rooms.cube),
            "cylinder" => cylinder(rng, &rooms.cylinder),
            _ if rooms.mirror_wall == MirrorWall::None => continue,
            _ => mirror(rng, &rooms.mirror),
        };
        let (lo, hi) = mesh.bounds()?;
        let half = [(hi.x - lo.x) * 0.5, (hi.z - lo.z) * 0.5];
        let spot = (0..64).find_map(|_| {
            let (at, yaw) = if label == "mirror" {
                let wall = match rooms.mirror_wall {
                    MirrorWall::Back => BACK,
                    MirrorWall::Any | MirrorWall::None => rng.below(4),
                };
                let (at, yaw) = room.against_wall(wall, rng.range(-1.0, 1.0), half, 0.002);
                ([at[0], drawn(rng, rooms.mirror_from_m), at[1]], yaw)
            } else {
                let x = rng.range(-0.5, 0.5) * room.width;
                let z = rng.range(-0.5, 0.5) * room.depth;
                ([x, 0.0005, z], rng.range(0.0, TAU))
            };
            let foot = Footprint::new(at, yaw, half, hi.y);
            let free = room.holds(&foot) && !taken.iter().any(|t| t.overlaps(&foot));
            free.then_some((foot, at, yaw))
        });
        let (foot, at, yaw) = spot?;
        taken.push(foot);
        put(mesh, label, Affine::yaw_then_move(yaw, at.into()));
    }
    for _ in 0..CAMERAS {
        let fov = settings.fov_deg + rng.range(-1.0, 1.0) * rooms.fov_jitter_deg as f32;
        let eye = Vec3::new(
            rng.range(-0.45, 0.45) * room.width,
            rng.range(0.35, 0.7) * room.height,
            rng.range(0.38, 0.47) * room.depth,
        );
        let target = Vec3::new(
            rng.range(-0.15, 0.15) * room.width,
            rng.range(0.2, 0.5) * room.height,
            rng.range(-0.3, 0.0) * room.depth,
        );
        let (width, height) = (settings.width, settings.height);
        let mut camera = Camera::look_at(eye, target, acceptance(fov, width, height));
        let bounds = rooms.depth_m.map(|z| z as f32);
        let Some(seen) = coarse_view(&world, &camera, bounds, objects.len()) else {
            continue;
        };
        let Some(laser) = aim.laser_at(&camera, settings.laser_m.into(), &world) else {
            continue;
        };
        // Every object other than the room itself must be in view.
        if seen[WALLS..].contains(&0) || !beams_land(&world, &laser, &objects) {
            continue;
        }
        if let Some([near, far]) = depths_in_box((&world, WALLS), room.corners(), &camera, bounds) {
            camera.intrinsics = Intrinsics::from_fov(fov, width, height);
            let notes = BTreeMap::from([
                ("attempt".to_owned(), attempt.to_string()),
                ("depth_m".to_owned(), format!("{near:.3}..{far:.3}")),
                ("fov_deg".to_owned(), format!("{fov:.3}")),
                ("room_m".to_owned(), room.describe()),
            ]);
            return Some(Scene {
                name: format!("primitive-{seed}"),
                objects,
                labels: vocabulary(),
                camera,
                laser,
                provenance: Provenance {
                    source: GENERATOR_VERSION.into(),
                    seed: Some(seed),
                    attribution: Vec::new(),
                    notes,
                },
            });
        }
    }
    None
}
