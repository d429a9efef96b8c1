//! Scenes: read from files, generated, or made of arrays.

use std::{path::PathBuf, sync::Arc};

use numpy::{PyReadonlyArray2, PyUntypedArrayMethods};
use picofarm_scene::{
    Affine, Aim, AssetLibrary, Intrinsics, Material, Mesh, Object, Vec3,
    furnished::{self, FurnishedSettings},
    import::{self, Bounds, ImportOptions, View},
};
use picofarm_settings::{FloorPlan, Spots};
use pyo3::prelude::*;

use crate::errors::{self, argument};

/// A scene: objects, a camera and a laser. It never changes.
#[pyclass(frozen, module = "picofarm._native")]
pub(crate) struct Scene {
    pub(crate) scene: Arc<picofarm_scene::Scene>,
}

impl Scene {
    fn new(scene: picofarm_scene::Scene) -> PyResult<Self> {
        scene.validate().map_err(errors::scene)?;
        Ok(Self {
            scene: Arc::new(scene),
        })
    }
}

/// A mesh: vertices, triangles, colour, roughness of a mirror.
type MeshArrays<'py> = (
    PyReadonlyArray2<'py, f32>,
    PyReadonlyArray2<'py, u32>,
    [f32; 3],
    Option<f32>,
);

/// A camera: position, target, field of view in degrees, upward direction.
type ViewArguments = (
    Option<[f32; 3]>,
    Option<[f32; 3]>,
    Option<f32>,
    Option<[f32; 3]>,
);

#[pymethods]
impl Scene {
    /// Reads a scene file with a view of (look_from, look_at, fov, up).
    #[staticmethod]
    fn open(
        py: Python<'_>,
        path: PathBuf,
        camera: Option<String>,
        view: ViewArguments,
        spots: Option<&Bound<'_, PyAny>>,
        unit: Option<&str>,
        root: Option<PathBuf>,
    ) -> PyResult<Self> {
        let options = ImportOptions {
            view: self::view(camera, view)?,
            laser: spots.map(aim).transpose()?,
            unit: unit
                .map(|unit| unit.parse().map_err(|e: String| argument("unit", e)))
                .transpose()?,
            ..ImportOptions::default()
        };
        let bounds = Bounds {
            root: Some(root.unwrap_or_else(|| "/".into())),
            ..Bounds::default()
        };
        let read = py.detach(|| import::read_scene_with(&path, &options, &bounds));
        Self::new(read.map_err(errors::scene)?)
    }

    /// Generates the furnished room of a seed, with a library of furniture and a floor plan.
    #[staticmethod]
    fn furnished(
        py: Python<'_>,
        seed: u64,
        resolution: u32,
        spots: &Bound<'_, PyAny>,
        fov: f32,
        mirrors: u32,
        room: (String, String),
    ) -> PyResult<Self> {
        let (assets, floor_plan) = room;
        let floor_plan = match &*floor_plan {
            "box" => FloorPlan::Box,
            "varied" => FloorPlan::Varied,
            other => {
                let what = format!("{other:?}: expected box or varied");
                return Err(argument("floor_plan", what));
            }
        };
        let settings = FurnishedSettings {
            spots: self::spots(spots)?,
            width: resolution,
            height: resolution,
            fov_deg: fov,
            specular_at_least: mirrors,
            assets: assets.clone(),
            floor_plan,
            ..FurnishedSettings::default()
        };
        let scene = py.detach(|| {
            let library = AssetLibrary::find(&assets, &[])?;
            furnished::generate(seed, &settings, &library)
        });
        Self::new(scene.map_err(errors::scene)?)
    }

    /// Returns a scene of meshes: each of vertices `[n, 3]` in metres, triangles `[m, 3]`, linear
    /// RGB, and the roughness of a mirror or `None` for a diffuse surface.
    #[staticmethod]
    fn from_meshes(
        py: Python<'_>,
        meshes: Vec<MeshArrays<'_>>,
        view: ViewArguments,
        spots: &Bound<'_, PyAny>,
    ) -> PyResult<Self> {
        let mut objects = Vec::new();
        for (k, arrays) in meshes.iter().enumerate() {
            objects.push(Object {
                mesh: Arc::new(mesh(k, arrays)?),
                to_world: Affine::IDENTITY,
                label: 0,
                name: format!("mesh {k}"),
            });
        }
        let options = ImportOptions {
            view: self::view(None, view)?,
            laser: Some(aim(spots)?),
            ..ImportOptions::default()
        };
        let scene =
            py.detach(|| import::complete("arrays", objects, vec!["object".into()], &options));
        Self::new(scene.map_err(errors::scene)?)
    }

    /// Returns the scene with a camera elsewhere. `up` must not be along the view.
    fn seen_from(
        &self,
        look_from: [f32; 3],
        look_at: [f32; 3],
        fov: Option<f32>,
        up: [f32; 3],
    ) -> PyResult<Self> {
        let mut scene = (*self.scene).clone();
        let camera = &mut scene.camera;
        let (eye, up) = (Vec3::from(look_from), Vec3::from(up));
        let forward = (Vec3::from(look_at) - eye).normalized();
        let right = forward.cross(up).normalized();
        if !forward.is_finite() {
            return Err(argument("look_at", "expected another point than look_from"));
        }
        if !right.is_finite() {
            return Err(argument("up", "expected a direction across the view"));
        }
        let (right, down) = (right, forward.cross(right));
        (camera.origin, camera.forward) = (eye, forward);
        (camera.right, camera.down) = (right, down);
        if let Some(fov) = fov {
            if !(fov > 0.0 && fov < 180.0) {
                return Err(argument("fov", format!("expected 0 to 180, found {fov}")));
            }
            let i = &mut camera.intrinsics;
            *i = Intrinsics::from_fov(fov, i.width, i.height);
        }
        Self::new(scene)
    }

