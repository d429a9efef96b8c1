//! PlatoNeRF's measuring room with our own furniture: one object in a box without a rear wall, the
//! published laser targets, and the published novel views.
//!
//! Room, targets and views are those of PlatoNeRF's scripts (facebookresearch/PlatoNeRF,
//! `src/render_test_depth.py` and the scenes' configuration). Its meshes are not public. The object
//! is our own chair, so figures can only be compared qualitatively.

use std::{collections::BTreeMap, f32::consts::PI, sync::Arc};

use serde::{Deserialize, Serialize};

use crate::{
    Affine, AssetLibrary, Beam, Camera, Intrinsics, Laser, Material, Mesh, Object, Provenance,
    Scene, SceneError, Vec3,
    camera::check_view,
    label::{label_id, vocabulary},
    shape::Shape,
};

/// Changes whenever the same settings would give another scene.
pub const GENERATOR_VERSION: &str = "plato-1";

/// The object in the room, with its origin at (0, −2, 3).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PlatoObject {
    /// A chair with slats and thin legs, 1.6 m high.
    Chair,
    /// A bulky armchair.
    Armchair,
    /// A box behind an upright board that hides it from the camera.
    HiddenBox,
    /// Nothing: the walls alone.
    Empty,
}

impl PlatoObject {
    /// All objects, by name.
    pub const ALL: [(&str, Self); 4] = [
        ("chair", Self::Chair),
        ("armchair", Self::Armchair),
        ("hidden-box", Self::HiddenBox),
        ("empty", Self::Empty),
    ];
}

/// The settings of a measuring room.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PlatoSettings {
    /// The object in the room.
    pub object: PlatoObject,
    /// The number of laser spots, 1 to 16: the first of the 16 that PlatoNeRF uses, alternating
    /// between the side walls.
    pub spots: usize,
    /// The image width and height in pixels.
    pub resolution: u32,
}

impl Default for PlatoSettings {
    fn default() -> Self {
        Self {
            object: PlatoObject::Chair,
            spots: 16,
            resolution: 512,
        }
    }
}

/// The targets of the 16 laser beams that PlatoNeRF uses (of 24; it omits 0, 1, 2, 3, 10, 13, 20
/// and 22), relative to the origin, metres. They are reordered, so that the first few light the
/// room from both sides.
const TARGETS: [[f32; 3]; 16] = [
    [2.0, -1.1078, 3.1002],
    [-2.0, -1.7324, 2.7181],
    [3.0214, -2.7955, 3.6143],
    [-1.4669, -2.7112, 3.3530],
    [2.0, -0.1856, 2.2704],
    [-2.0, -1.0168, 2.9207],
    [2.8704, -2.5242, 3.6926],
    [-2.7007, -1.4945, 3.3562],
    [2.0, -1.1757, 2.8799],
    [-2.0, 0.8609, 2.6743],
    [-2.0, -0.0749, 2.6397],
    [-2.0, 0.8670, 2.9932],
    [2.0, 0.4411, 2.0254],
    [-2.0, -1.6505, 3.1773],
    [2.7901, -1.9599, 3.4843],
    [1.8562, -2.7640, 3.4686],
];

/// The position of the object's origin, metres.
const PLACE: Vec3 = Vec3::new(0.0, -2.0, 3.0);

