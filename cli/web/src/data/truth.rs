//! The images of a scene.

use http::StatusCode;
use picofarm_dataset::{Dataset, DatasetSpec, Intrinsics, Manifest, Quantity as Q, Spot};
use picofarm_store::StorageError;
use serde_json::{Value, json};

use crate::answer::{DAMAGED, Problem};

/// Metres that light travels in a nanosecond.
pub const METRES_PER_NS: f64 = 0.299_792_458;

/// An array of a scene, or its error: one damaged array hides no other.
pub type Array<T> = Result<Vec<T>, Damage>;

/// A description of a damaged array.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Damage(pub String);

impl From<&Damage> for Problem {
    fn from(damage: &Damage) -> Self {
        Self {
            hint: Some(DAMAGED.into()),
            ..Self::new(StatusCode::INTERNAL_SERVER_ERROR, &damage.0)
        }
    }
}

impl Damage {
    /// Takes damage as a finding; other errors stay errors.
    fn found<T>(read: Result<T, StorageError>) -> Result<Result<T, Self>, StorageError> {
        match read {
            Ok(values) => Ok(Ok(values)),
            Err(error @ StorageError::Damaged { .. }) => Ok(Err(Self(error.to_string()))),
            Err(error) => Err(error),
        }
    }
}

/// The ground truth of a scene. Images are `[row][column]`.
pub struct Truth {
    /// Properties of the data set.
    pub spec: DatasetSpec,
    /// sRGB, `[row][column][3]`.
    pub rgb: Array<u8>,
    /// z-depth in metres; 0 = nothing.
    pub depth: Array<f32>,
    /// Distance along the ray in metres; 0 = nothing.
    pub range: Array<f32>,
    /// Unit normals in the camera frame, `[row][column][3]`.
    pub normal: Array<f32>,
    /// Object + 1; 0 = nothing.
    pub instance: Array<u32>,
    /// Label + 1; 0 = nothing.
    pub label: Array<u16>,
    /// 1 = mirror.
    pub specular: Array<u8>,
    /// 1 = lit, `[spot][row][column]`.
    pub visibility: Array<u8>,
    /// Sum over bins of h.
    pub intensity: Array<f32>,
    /// The spots, in the camera frame.
    pub spots: Array<Option<Spot>>,
    /// Of the camera.
    pub intrinsics: Result<Intrinsics, Damage>,
    /// Names of the labels; empty if they are not known.
    pub names: Vec<String>,
    /// Who made it from what, and its objects.
    pub manifest: Manifest,
}

impl Truth {
    /// Reads the images of a scene.
    ///
    /// # Errors
    /// Fails if the scene is not there, if its manifest is damaged, or if the store fails.
    pub async fn read(dataset: &Dataset, scene: u64) -> Result<Self, StorageError> {
        let manifest = dataset.manifest(scene).await?;
        let names = manifest.provenance.plan["labels"].as_array();
        let names = names.into_iter().flatten();
        let names = names.map(|name| name.as_str().unwrap_or_default().to_owned());
        let names = names.collect();
        Ok(Self {
            spec: *dataset.spec(),
            rgb: Damage::found(dataset.read(scene, Q::Rgb).await)?,
            depth: Damage::found(dataset.read(scene, Q::Depth).await)?,
            range: Damage::found(dataset.read(scene, Q::Range).await)?,
            normal: Damage::found(dataset.read_normal(scene).await)?,
            instance: Damage::found(dataset.read(scene, Q::Instance).await)?,
            label: Damage::found(dataset.read(scene, Q::Label).await)?,
            specular: Damage::found(dataset.read(scene, Q::Specular).await)?,
            visibility: Damage::found(dataset.read_visibility(scene).await)?,
            intensity: Damage::found(dataset.read(scene, Q::Intensity).await)?,
            spots: Damage::found(dataset.read_spots(scene).await)?,
            intrinsics: Damage::found(dataset.read_intrinsics(scene).await)?,
            names,
            manifest,
        })
    }

    /// Returns the size in memory.
    pub fn bytes(&self) -> usize {
        // The images of each pixel, of 3 + 4 + 4 + 12 + 4 + 2 + 1 + 4 bytes, and the masks.
        34 * self.spec.pixels() + self.visibility.as_ref().map_or(0, Vec::len)
    }

