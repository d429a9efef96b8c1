//! Rendered rooms with their truth, for the examples. A folder named by `CACHE` in the environment
//! keeps rendered rooms, so that a second run need not render them.
#![allow(dead_code, reason = "each example uses its part")]

use std::{env, fs, path::PathBuf, str::FromStr};

use picofarm_demultiplex::{Capture, Place, Settings, Shading, Spot, Truth};
use picofarm_scene::{AssetLibrary, Camera, Vec3, furnished};
use picofarm_settings::Spots;
use picofarm_transient::{self as transient, Budget, Gate, Progress};

struct Unstopped;

impl Progress for Unstopped {
    fn at(&self, _: f32) -> bool {
        true
    }
}

/// Returns the variable `name` of the environment, or `usual` where it is not set.
pub fn variable<T: FromStr>(name: &str, usual: T) -> T {
    let text = env::var(name).ok();
    text.map_or(usual, |text| {
        text.parse()
            .unwrap_or_else(|_| panic!("{name}={text:?} cannot be read; see the example's head"))
    })
}

/// Returns the settings of the method: shadows by `SHADOWS`, or the default.
pub fn settings() -> Settings {
    let mut settings = Settings::default();
    if let Ok(name) = env::var("SHADOWS") {
        settings.shadows = match &*name {
            "physics" => Shading::Physics,
            "learned" => Shading::Learned,
            other => panic!("SHADOWS={other:?}: expected physics or learned"),
        };
    }
    settings
}

/// A kind of room.
#[derive(Debug, Clone)]
pub struct Kind {
    /// `parametric` or `sweethome3d`; the latter is searched for in the folder `ASSETS_DIR`.
    pub assets: String,
    /// Pixels a side.
    pub side: u32,
    /// Spots of a grid.
    pub spots: u32,
    /// Error of the render, relative.
    pub error: f64,
}

impl Kind {
    /// Reads `ASSETS` (parametric), `SIDE` (128), `SPOTS` (25) and `ERROR` (0.1).
    pub fn of_environment() -> Self {
        Self {
            assets: variable("ASSETS", "parametric".to_owned()),
            side: variable("SIDE", 128),
            spots: variable("SPOTS", 25),
            error: variable("ERROR", 0.1),
        }
    }
}

/// A rendered room.
pub struct Room {
    pub camera: Camera,
    pub gate: Gate,
    pub laser: Vec3,
    pub spots: Vec<Spot>,
    pub histogram: Vec<f32>,
    pub depth: Vec<f32>,
    pub specular: Vec<u8>,
    pub visibility: Vec<u8>,
}

const GATE: Gate = Gate {
    start_m: 1.0,
    bin_width_m: 0.0384,
    bins: 637,
};

impl Room {
    /// Generates and renders the furnished room of a seed, or reads it from the cache.
    pub fn new(seed: u64, kind: &Kind) -> Self {
        let settings = furnished::FurnishedSettings {
            assets: kind.assets.clone(),
            spots: Spots::Grid(kind.spots),
            width: kind.side,
            height: kind.side,
            ..Default::default()
        };
        let folder: PathBuf = variable("ASSETS_DIR", PathBuf::from("assets"));
        let library = AssetLibrary::find(&kind.assets, &[folder]).expect("furniture");
        let scene = furnished::generate(seed, &settings, &library).expect("a room");
        let cache: Option<PathBuf> = env::var_os("CACHE").map(PathBuf::from);
        let file = cache.map(|folder| {
            fs::create_dir_all(&folder).expect("CACHE is a folder that can be written");
            let Kind {
                assets,
                side,
                spots,
                error,
            } = kind;
            folder.join(format!("{assets}-{seed}-{side}-{spots}-{error}.room"))
        });
        let kept = file.as_ref().and_then(|f| fs::read(f).ok());
        let arrays = match kept {
            Some(bytes) => Arrays::read(&bytes),
            None => {
                let arrays = Arrays::render(&scene, seed, kind);
                if let Some(file) = &file {
                    fs::write(file, arrays.write()).expect("CACHE has room");
                }
                arrays
            }
        };
        let known = env::var_os("RETURNS").is_none();
        let places = arrays.places.chunks(4);
        let spots = scene.laser.beams.iter().zip(places).map(|(beam, p)| Spot {
            direction: beam.direction,
            place: (known && p[3].is_finite()).then(|| Place {
                point: Vec3::new(p[0], p[1], p[2]),
                path_m: p[3],
            }),
        });
        Self {
            spots: spots.collect(),
            camera: scene.camera,
            gate: GATE,
            laser: scene.laser.origin,
            histogram: arrays.histogram,
            depth: arrays.depth,
            specular: arrays.specular.iter().map(|x| *x as u8).collect(),
            visibility: arrays.visibility.iter().map(|x| *x as u8).collect(),
        }
    }

    /// The room as the method sees it.
    pub fn capture(&self) -> Capture<'_> {
        Capture {
            histogram: &self.histogram,
            gate: self.gate,
            camera: &self.camera,
            laser: self.laser,
            spots: &self.spots,
        }
    }

    /// What it ought to find.
    pub fn truth(&self) -> Truth<'_> {
        Truth {
            depth_m: &self.depth,
            specular: &self.specular,
            visibility: &self.visibility,
        }
    }
}

/// What the cache keeps.
struct Arrays {
    histogram: Vec<f32>,
    depth: Vec<f32>,
    specular: Vec<f32>,
    visibility: Vec<f32>,
    /// x, y, z, path of each spot; NaN where a beam has none.
    places: Vec<f32>,
}

impl Arrays {
    fn render(scene: &picofarm_scene::Scene, seed: u64, kind: &Kind) -> Self {
        let settings = transient::Settings {
            one_bounce: true,
            seed,
            ..transient::Settings::new(GATE, Budget::Error(kind.error))
        };
        let made = transient::render(scene, &settings, &Unstopped).expect("a render");
        let float = |all: &[u8]| all.iter().map(|x| f32::from(*x)).collect();
        let places = made.spots.iter().flat_map(|spot| match spot {
            Some(s) => [s.point.x, s.point.y, s.point.z, s.path_m],
            None => [f32::NAN; 4],
        });
        Self {
            places: places.collect(),
            depth: made.truth.depth.clone(),
            specular: float(&made.truth.specular),
            visibility: float(&made.truth.visibility),
            histogram: made.transient,
        }
    }

    fn parts(&self) -> [&Vec<f32>; 5] {
        [
            &self.histogram,
            &self.depth,
            &self.specular,
            &self.visibility,
            &self.places,
        ]
    }

    fn write(&self) -> Vec<u8> {
        let mut bytes = Vec::new();
        for part in self.parts() {
            bytes.extend((part.len() as u64).to_le_bytes());
            bytes.extend(part.iter().flat_map(|x| x.to_le_bytes()));
        }
        bytes
    }

    fn read(bytes: &[u8]) -> Self {
        let mut rest = bytes;
        let mut part = || -> Vec<f32> {
            let (count, after) = rest.split_first_chunk::<8>().expect("a whole file");
            let (values, after) = after.split_at(4 * u64::from_le_bytes(*count) as usize);
            rest = after;
            let word = |b: &[u8]| f32::from_le_bytes([b[0], b[1], b[2], b[3]]);
            values.chunks_exact(4).map(word).collect()
        };
        Self {
            histogram: part(),
            depth: part(),
            specular: part(),
            visibility: part(),
            places: part(),
        }
    }
}