/// Returns the measuring room: x and y in [−2, 2], z in [0, 4], without a wall at z = 0. Camera and
/// laser are at the origin; the camera looks along +z with a field of view of 90°. Every surface is
/// Lambertian with reflectance 0.5.
///
/// # Errors
/// [`SceneError::Invalid`] for settings out of range.
pub fn generate(settings: &PlatoSettings) -> Result<Scene, SceneError> {
    let invalid = |field: &str, what: String| SceneError::Invalid {
        scene: GENERATOR_VERSION.into(),
        field: field.into(),
        what,
    };
    check_view(settings.resolution, settings.resolution, 90.0)
        .map_err(|(_, what)| invalid("resolution", what))?;
    if !(1..=TARGETS.len()).contains(&settings.spots) {
        let what = format!("{}: choose 1 to {}", settings.spots, TARGETS.len());
        return Err(invalid("spots", what));
    }
    let mut objects = room();
    for (label, mesh) in pieces(settings.object) {
        objects.push(Object {
            mesh: Arc::new(mesh),
            to_world: Affine::IDENTITY,
            label: label_id(label),
            name: label.to_owned(),
        });
    }
    let beams = TARGETS[..settings.spots].iter().map(|&target| Beam {
        direction: Vec3::from(target).normalized(),
        spot: None,
    });
    Ok(Scene {
        name: format!("plato-{}", name_of(settings.object)),
        objects,
        labels: vocabulary(),
        camera: looking(Vec3::ZERO, Vec3::new(0.0, 0.0, 1.0), settings.resolution),
        laser: Laser {
            origin: Vec3::ZERO,
            beams: beams.collect(),
        },
        provenance: Provenance {
            source: GENERATOR_VERSION.into(),
            seed: None,
            attribution: Vec::new(),
            notes: BTreeMap::new(),
        },
    })
}

/// Returns PlatoNeRF's 139 test views: 39 that move into the room at 1.5 m below the camera, and
/// 100 on a circle of radius 0.99 m around the object, looking at it. 90° each, `resolution` pixels
/// a side.
pub fn views(resolution: u32) -> Vec<Camera> {
    let ahead = (0..39).map(|k| {
        let eye = Vec3::new(0.0, -1.5, 0.062_821_5 * k as f32);
        looking(eye, eye + Vec3::new(0.0, 0.0, 1.0), resolution)
    });
    let centre = Vec3::new(0.0, -1.5, 3.0);
    let round = (0..100).map(|k| {
        let angle = PI * (k as f32 / 50.0 - 0.5);
        let arm = Vec3::new(libm::cosf(angle), 0.0, libm::sinf(angle)) * 0.99;
        looking(centre + arm, centre, resolution)
    });
    ahead.chain(round).collect()
}

fn looking(eye: Vec3, at: Vec3, resolution: u32) -> Camera {
    Camera::look_at(eye, at, Intrinsics::from_fov(90.0, resolution, resolution))
}

fn name_of(object: PlatoObject) -> &'static str {
    let known = PlatoObject::ALL.iter().find(|(_, o)| *o == object);
    known.map_or("room", |(name, _)| name)
}

fn grey(name: &str) -> Material {
    Material::diffuse(name, [0.5; 3])
}

/// Returns floor, ceiling and three walls, facing inwards.
fn room() -> Vec<Object> {
    let corner = |x: f32, y: f32, z: f32| Vec3::new(2.0 * x, 2.0 * y, 4.0 * z);
    let faces = [
        (
            "floor",
            [[-1., -1., 0.], [-1., -1., 1.], [1., -1., 1.], [1., -1., 0.]],
        ),
        (
            "ceiling",
            [[-1., 1., 0.], [1., 1., 0.], [1., 1., 1.], [-1., 1., 1.]],
        ),
        (
            "wall",
            [[1., -1., 1.], [-1., -1., 1.], [-1., 1., 1.], [1., 1., 1.]],
        ),
        (
            "wall",
            [[-1., -1., 1.], [-1., -1., 0.], [-1., 1., 0.], [-1., 1., 1.]],
        ),
        (
            "wall",
            [[1., -1., 0.], [1., -1., 1.], [1., 1., 1.], [1., 1., 0.]],
        ),
    ];
    let object = |(label, corners): (&str, [[f32; 3]; 4])| {
        let mut shape = Shape::new(label);
        let material = shape.material(grey(label));
        shape.quad(corners.map(|[x, y, z]| corner(x, y, z)), material);
        Object {
            mesh: Arc::new(shape.finish()),
            to_world: Affine::IDENTITY,
            label: label_id(label),
            name: label.to_owned(),
        }
    };
    faces.map(object).into()
}

