//! The scenes of a render or generate stage: their source, their form in a job file, and the
//! checks.

use picofarm_settings::{FloorPlan, MirrorWall, PrimitiveRooms, Sizes, Spots};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};

use super::scene_files::FilesIn;
pub use super::scene_files::{FileView, SceneFile};
use crate::{
    show,
    spec::{
        limits::check_count,
        spec_error::{SpecError, within},
    },
};

/// Names of furniture that stand for any installed library.
const LIBRARIES: [&str; 5] = ["", "auto", "parametric", "sweethome3d", "gltf"];
/// Field of view of generated rooms, degrees.
const FOV_DEG: f64 = 90.0;
/// The kinds of scenes.
const KINDS: [&str; 4] = ["furnished", "primitive", "desktop", "files"];

/// The scenes of a job: one task each.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "SceneSourceText")]
pub struct SceneSource {
    /// The kind of scenes.
    #[serde(flatten)]
    pub kind: SceneKind,
    /// Number of scenes; with `kind = "files"`, the number of files (may be omitted).
    pub count: u64,
    /// Seed (default 0). Scene i derives its own from (seed, i).
    pub seed: u64,
    /// Horizontal field of view in degrees (default 90, for boxes on a desk 46; `None` = that of
    /// the files' cameras).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fov_deg: Option<f64>,
    /// Laser spots (generated scenes, and files without a laser; default a grid of 25, for boxes on
    /// a desk 16; for files see also [`FileView`]).
    pub spots: Spots,
    /// Position of the laser in the camera's frame: x right, y down, z forward, metres (generated
    /// scenes; default the camera's centre). Its beams go to the points that the camera sees at the
    /// spots' places.
    #[serde(skip_serializing_if = "is_centre")]
    pub laser_m: [f64; 3],
}

fn is_box(plan: &FloorPlan) -> bool {
    *plan == FloorPlan::Box
}

fn is_centre(place: &[f64; 3]) -> bool {
    *place == [0.0; 3]
}

/// The kind of scenes.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum SceneKind {
    /// Furnished rooms.
    Furnished {
        /// `parametric`, `sweethome3d`, `auto` (default: the installed library, resolved before
        /// submission), or a resolved fingerprint.
        assets: String,
        /// Fewest mirrors in a room (default 1).
        min_specular: u32,
        /// Shapes of the rooms.
        #[serde(skip_serializing_if = "is_box")]
        floor_plan: FloorPlan,
    },
    /// Primitive rooms: cube, cylinder and mirror in a room of varying scale. `kind = "desktop"`
    /// stands for [`PrimitiveRooms::DESKTOP`].
    Primitive {
        /// Sizes of rooms and objects, bounds of depth, the mirror's wall.
        #[serde(skip_serializing_if = "is_living")]
        rooms: PrimitiveRooms,
    },
    /// Scene files (.glb, .gltf, .xml, .json, .obj, .ply, .stl), one scene each.
    Files {
        /// The files. In a job file: paths, patterns such as `models/*.glb`, and folders.
        files: Vec<SceneFile>,
        /// Index of the first file: 0 except in a lease, which contains only its own files.
        #[serde(skip_serializing_if = "is_zero")]
        first: u64,
        /// Folder with everything that the scene files refer to (meshes, buffers, textures);
        /// defaults to each scene file's own folder.
        #[serde(skip_serializing_if = "Option::is_none")]
        root: Option<String>,
        /// How the files are read.
        #[serde(flatten)]
        view: FileView,
    },
}

fn is_living(rooms: &PrimitiveRooms) -> bool {
    *rooms == PrimitiveRooms::LIVING
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "as serde passes it")]
fn is_zero(n: &u64) -> bool {
    *n == 0
}

/// Triangles of a room with furniture of a library, with a margin: the largest of 87 rooms with
/// Sweet Home 3D's furniture had 399,000.
const FURNISHED: u64 = 450_000;

