//! The subcommands of `picofarm capture`.

use std::path::PathBuf;

use clap::{Args, Subcommand};

#[derive(Subcommand)]
pub enum Capture {
    /// Read what a laboratory measured into a data set of one scene; docs/captures.md has the steps
    #[command(after_help = DESCRIPTION)]
    Import(CaptureImport),
    /// Judge a capture and its calibration: causes with figures, and a verdict; fails if results
    /// would be wrong, or if the capture cannot tell
    Check {
        /// A folder of `picofarm capture import` or of `picofarm scene render`
        capture: PathBuf,
    },
    /// Correct a capture's calibration: t0, laser, spots, camera, pixels
    Calibrate {
        /// A folder of `picofarm capture import` or of `picofarm scene render`; it is not changed
        capture: PathBuf,
        /// Folder for the data set, preview.png, and calibration.json and .png in its folder render
        /// (must not exist, or be empty)
        #[arg(long, value_name = "DIR")]
        out: PathBuf,
    },
    /// Put a capture on another gate, scale or image; photons outside are counted
    Resample(CaptureResample),
    /// Show the gate, the spots, the photons of each spot, and the background of a capture
    Show {
        /// A folder of `picofarm capture import` or of `picofarm scene render`
        capture: PathBuf,
    },
}

#[derive(Args)]
pub struct CaptureImport {
    /// Histogram files (several are one spot each, in this order), the folder of a capture, or a
    /// description
    #[arg(required = true, value_name = "FILES")]
    pub files: Vec<PathBuf>,
    /// Description of what the files do not say [default: capture.json in the folder of the files]
    #[arg(long, value_name = "FILE")]
    pub describe: Option<PathBuf>,
    /// Folder for the data set and preview.png (must not exist, or be empty)
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
}

#[derive(Args)]
pub struct CaptureResample {
    /// A folder of `picofarm capture import` or of `picofarm scene render`; it is not changed
    pub capture: PathBuf,
    /// Folder for the data set and preview.png (must not exist, or be empty)
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Start of the gate, metres of path, after --scale [default: the capture's]
    #[arg(long, value_name = "M")]
    pub start_m: Option<f64>,
    /// Width of a bin, metres of path, after --scale [default: the capture's]
    #[arg(long, value_name = "M")]
    pub bin_width_m: Option<f64>,
    /// Number of bins [default: up to the end of the capture's gate]
    #[arg(long, value_name = "N")]
    pub bins: Option<u32>,
    /// Factor of all lengths: paths, laser, spots and depth
    #[arg(long, default_value_t = 1.0, value_name = "FACTOR")]
    pub scale: f64,
    /// Part of the image to keep: first column, first row, columns, rows
    #[arg(long, value_name = "X,Y,W,H", value_parser = four)]
    pub crop: Option<[u32; 4]>,
    /// Dark columns and rows to add: left, top, right, bottom
    #[arg(long, value_name = "L,T,R,B", value_parser = four)]
    pub pad: Option<[u32; 4]>,
    /// Add dark columns and rows until the camera's axis is in the middle, to half a pixel
    #[arg(long)]
    pub centre: bool,
}

/// Four whole numbers.
fn four(text: &str) -> Result<[u32; 4], String> {
    let all: Result<Vec<u32>, _> = text.split(',').map(|n| n.trim().parse()).collect();
    let four = all.ok().and_then(|all| <[u32; 4]>::try_from(all).ok());
    four.ok_or_else(|| "expected four whole numbers with commas between, such as 8,0,64,64".into())
}

/// What a description has, below the help of `capture import`.
const DESCRIPTION: &str = r#"A description is JSON. Names of files are relative to it.
  histograms    a file, or a list of one file for each spot; without it, FILES
  array         name of the array in an .npz, MATLAB or HDF5 file with several
  axes          names of its axes [default: spot, row, column, bin, or the last three]; "pixel" with
                "pixels": [rows, columns] stands for rows after rows, "channel" is averaged
  gate          start_m and bin_width_m: path at which bin 0 starts, and width of a bin; or t0_ps,
                start_ps and bin_width_ps, where t0_ps is the time at which light without a path
                would arrive; keep_m: first and last path to keep
  camera        fov_deg: width of the view in degrees; or fx, fy, cx, cy in pixels, where the middle
                of the first pixel is at (0.5, 0.5)
  frame         directions of the axes of positions [default: right, down, forward]
  laser_m       position of the laser; the camera is at the origin
  spots_m       positions of the spots, or directions: directions of the beams; lists, or .npy files
  depth_m       true z-depth, a .npy image, for scores; or range_m, the distance along the ray
  name          name of the scene"#;
