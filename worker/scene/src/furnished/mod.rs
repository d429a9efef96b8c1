//! Furnished rooms: a room type, realistically placed furniture, small objects on tops, pictures
//! and mirrors on the walls, and a camera that sees enough of it at bounded depth.

mod camera;
mod decor;
mod furniture;
mod plan;
mod shell;
#[cfg(test)]
mod tests;
mod tops;

use std::collections::{BTreeMap, BTreeSet};

use picofarm_settings::{FloorPlan, Spots};
use serde::{Deserialize, Serialize};

use crate::{
    Aim, AssetLibrary, Material, Provenance, Scene, SceneError, label::vocabulary, layout::Room,
    rng::Rng,
};
use plan::Plan;

/// Changes whenever the same seed and assets would give another scene.
pub const GENERATOR_VERSION: &str = "furnished-2";

/// The number of rooms to try for one seed.
const ATTEMPTS: u32 = 64;

/// The settings of a furnished room.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FurnishedSettings {
    /// The laser spots.
    pub spots: Spots,
    /// The laser's position in the camera's frame (x right, y down, z forward), metres.
    pub laser_m: [f32; 3],
    /// The image width in pixels.
    pub width: u32,
    /// The image height in pixels.
    pub height: u32,
    /// The horizontal field of view, degrees.
    pub fov_deg: f32,
    /// The name of the furniture library ([`AssetLibrary::find`]).
    pub assets: String,
    /// The least number of specular objects in view, 0 to 4.
    pub specular_at_least: u32,
    /// The shapes of the rooms.
    pub floor_plan: FloorPlan,
}

impl Default for FurnishedSettings {
    fn default() -> Self {
        Self {
            spots: Spots::Grid(25),
            laser_m: [0.0; 3],
            width: 256,
            height: 256,
            fov_deg: 90.0,
            assets: "parametric".into(),
            specular_at_least: 0,
            floor_plan: FloorPlan::Box,
        }
    }
}

/// The type of the room, which determines its furniture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum RoomType {
    Living,
    Bedroom,
    Office,
    Kitchen,
}

impl RoomType {
    const ALL: [Self; 4] = [Self::Living, Self::Bedroom, Self::Office, Self::Kitchen];

    fn name(self) -> &'static str {
        match self {
            Self::Living => "living room",
            Self::Bedroom => "bedroom",
            Self::Office => "office",
            Self::Kitchen => "kitchen",
        }
    }
}

/// Generates the furnished room of `seed`: the same scene, bit for bit, on every machine with the
/// same assets.
///
/// # Errors
/// [`SceneError::Invalid`] for settings out of range, [`SceneError::Assets`] if `assets` is not the
/// library that the settings name, [`SceneError::Exhausted`] if no sub-seed gives an acceptable
/// view.
pub fn generate(
    seed: u64,
    settings: &FurnishedSettings,
    assets: &AssetLibrary,
) -> Result<Scene, SceneError> {
    let aim = settings.check(seed, assets)?;
    for attempt in 0..ATTEMPTS {
        let mut rng = Rng::new(seed, u64::from(attempt));
        let (plan, kind) = furnish(&mut rng, settings, assets);
        if let Some(view) = camera::choose(&mut rng, settings, &aim, &plan) {
            let scene = finish(seed, attempt, kind, plan, view, assets);
            tracing::debug!(
                seed,
                attempt,
                objects = scene.objects.len(),
                "furnished room accepted"
            );
            return Ok(scene);
        }
    }
    Err(SceneError::Exhausted {
        generator: GENERATOR_VERSION.into(),
        seed,
        attempts: ATTEMPTS,
    })
}