impl SceneKind {
    /// Returns the paths that are read, each with its field: of one scene, or of all.
    pub(super) fn inputs(&self, scene: Option<u64>) -> Vec<(String, &str)> {
        let Self::Files {
            files, first, root, ..
        } = self
        else {
            return Vec::new();
        };
        let root = root.iter().map(|root| ("scenes.root".to_owned(), &**root));
        let files = files.iter().zip(*first..);
        let named = files.filter(|(_, i)| scene.is_none_or(|scene| *i == scene));
        let named = named.map(|(file, i)| (format!("scenes.files[{i}]"), &*file.path));
        root.chain(named).collect()
    }

    /// Returns the triangles of a scene, as far as memory depends on them; 0 if they are few, or
    /// unknown without the files.
    pub(super) fn triangles(&self) -> u64 {
        match self {
            Self::Furnished { assets, .. } if !assets.starts_with("parametric") => FURNISHED,
            Self::Furnished { .. } | Self::Primitive { .. } | Self::Files { .. } => 0,
        }
    }

    /// Returns the file of scene `index`, if it is listed.
    pub fn file(&self, index: u64) -> Option<&SceneFile> {
        match self {
            Self::Files { files, first, .. } => {
                files.get(usize::try_from(index.checked_sub(*first)?).ok()?)
            }
            _ => None,
        }
    }
}

impl SceneSource {
    /// What shapes the scenes, but for seed, field of view and spots, as keys know it. Files count
    /// by `files`.
    pub(super) fn shaping(&self, files: FilesIn<'_>) -> Value {
        let mut value = self.kind_shaping(files);
        if !is_centre(&self.laser_m) {
            value["laser_m"] = json!(self.laser_m);
        }
        if let SceneKind::Files { view, .. } = &self.kind
            && (*view != FileView::default() || self.fov_deg.is_some())
        {
            value["view"] = json!({"with": view, "fov_deg": self.fov_deg});
        }
        value
    }

    /// Returns the field of view as keys know it.
    pub(super) fn shaping_fov(&self) -> f64 {
        self.fov_deg.unwrap_or(FOV_DEG)
    }

    fn kind_shaping(&self, counted: FilesIn<'_>) -> Value {
        match &self.kind {
            SceneKind::Furnished {
                assets,
                min_specular,
                floor_plan,
            } => {
                let mut known =
                    json!({"kind": "furnished", "assets": assets, "min_specular": min_specular});
                if !is_box(floor_plan) {
                    known["floor_plan"] = json!(floor_plan);
                }
                known
            }
            SceneKind::Primitive { rooms } if is_living(rooms) => json!({"kind": "primitive"}),
            SceneKind::Primitive { rooms } => json!({"kind": "primitive", "rooms": rooms}),
            SceneKind::Files { files, .. } => match counted {
                FilesIn::All => json!({
                    "kind": "files",
                    "sha256": files.iter().map(|f| f.sha256.as_str()).collect::<Vec<_>>(),
                }),
                FilesIn::One(file) => json!({"kind": "files", "sha256": file.sha256}),
                FilesIn::None => json!({"kind": "files"}),
            },
        }
    }

    /// Checks the values that a client must have filled in before it submits.
    ///
    /// # Errors
    /// Returns a [`SpecError`] for the field.
    pub(in crate::spec) fn check_resolved(&self) -> Result<(), SpecError> {
        match &self.kind {
            SceneKind::Furnished { assets, .. } if LIBRARIES.contains(&&**assets) => {
                Err(SpecError::new(
                    "scenes.assets",
                    format!(
                        "{assets:?} is not a fingerprint; the client must resolve it (e.g. to \"parametric-1\") before it submits"
                    ),
                ))
            }
            SceneKind::Files { files, .. } => match files.iter().find(|f| f.sha256.len() != 64) {
                Some(file) => Err(SpecError::new(
                    "scenes.files",
                    format!(
                        "{:?} has no SHA-256; the client must hash each file before it submits",
                        file.path
                    ),
                )),
                None => Ok(()),
            },
            _ => Ok(()),
        }
    }

