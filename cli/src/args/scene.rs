//! Arguments of `picofarm scene`.

use std::path::PathBuf;

use clap::{Args, Subcommand, ValueEnum};
use picofarm_settings::Spots;

use super::{SceneInput, ScenePlan, SceneRender, SensorArgs, ranges};

#[derive(Subcommand)]
pub enum Scene {
    /// Generate a scene from a seed and write it as .glb
    Generate(SceneGenerate),
    /// Show the contents of a scene file
    Show {
        /// A .glb, .gltf, .xml (Mitsuba), .json, .ply, .obj or .stl file
        file: PathBuf,
        #[command(flatten)]
        input: SceneInput,
    },
    /// Write a scene as .glb, Mitsuba 3 (.xml, with meshes and textures) or one .ply mesh
    Export(SceneExport),
    /// Render one scene file, without a farm, into a Zarr group
    Render(SceneRender),
    /// Predict time, memory and techniques of a render
    Plan(ScenePlan),
    /// Measure a rendered scene with a sensor: pulse, jitter, photon noise, wider bins
    Sense(SceneSense),
}

#[derive(Args)]
pub struct SceneGenerate {
    /// Kind of scene; desktop is a box on a desk, plato the room of the reconstruction
    /// benchmarks
    #[arg(long, value_enum, default_value_t = GeneratorArg::Furnished)]
    pub kind: GeneratorArg,
    /// Seed
    #[arg(long, default_value_t = 1, value_parser = ranges::whole)]
    pub seed: u64,
    /// File to write
    #[arg(long, default_value = "scene.glb", value_name = "FILE")]
    pub out: PathBuf,
    /// Laser spots: a grid of 1, 4, 16, 25 or 100; random:N; or places as X,Y/X,Y (0 to 1,
    /// right and down) [default: 25; 16 in desktop and plato rooms; plato rooms take a number
    /// up to 16]
    #[arg(long, value_parser = ranges::spots)]
    pub spots: Option<Spots>,
    /// Image width and height in pixels
    #[arg(long, default_value_t = 256, value_name = "PX", value_parser = clap::value_parser!(u32).range(1..=4096))]
    pub resolution: u32,
    /// Furniture: auto, parametric, sweethome3d or gltf (a folder of your own models)
    #[arg(long, default_value = "auto")]
    pub assets: String,
    /// Shapes of furnished rooms: varied has L-shaped rooms, open doors and glazed windows
    #[arg(long, value_enum, default_value_t = FloorPlanArg::Box)]
    pub floor_plan: FloorPlanArg,
    /// Object in a plato room
    #[arg(long, value_enum, default_value_t = PlatoArg::Chair)]
    pub object: PlatoArg,
}

#[derive(Args)]
pub struct SceneExport {
    /// A .glb, .gltf, .xml (Mitsuba), .json, .ply, .obj or .stl file
    pub file: PathBuf,
    #[command(flatten)]
    pub input: SceneInput,
    /// Where to write it: a file, or a folder for scene.glb, scene.xml or scene.ply
    #[arg(long, value_name = "DIR_OR_FILE")]
    pub out: PathBuf,
    /// Format [default: by the extension of --out]
    #[arg(long, value_enum)]
    pub format: Option<FormatArg>,
}

#[derive(Clone, Copy, ValueEnum)]
pub enum FormatArg {
    Glb,
    Mitsuba,
    Ply,
}

#[derive(Clone, Copy, ValueEnum)]
pub enum GeneratorArg {
    Furnished,
    Primitive,
    Desktop,
    Plato,
}

#[derive(Clone, Copy, ValueEnum)]
pub enum FloorPlanArg {
    Box,
    Varied,
}

#[derive(Clone, Copy, ValueEnum)]
pub enum PlatoArg {
    Chair,
    Armchair,
    HiddenBox,
    Empty,
}

#[derive(Args)]
pub struct SceneSense {
    /// A Zarr group of `picofarm scene render`; it is not changed
    pub render: PathBuf,
    /// Folder for the new Zarr group (must not exist, or be empty)
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    #[command(flatten)]
    pub sensor: SensorArgs,
    /// Add the sensor's pulse, scale and noise to photon counts as well, which have their own
    #[arg(long)]
    pub on_counts: bool,
    /// Seed of the random numbers
    #[arg(long, default_value_t = 0, value_parser = ranges::whole)]
    pub seed: u64,
    /// Number of the scene: scenes of one seed draw different numbers
    #[arg(long, default_value_t = 0, value_name = "N", value_parser = ranges::whole)]
    pub scene: u64,
    /// Threads [default: all cores]
    #[arg(long, value_parser = ranges::threads)]
    pub threads: Option<usize>,
}
