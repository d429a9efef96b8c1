//! The output of the renderer for one scene, before encoding.

use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::layout::quantity::Quantity;
use crate::layout::spec::DatasetSpec;
use picofarm_store::StorageError;

/// Pinhole intrinsics in pixels; pixel (u, v) has its centre at (u + 0.5, v + 0.5).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Intrinsics {
    /// Focal length along columns.
    pub fx: f32,
    /// Focal length along rows.
    pub fy: f32,
    /// Principal point, columns.
    pub cx: f32,
    /// Principal point, rows.
    pub cy: f32,
}

/// An illumination spot in the camera frame (x right, y down, z forward).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Spot {
    /// Position L_i, metres.
    pub position: [f32; 3],
    /// Unit surface normal.
    pub normal: [f32; 3],
    /// Optical path from the laser to the spot, metres.
    pub path_m: f32,
}

/// One scene's histogram and ground truth. Images are `[row][column]`.
#[derive(Debug, Clone, Copy)]
pub struct SceneRecord<'a> {
    /// h: `[row][column][bin]`, 1/(m² sr), finite and not negative.
    pub transient: &'a [f32],
    /// The additional transients of the data set ([`DatasetSpec::quantities`]), in that order.
    pub subsets: &'a [SubsetRecord<'a>],
    /// z-depth, metres; 0 = nothing.
    pub depth: &'a [f32],
    /// Distance along the ray, metres; 0 = nothing.
    pub range: &'a [f32],
    /// Unit normals, camera frame: `[row][column][3]`.
    pub normal: &'a [f32],
    /// Object index + 1; 0 = nothing.
    pub instance: &'a [u32],
    /// Label index + 1; 0 = nothing.
    pub label: &'a [u16],
    /// 1 = mirror.
    pub specular: &'a [u8],
    /// `[spot][row][column]`, 1 = lit.
    pub visibility: &'a [u8],
    /// Measured two-bounce paths, metres, `[spot][row][column]`, 0 = not measured; empty if the
    /// data set has none.
    pub two_bounce: &'a [f32],
    /// Linear colour `[row][column][3]`; stored clamped to [0, 1] and sRGB-encoded in 8 bits.
    pub rgb: &'a [f32],
    /// The spots; `None` if a beam hits nothing.
    pub spots: &'a [Option<Spot>],
    /// Intrinsics.
    pub intrinsics: Intrinsics,
    /// Camera-to-world matrix, rows of four, points as columns.
    pub camera: [[f32; 4]; 4],
    /// Laser origin, camera frame, metres.
    pub laser: [f32; 3],
    /// Photons per unit of h; see [`crate::photon_scale`]. It is the unit of the coding error in
    /// the square-root profile, and informative in the plain one.
    pub scale: f32,
}

/// The transient of a subset of the spots, or of each single spot.
#[derive(Debug, Clone)]
pub struct SubsetRecord<'a> {
    /// `Transient4`, `Transient25` or `TransientSpots`.
    pub quantity: Quantity,
    /// h, each `[row][column][bin]`; the number of planes is [`DatasetSpec::planes`].
    pub planes: Vec<&'a [f32]>,
}

/// The origin of a scene. It is a pure function of the task (no times, attempts, lease epochs or
/// machine names), because the manifest with it must be the same when the task is run again.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Provenance {
    /// Key of the task that produced it.
    pub task_key: String,
    /// Version of the rendered values.
    pub renderer: String,
    /// Seed of all random numbers.
    pub seed: u64,
    /// Decisions and estimates of the renderer (strategies, approximations, light outside the gate,
    /// noise).
    pub plan: Value,
}