    pub(super) fn check(&self) -> Result<(), SpecError> {
        check_count("scenes.count", self.count)?;
        if let SceneKind::Files { first: 1.., .. } = &self.kind {
            return Err(SpecError::new(
                "scenes.first",
                "is only for leases; remove it",
            ));
        }
        if let SceneKind::Files { files, .. } = &self.kind
            && files.len() as u64 != self.count
        {
            return Err(SpecError::new(
                "scenes.count",
                format!(
                    "{} differs from the {} files listed; leave count out",
                    self.count,
                    files.len()
                ),
            ));
        }
        // The limits of the generators: beyond them, walls or furniture leave the view.
        let degrees = "degrees from left to right";
        let limits = match self.kind {
            SceneKind::Files { .. } => (1.0, 170.0),
            _ => (20.0, 120.0),
        };
        if let Some(fov_deg) = self.fov_deg {
            within("scenes.fov_deg", fov_deg, limits, degrees)?;
        }
        let spots = self.spots.check();
        spots.map_err(|what| SpecError::new("scenes.spots", what))?;
        let metres = "metres from the camera's centre";
        for along in self.laser_m {
            within("scenes.laser_m", along, (-5.0, 5.0), metres)?;
        }
        match &self.kind {
            SceneKind::Furnished { min_specular, .. } => within(
                "scenes.min_specular",
                *min_specular,
                (0, 16),
                "mirrors a room at least; more find no wall",
            ),
            SceneKind::Primitive { rooms } => {
                let named = |(field, what)| SpecError::new(format!("scenes.rooms.{field}"), what);
                rooms.check().map_err(named)?;
                let (fov, jitter) = (self.shaping_fov(), rooms.fov_jitter_deg);
                let degrees =
                    "degrees less and more than scenes.fov_deg, which must stay within 1 and 170";
                let most = (fov - 1.0).min(170.0 - fov);
                within("scenes.rooms.fov_jitter_deg", jitter, (0.0, most), degrees)
            }
            SceneKind::Files { .. } if !is_centre(&self.laser_m) => Err(SpecError::new(
                "scenes.laser_m",
                "is of generated scenes; a file says itself where its laser stands",
            )),
            SceneKind::Files { view, .. } => view.check(),
        }
    }
}

/// The written form of `[scenes]`. Unknown fields are refused.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct SceneSourceText {
    kind: String,
    assets: Option<String>,
    min_specular: Option<u32>,
    floor_plan: Option<FloorPlan>,
    files: Option<Vec<SceneFile>>,
    root: Option<String>,
    /// Only in a lease.
    #[serde(default)]
    first: u64,
    count: Option<u64>,
    #[serde(default)]
    seed: u64,
    fov_deg: Option<f64>,
    spots: Option<Spots>,
    laser_m: Option<[f64; 3]>,
    rooms: Option<RoomsText>,
    camera: Option<String>,
    look_from: Option<[f64; 3]>,
    look_at: Option<[f64; 3]>,
    up: Option<[f64; 3]>,
    unit: Option<String>,
    #[serde(default)]
    replace_laser: bool,
    #[serde(default)]
    spread_spots: bool,
}

/// The written form of `scenes.rooms`. Omitted fields default to the kind's values.
#[derive(Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct RoomsText {
    scale: Option<[f64; 2]>,
    depth_m: Option<[f64; 2]>,
    fov_jitter_deg: Option<f64>,
    cube: Option<Sizes>,
    cylinder: Option<Sizes>,
    mirror: Option<Sizes>,
    mirror_wall: Option<MirrorWall>,
    mirror_from_m: Option<[f64; 2]>,
}