    /// Returns the scene with an image of another size.
    fn resized(&self, height: u32, width: u32) -> PyResult<Self> {
        let mut scene = (*self.scene).clone();
        let i = &mut scene.camera.intrinsics;
        *i = i.resized(width, height);
        Self::new(scene)
    }

    #[getter]
    fn name(&self) -> &str {
        &self.scene.name
    }

    /// Height and width of the image, pixels.
    #[getter]
    fn shape(&self) -> (u32, u32) {
        let i = &self.scene.camera.intrinsics;
        (i.height, i.width)
    }

    #[getter]
    fn triangles(&self) -> usize {
        self.scene.triangle_count()
    }

    #[getter]
    fn beams(&self) -> usize {
        self.scene.laser.beams.len()
    }

    /// Names of the objects.
    #[getter]
    fn objects(&self) -> Vec<&str> {
        self.scene.objects.iter().map(|o| &*o.name).collect()
    }

    /// Names of the categories of objects.
    #[getter]
    fn labels(&self) -> Vec<&str> {
        self.scene.labels.iter().map(|l| &**l).collect()
    }

    /// Camera, laser and provenance as JSON.
    fn facts(&self) -> String {
        let s = &self.scene;
        serde_json::json!({
            "camera": s.camera,
            "laser_origin": s.laser.origin,
            "provenance": s.provenance,
        })
        .to_string()
    }
}

fn view(camera: Option<String>, (from, at, fov, up): ViewArguments) -> PyResult<View> {
    let point = |name: &str, p: Option<[f32; 3]>| match p {
        Some(p) if p.iter().any(|x| !x.is_finite()) => {
            Err(argument(name, "expected three finite numbers"))
        }
        p => Ok(p.map(Vec3::from)),
    };
    if fov.is_some_and(|f| !(1.0..=170.0).contains(&f)) {
        return Err(argument("fov", "expected 1 to 170 degrees"));
    }
    Ok(View {
        camera,
        from: point("look_from", from)?,
        at: point("look_at", at)?,
        fov_deg: fov,
        up: point("up", up)?,
    })
}

/// Reads spots: a number for a grid, a text such as `random:16`, or positions (x, y).
fn spots(value: &Bound<'_, PyAny>) -> PyResult<Spots> {
    let spots = if let Ok(n) = value.extract::<u32>() {
        Spots::Grid(n)
    } else if let Ok(text) = value.extract::<String>() {
        text.parse().map_err(|e| argument("spots", e))?
    } else if let Ok(places) = value.extract::<Vec<[f64; 2]>>() {
        Spots::At(places)
    } else {
        return Err(argument(
            "spots",
            "expected a number (1, 4, 16, 25 or 100), a text such as \"random:16\", or a list of (x, y)",
        ));
    };
    spots.check().map_err(|e| argument("spots", e))?;
    Ok(spots)
}

fn aim(value: &Bound<'_, PyAny>) -> PyResult<Aim> {
    Aim::of(&spots(value)?, 0).map_err(|e| argument("spots", e))
}

fn mesh(k: usize, (vertices, triangles, rgb, mirror): &MeshArrays<'_>) -> PyResult<Mesh> {
    let field = |name: &str| format!("meshes[{k}].{name}");
    for (name, shape) in [
        ("vertices", vertices.shape()),
        ("triangles", triangles.shape()),
    ] {
        if shape[1] != 3 {
            let what = format!(
                "expected the shape (n, 3), found ({}, {})",
                shape[0], shape[1]
            );
            return Err(argument(&field(name), what));
        }
    }
    if rgb.iter().any(|x| !(0.0..=1.0).contains(x)) {
        return Err(argument(
            &field("rgb"),
            "expected three numbers from 0 to 1",
        ));
    }
    let rows = |name: &str| argument(&field(name), "the array must be contiguous");
    let positions: &[[f32; 3]] =
        bytemuck::cast_slice(vertices.as_slice().map_err(|_| rows("vertices"))?);
    let corners: &[[u32; 3]] =
        bytemuck::cast_slice(triangles.as_slice().map_err(|_| rows("triangles"))?);
    if let Some(at) = positions
        .iter()
        .position(|p| p.iter().any(|x| !x.is_finite()))
    {
        let what = format!("row {at} is {:?}; expected finite numbers", positions[at]);
        return Err(argument(&field("vertices"), what));
    }
    let n = positions.len();
    if let Some(at) = corners
        .iter()
        .position(|t| t.iter().any(|v| *v as usize >= n))
    {
        let what = format!("row {at} is {:?}, but there are {n} vertices", corners[at]);
        return Err(argument(&field("triangles"), what));
    }
    let material = match mirror {
        None => Material::diffuse("surface", *rgb),
        Some(alpha) => Material::mirror("mirror", *alpha),
    };
    Ok(Mesh {
        name: format!("mesh {k}"),
        positions: positions.iter().map(|p| Vec3::from(*p)).collect(),
        uv: vec![],
        triangles: corners.to_vec(),
        triangle_material: vec![0; corners.len()],
        materials: vec![material],
    })
}

/// Returns intrinsics as (fx, fy, cx, cy).
pub(crate) fn intrinsics(i: &Intrinsics) -> [f32; 4] {
    [i.fx, i.fy, i.cx, i.cy]
}