impl SceneRecord<'_> {
    fn check_subsets(&self, spec: &DatasetSpec) -> Result<(), StorageError> {
        let expected: Vec<Quantity> = spec.quantities();
        let expected: Vec<Quantity> = expected
            .into_iter()
            .filter(|q| q.is_transient() && *q != Quantity::Transient)
            .collect();
        let names = |q: &[Quantity]| q.iter().map(|q| q.name()).collect::<Vec<_>>().join(", ");
        let found: Vec<Quantity> = self.subsets.iter().map(|s| s.quantity).collect();
        if found != expected {
            let what = format!(
                "expected those of the data set ({}), found ({})",
                names(&expected),
                names(&found)
            );
            return Err(StorageError::invalid("record.subsets", what));
        }
        for subset in self.subsets {
            let planes = spec.planes(subset.quantity);
            let len = spec.transient_len();
            if subset.planes.len() != planes || subset.planes.iter().any(|p| p.len() != len) {
                let what = format!("expected {planes} histograms of {len} values each");
                let field = format!("record.subsets.{}", subset.quantity.name());
                return Err(StorageError::invalid(field, what));
            }
        }
        Ok(())
    }

    /// Checks that lengths and values fit the specification.
    pub(crate) fn check(&self, spec: &DatasetSpec) -> Result<(), StorageError> {
        let pixels = spec.pixels();
        let spots = spec.spots as usize;
        let paths = if spec.two_bounce { pixels * spots } else { 0 };
        let lengths = [
            ("transient", self.transient.len(), spec.transient_len()),
            ("depth", self.depth.len(), pixels),
            ("range", self.range.len(), pixels),
            ("normal", self.normal.len(), pixels * 3),
            ("instance", self.instance.len(), pixels),
            ("label", self.label.len(), pixels),
            ("specular", self.specular.len(), pixels),
            ("visibility", self.visibility.len(), pixels * spots),
            ("two_bounce", self.two_bounce.len(), paths),
            ("rgb", self.rgb.len(), pixels * 3),
            ("spots", self.spots.len(), spots),
        ];
        for (field, found, expected) in lengths {
            if found != expected {
                let what = format!(
                    "expected {expected} values for {}x{} pixels, {spots} spots and {} bins, found {found}",
                    spec.width, spec.height, spec.gate.bins
                );
                return Err(StorageError::invalid(format!("record.{field}"), what));
            }
        }
        self.check_subsets(spec)?;
        check_values(
            "depth",
            self.depth,
            |x| (0.0..=f32::MAX).contains(&x),
            "a finite length of at least 0",
        )?;
        check_values(
            "range",
            self.range,
            |x| (0.0..=f32::MAX).contains(&x),
            "a finite length of at least 0",
        )?;
        check_values(
            "two_bounce",
            self.two_bounce,
            |x| (0.0..=f32::MAX).contains(&x),
            "a finite length of at least 0",
        )?;
        check_values(
            "normal",
            self.normal,
            |x| (-1.001..=1.001).contains(&x),
            "a component of a unit vector",
        )?;
        check_values("rgb", self.rgb, f32::is_finite, "a finite value")?;
        check_values("specular", self.specular, |x| x <= 1, "0 or 1")?;
        check_values("visibility", self.visibility, |x| x <= 1, "0 or 1")?;
        let i = self.intrinsics;
        check_values(
            "intrinsics",
            &[i.fx, i.fy, i.cx, i.cy],
            f32::is_finite,
            "a finite value",
        )?;
        check_values(
            "camera",
            self.camera.as_flattened(),
            f32::is_finite,
            "a finite value",
        )?;
        check_values("laser", &self.laser, f32::is_finite, "a finite value")?;
        for spot in self.spots.iter().flatten() {
            let row = spot.row();
            check_values(
                "spots",
                &row,
                f32::is_finite,
                "a finite value (None for a beam that meets nothing)",
            )?;
        }
        check_values(
            "scale",
            &[self.scale],
            |x| x.is_normal() && x > 0.0,
            "a positive finite number",
        )
    }
}

impl Spot {
    /// Returns the spot as a row of the `spots` array.
    pub fn row(&self) -> [f32; 7] {
        let ([x, y, z], [nx, ny, nz]) = (self.position, self.normal);
        [x, y, z, nx, ny, nz, self.path_m]
    }

    /// Parses a row of the `spots` array; `None` if the beam hits nothing.
    pub fn from_row(row: &[f32]) -> Option<Self> {
        (!row[0].is_nan()).then(|| Self {
            position: [row[0], row[1], row[2]],
            normal: [row[3], row[4], row[5]],
            path_m: row[6],
        })
    }
}

fn check_values<T: Copy + std::fmt::Display>(
    field: &str,
    values: &[T],
    valid: impl Fn(T) -> bool,
    expected: &str,
) -> Result<(), StorageError> {
    match values.iter().position(|x| !valid(*x)) {
        None => Ok(()),
        Some(at) => Err(StorageError::invalid(
            format!("record.{field}[{at}]"),
            format!("expected {expected}, found {}", values[at]),
        )),
    }
}