impl RoomsText {
    fn over(self, of: PrimitiveRooms) -> PrimitiveRooms {
        PrimitiveRooms {
            scale: self.scale.unwrap_or(of.scale),
            depth_m: self.depth_m.unwrap_or(of.depth_m),
            fov_jitter_deg: self.fov_jitter_deg.unwrap_or(of.fov_jitter_deg),
            cube: self.cube.unwrap_or(of.cube),
            cylinder: self.cylinder.unwrap_or(of.cylinder),
            mirror: self.mirror.unwrap_or(of.mirror),
            mirror_wall: self.mirror_wall.unwrap_or(of.mirror_wall),
            mirror_from_m: self.mirror_from_m.unwrap_or(of.mirror_from_m),
        }
    }
}

impl TryFrom<SceneSourceText> for SceneSource {
    type Error = SpecError;

    fn try_from(text: SceneSourceText) -> Result<Self, SpecError> {
        // This check comes first, because fields can only be attributed to a known kind.
        if !KINDS.contains(&&*text.kind) {
            return Err(SpecError::new(
                "scenes.kind",
                show::unknown(&text.kind, &KINDS),
            ));
        }
        let only = |field: &str, kind: &str, given: bool| {
            if given && text.kind != kind {
                Err(SpecError::new(
                    format!("scenes.{field}"),
                    format!(
                        "belongs to kind = \"{kind}\"; remove it from kind = {:?}",
                        text.kind
                    ),
                ))
            } else {
                Ok(())
            }
        };
        only("assets", "furnished", text.assets.is_some())?;
        only("min_specular", "furnished", text.min_specular.is_some())?;
        only("floor_plan", "furnished", text.floor_plan.is_some())?;
        only("files", "files", text.files.is_some())?;
        only("root", "files", text.root.is_some())?;
        only("first", "files", text.first != 0)?;
        let view = FileView {
            camera: text.camera,
            look_from: text.look_from,
            look_at: text.look_at,
            up: text.up,
            unit: text.unit,
            replace_laser: text.replace_laser,
            // Spots that the job does not state are chosen as on a command line.
            spread_spots: text.spread_spots || (text.kind == "files" && text.spots.is_none()),
        };
        if let Some(field) = view.given() {
            only(field, "files", true)?;
        }
        if view.spread_spots && text.spots.as_ref().is_some_and(|s| *s != Spots::Grid(25)) {
            let what = "spreads 25 spots; remove it, or remove scenes.spots";
            return Err(SpecError::new("scenes.spread_spots", what));
        }
        if text.rooms.is_some() && !matches!(&*text.kind, "primitive" | "desktop") {
            let what = format!(
                "belongs to kind = \"primitive\" or \"desktop\"; remove it from kind = {:?}",
                text.kind
            );
            return Err(SpecError::new("scenes.rooms", what));
        }
        let desktop = text.kind == "desktop";
        let rooms = text.rooms.unwrap_or_default();
        let mut count = text.count;
        let kind = match text.kind.as_str() {
            "furnished" => SceneKind::Furnished {
                assets: text.assets.unwrap_or_else(|| "auto".into()),
                min_specular: text.min_specular.unwrap_or(1),
                floor_plan: text.floor_plan.unwrap_or_default(),
            },
            "primitive" => SceneKind::Primitive {
                rooms: rooms.over(PrimitiveRooms::LIVING),
            },
            "desktop" => SceneKind::Primitive {
                rooms: rooms.over(PrimitiveRooms::DESKTOP),
            },
            _ => {
                let files = text.files.unwrap_or_default();
                count = count.or(Some(files.len() as u64));
                SceneKind::Files {
                    files,
                    first: text.first,
                    root: text.root,
                    view,
                }
            }
        };
        Ok(SceneSource {
            kind,
            count: count
                .ok_or_else(|| SpecError::new("scenes.count", "is missing; say how many scenes"))?,
            seed: text.seed,
            fov_deg: text.fov_deg.or(match &*text.kind {
                "files" => None,
                "desktop" => Some(46.0),
                _ => Some(FOV_DEG),
            }),
            spots: text
                .spots
                .unwrap_or(Spots::Grid(if desktop { 16 } else { 25 })),
            laser_m: text.laser_m.unwrap_or_default(),
        })
    }
}
