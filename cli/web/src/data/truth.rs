//! The images of a scene.

use picofarm_dataset::{Dataset, DatasetSpec, Intrinsics, Manifest, Quantity as Q, Spot};
use picofarm_store::StorageError;
use serde_json::{Value, json};

use crate::answer::Problem;

/// Metres that light travels in a nanosecond.
pub const METRES_PER_NS: f64 = 0.299_792_458;

/// The ground truth of a scene. Images are `[row][column]`.
pub struct Truth {
    /// Properties of the data set.
    pub spec: DatasetSpec,
    /// sRGB, `[row][column][3]`.
    pub rgb: Vec<u8>,
    /// z-depth in metres; 0 = nothing.
    pub depth: Vec<f32>,
    /// Distance along the ray in metres; 0 = nothing.
    pub range: Vec<f32>,
    /// Unit normals in the camera frame, `[row][column][3]`.
    pub normal: Vec<f32>,
    /// Object + 1; 0 = nothing.
    pub instance: Vec<u32>,
    /// Label + 1; 0 = nothing.
    pub label: Vec<u16>,
    /// 1 = mirror.
    pub specular: Vec<u8>,
    /// 1 = lit, `[spot][row][column]`.
    pub visibility: Vec<u8>,
    /// Sum over bins of h.
    pub intensity: Vec<f32>,
    /// The spots, in the camera frame.
    pub spots: Vec<Option<Spot>>,
    /// Of the camera.
    pub intrinsics: Intrinsics,
    /// Names of the labels; empty if they are not known.
    pub names: Vec<String>,
    /// Who made it from what, and its objects.
    pub manifest: Manifest,
}

impl Truth {
    /// Reads the images of a scene.
    ///
    /// # Errors
    /// Fails if the scene is not there or is damaged.
    pub async fn read(dataset: &Dataset, scene: u64) -> Result<Self, StorageError> {
        let manifest = dataset.manifest(scene).await?;
        let names = manifest.provenance.plan["labels"].as_array();
        let names = names.into_iter().flatten();
        let names = names.map(|name| name.as_str().unwrap_or_default().to_owned());
        let names = names.collect();
        Ok(Self {
            spec: *dataset.spec(),
            rgb: dataset.read(scene, Q::Rgb).await?,
            depth: dataset.read(scene, Q::Depth).await?,
            range: dataset.read(scene, Q::Range).await?,
            normal: dataset.read_normal(scene).await?,
            instance: dataset.read(scene, Q::Instance).await?,
            label: dataset.read(scene, Q::Label).await?,
            specular: dataset.read(scene, Q::Specular).await?,
            visibility: dataset.read_visibility(scene).await?,
            intensity: dataset.read(scene, Q::Intensity).await?,
            spots: dataset.read_spots(scene).await?,
            intrinsics: dataset.read_intrinsics(scene).await?,
            names,
            manifest,
        })
    }

    /// Returns the size in memory.
    pub fn bytes(&self) -> usize {
        // The images of each pixel, of 3 + 4 + 4 + 12 + 4 + 2 + 1 + 4 bytes, and the masks.
        34 * self.spec.pixels() + self.visibility.len()
    }

    /// Returns the index of a pixel.
    ///
    /// # Errors
    /// Names the coordinate outside of the image.
    pub fn pixel(&self, [row, column]: [u64; 2]) -> Result<usize, Problem> {
        let limits = [
            ("row", row, self.spec.height),
            ("column", column, self.spec.width),
        ];
        for (name, value, limit) in limits {
            if value >= u64::from(limit) {
                let what = format!("{name}: expected a number below {limit}, found {value}");
                return Err(Problem::input(what));
            }
        }
        Ok(row as usize * self.spec.width as usize + column as usize)
    }

    /// Returns the surface point of a pixel's middle in the camera frame; `None` for nothing.
    pub fn point(&self, pixel: usize) -> Option<[f64; 3]> {
        let width = self.spec.width as usize;
        let (row, column) = (pixel / width, pixel % width);
        let z = f64::from(self.depth[pixel]);
        let i = &self.intrinsics;
        let direction = |pixel: usize, centre: f32, focal: f32| {
            (pixel as f64 + 0.5 - f64::from(centre)) / f64::from(focal)
        };
        (z > 0.0).then(|| {
            let (x, y) = (direction(column, i.cx, i.fx), direction(row, i.cy, i.fy));
            [z * x, z * y, z]
        })
    }

    /// Returns where a spot is in the image, in pixels; `None` behind the camera.
    pub fn film(&self, spot: &Spot) -> Option<[f32; 2]> {
        film(&self.intrinsics, spot)
    }

    /// Returns the spots that light a pixel.
    pub fn lit_by(&self, pixel: usize) -> Vec<usize> {
        let pixels = self.spec.pixels();
        let spots = 0..self.spots.len();
        spots
            .filter(|spot| self.visibility[spot * pixels + pixel] == 1)
            .collect()
    }

    /// Returns the values of a pixel.
    ///
    /// # Errors
    /// Fails outside of the image.
    pub fn values(&self, at: [u64; 2]) -> Result<Value, Problem> {
        let pixel = self.pixel(at)?;
        let label = self.label[pixel];
        let name = (label > 0).then(|| self.names.get(usize::from(label) - 1));
        let normal = &self.normal[3 * pixel..][..3];
        Ok(json!({
            "depth_m": self.depth[pixel], "range_m": self.range[pixel], "normal": normal,
            "instance": self.instance[pixel], "label": label, "label_name": name.flatten(),
            "mirror": self.specular[pixel] == 1, "intensity": self.intensity[pixel],
            "rgb": &self.rgb[3 * pixel..][..3], "lit_by": self.lit_by(pixel),
        }))
    }
}

fn film(i: &Intrinsics, spot: &Spot) -> Option<[f32; 2]> {
    let [x, y, z] = spot.position;
    (z > 0.0).then(|| [i.fx * x / z + i.cx, i.fy * y / z + i.cy])
}

/// Returns what the player of light in flight needs besides the volume.
///
/// # Errors
/// Fails if the scene is not there or is damaged.
pub async fn facts(dataset: &Dataset, scene: u64) -> Result<Value, StorageError> {
    let (spots, i) = (dataset.read_spots(scene), dataset.read_intrinsics(scene));
    let (spots, i) = futures::try_join!(spots, i)?;
    let spots = spots.iter().map(|spot| {
        let spot = spot.as_ref()?;
        Some(json!({"film": film(&i, spot), "path_m": spot.path_m}))
    });
    Ok(json!({"spots": spots.collect::<Vec<_>>()}))
}