/// Returns the meshes of an object in the room's frame, with their labels.
fn pieces(object: PlatoObject) -> Vec<(&'static str, Mesh)> {
    // Half turned away from the camera, which is on the −z side.
    let turned = Affine::yaw_then_move(PI + 0.5, PLACE);
    match object {
        PlatoObject::Chair => vec![("chair", furniture("chair", 1.75, &turned))],
        PlatoObject::Armchair => vec![("armchair", furniture("armchair", 1.5, &turned))],
        PlatoObject::HiddenBox => vec![
            ("box", upright([0.0, 0.0, -0.45], [0.5, 1.1, 0.05], 0.0)),
            ("box", upright([0.1, 0.0, 0.15], [0.18, 0.8, 0.18], 0.4)),
        ],
        PlatoObject::Empty => Vec::new(),
    }
}

/// Returns a grey piece of our own furniture, `scale` times as large.
fn furniture(label: &str, scale: f32, place: &Affine) -> Mesh {
    let library = AssetLibrary::parametric();
    let mut mesh = library.first(label);
    for p in &mut mesh.positions {
        *p = place.point(*p * scale);
    }
    for material in &mut mesh.materials {
        *material = grey(&material.name);
    }
    mesh
}

/// Returns a box on the floor from the middle of its bottom relative to the object's position, half
/// width, height, half depth, and turn.
fn upright(at: [f32; 3], [x, height, z]: [f32; 3], yaw: f32) -> Mesh {
    let mut shape = Shape::new("box");
    let material = shape.material(grey("box"));
    let place = Affine::yaw_then_move(yaw, PLACE + Vec3::from(at));
    shape.placed(place, |s| s.cuboid([-x, 0.0, -z], [x, height, z], material));
    shape.finish()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trace::{Model, World};

    #[test]
    fn every_object_stands_in_a_valid_room() {
        for (name, object) in PlatoObject::ALL {
            let settings = PlatoSettings {
                object,
                ..PlatoSettings::default()
            };
            let scene = generate(&settings).expect("settings within range");
            scene.validate().expect("a generated scene is valid");
            assert_eq!(scene.name, format!("plato-{name}"));
            for piece in &scene.objects[5..] {
                let (lo, hi) = piece.mesh.bounds().expect("a piece has vertices");
                let inside = lo.x > -2.0 && lo.z > 1.0 && hi.x < 2.0 && hi.y < 0.0 && hi.z < 4.0;
                assert!(inside && (lo.y + 2.0).abs() < 1e-5, "{name}: {lo:?} {hi:?}");
            }
        }
    }

    #[test]
    fn all_beams_land_and_there_are_as_many_as_asked_for() {
        let settings = PlatoSettings {
            spots: 4,
            ..PlatoSettings::default()
        };
        let scene = generate(&settings).expect("settings within range");
        let mut world = World::default();
        for object in &scene.objects {
            let model = Model::new((*object.mesh).clone()).expect("a mesh has triangles");
            world.add(Arc::new(model), object.to_world);
        }
        assert_eq!(scene.laser.beams.len(), 4);
        for beam in &scene.laser.beams {
            assert!(world.closest(Vec3::ZERO, beam.direction).is_some());
        }
        for spots in [0, 17] {
            let settings = PlatoSettings { spots, ..settings };
            assert!(generate(&settings).is_err(), "{spots} spots");
        }
    }

    #[test]
    fn the_views_are_the_published_ones() {
        let views = views(64);
        assert_eq!(views.len(), 139);
        assert!((views[38].origin.z - 2.3872).abs() < 1e-3);
        assert!((views[39].origin.z - 2.01).abs() < 1e-5);
        assert!(views[39].forward.z > 0.999);
    }
}