    /// Returns whether no array is damaged.
    pub fn is_whole(&self) -> bool {
        let bytes = [&self.rgb, &self.specular, &self.visibility];
        let numbers = [&self.depth, &self.range, &self.normal, &self.intensity];
        bytes.into_iter().all(Result::is_ok)
            && numbers.into_iter().all(Result::is_ok)
            && self.instance.is_ok()
            && self.label.is_ok()
            && self.spots.is_ok()
            && self.intrinsics.is_ok()
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
    ///
    /// # Errors
    /// Fails if the depth or the intrinsics are damaged.
    pub fn point(&self, pixel: usize) -> Result<Option<[f64; 3]>, &Damage> {
        self.point_at(pixel, self.depth.as_ref()?[pixel])
    }

    /// Returns the point of a pixel's middle at a z-depth in metres; `None` for 0.
    ///
    /// # Errors
    /// Fails if the intrinsics are damaged.
    pub fn point_at(&self, pixel: usize, depth: f32) -> Result<Option<[f64; 3]>, &Damage> {
        let width = self.spec.width as usize;
        let (row, column) = (pixel / width, pixel % width);
        let z = f64::from(depth);
        let i = self.intrinsics.as_ref()?;
        let direction = |pixel: usize, centre: f32, focal: f32| {
            (pixel as f64 + 0.5 - f64::from(centre)) / f64::from(focal)
        };
        Ok((z > 0.0).then(|| {
            let (x, y) = (direction(column, i.cx, i.fx), direction(row, i.cy, i.fy));
            [z * x, z * y, z]
        }))
    }

    /// Returns where a spot is in the image, in pixels; `None` behind the camera.
    ///
    /// # Errors
    /// Fails if the intrinsics are damaged.
    pub fn film(&self, spot: &Spot) -> Result<Option<[f32; 2]>, &Damage> {
        Ok(film(self.intrinsics.as_ref()?, spot))
    }

    /// Returns the spots that light a pixel.
    ///
    /// # Errors
    /// Fails if the masks are damaged.
    pub fn lit_by(&self, pixel: usize) -> Result<Vec<usize>, &Damage> {
        let masks = self.visibility.as_ref()?.chunks(self.spec.pixels().max(1));
        let lit = masks.enumerate().filter(|(_, mask)| mask[pixel] == 1);
        Ok(lit.map(|(spot, _)| spot).collect())
    }

    /// Returns the values of a pixel; those of damaged arrays are null.
    ///
    /// # Errors
    /// Fails outside of the image.
    pub fn values(&self, at: [u64; 2]) -> Result<Value, Problem> {
        let pixel = self.pixel(at)?;
        let label = value(&self.label, pixel);
        let named = label.filter(|label| *label > 0);
        let name = named.and_then(|label| self.names.get(usize::from(label) - 1));
        let mirror = value(&self.specular, pixel).map(|specular| specular == 1);
        Ok(json!({
            "depth_m": value(&self.depth, pixel), "range_m": value(&self.range, pixel),
            "normal": self.normal.as_ref().ok().map(|normal| &normal[3 * pixel..][..3]),
            "instance": value(&self.instance, pixel), "label": label, "label_name": name,
            "mirror": mirror, "intensity": value(&self.intensity, pixel),
            "rgb": self.rgb.as_ref().ok().map(|rgb| &rgb[3 * pixel..][..3]),
            "lit_by": self.lit_by(pixel).ok(),
        }))
    }
}

/// The value of a pixel; `None` if the array is damaged.
fn value<T: Copy>(array: &Array<T>, pixel: usize) -> Option<T> {
    array.as_ref().ok().map(|values| values[pixel])
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
    let laser = dataset.read::<f32>(scene, Q::Laser);
    let camera = dataset.read::<f32>(scene, Q::Camera);
    let (spots, i, laser, camera) = futures::try_join!(spots, i, laser, camera)?;
    let spec = dataset.spec();
    let spots = spots.iter().map(|spot| {
        let spot = spot.as_ref()?;
        Some(json!({
            "film": film(&i, spot), "path_m": spot.path_m, "position": spot.position,
        }))
    });
    Ok(json!({
        "spots": spots.collect::<Vec<_>>(), "laser": laser,
        "intrinsics": [i.fx, i.fy, i.cx, i.cy], "size": [spec.width, spec.height],
        // The world's y axis in the camera's frame: the second row of the rotation to the world.
        "up": camera.get(4..7),
    }))
}