impl FurnishedSettings {
    fn check(&self, seed: u64, assets: &AssetLibrary) -> Result<Aim, SceneError> {
        if self.assets != assets.name() {
            return Err(SceneError::Assets {
                name: self.assets.clone(),
                looked: format!("the library at hand is {:?}", assets.name()),
                hint: "pass the library that the settings name",
            });
        }
        let specular = if self.specular_at_least > 4 {
            Err((
                "specular_at_least",
                format!("{}: choose 0 to 4", self.specular_at_least),
            ))
        } else {
            Ok(())
        };
        specular
            .and_then(|()| crate::camera::check_view(self.width, self.height, self.fov_deg))
            .and_then(|()| Aim::of(&self.spots, seed).map_err(|what| ("spots", what)))
            .map_err(|(field, what)| SceneError::Invalid {
                scene: GENERATOR_VERSION.into(),
                field: field.into(),
                what,
            })
    }
}

fn furnish<'a>(
    rng: &mut Rng,
    settings: &FurnishedSettings,
    assets: &'a AssetLibrary,
) -> (Plan<'a>, RoomType) {
    let kind = *rng.pick(&RoomType::ALL);
    let room = Room {
        width: rng.range(2.9, 4.2),
        depth: rng.range(2.9, 4.2),
        height: rng.range(2.3, 2.8),
    };
    let mut plan = Plan::new(room, assets);
    let (floor, ceiling, wall) = (
        surface(rng, "floor", 0.3, 0.75),
        surface(rng, "ceiling", 0.75, 0.9),
        surface(rng, "wall", 0.45, 0.9),
    );
    let [door, window] = match settings.floor_plan {
        FloorPlan::Box => {
            for (label, mesh) in room.shell(floor, ceiling, wall) {
                plan.fix(mesh, label);
            }
            [false; 2]
        }
        FloorPlan::Varied => shell::varied(rng, &mut plan, [floor, ceiling, wall]),
    };
    decor::doors_and_windows(rng, &mut plan, [door, window]);
    furniture::anchors(rng, &mut plan, kind);
    furniture::groups(rng, &mut plan, kind);
    furniture::clutter(rng, &mut plan);
    decor::pictures_and_mirrors(rng, &mut plan, settings.specular_at_least);
    tops::drop_things(rng, &mut plan, kind);
    (plan, kind)
}

/// Returns paint or boards of a random tone.
fn surface(rng: &mut Rng, name: &str, lo: f32, hi: f32) -> Material {
    let level = rng.range(lo, hi);
    let rgb = [
        rng.range(0.92, 1.0),
        rng.range(0.88, 1.0),
        rng.range(0.8, 1.0),
    ];
    Material::diffuse(name, rgb.map(|c| c * level))
}

fn finish(
    seed: u64,
    attempt: u32,
    kind: RoomType,
    plan: Plan<'_>,
    view: camera::View,
    assets: &AssetLibrary,
) -> Scene {
    let attribution: BTreeSet<String> = plan
        .placed
        .iter()
        .filter_map(|p| p.attribution.clone())
        .collect();
    let [near, far] = view.depth;
    let mut notes = BTreeMap::from([
        ("assets".to_owned(), assets.fingerprint().to_owned()),
        ("attempt".to_owned(), attempt.to_string()),
        ("depth_m".to_owned(), format!("{near:.3}..{far:.3}")),
        ("room_m".to_owned(), plan.room.describe()),
        ("room_type".to_owned(), kind.name().to_owned()),
    ]);
    for change in ["transparent materials made opaque", "textures left out"] {
        let models = plan
            .placed
            .iter()
            .filter(|p| p.changes.contains(&change))
            .count();
        if models > 0 {
            notes.insert(
                change.to_owned(),
                format!("in {models} of {} models", plan.placed.len()),
            );
        }
    }
    Scene {
        name: format!("furnished-{seed}"),
        objects: plan.objects(),
        labels: vocabulary(),
        camera: view.camera,
        laser: view.laser,
        provenance: Provenance {
            source: GENERATOR_VERSION.into(),
            seed: Some(seed),
            attribution: attribution.into_iter().collect(),
            notes,
        },
    }
}
