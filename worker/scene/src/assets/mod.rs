//! Furniture: the sources of models, their properties, and a cache that all threads share.

mod catalogue;
mod category;
mod devices;
mod folder;
mod install;
mod materials;
mod obj;
mod parametric;
mod scan;
mod small;
mod storage;
mod upholstery;

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
    sync::{Arc, OnceLock},
};

use sha2::{Digest, Sha256};

use crate::{Mesh, SceneError, rng::Rng, trace::Model};
use catalogue::{Archive, Item};

pub use install::install;
pub use scan::{Scanned, scan};

/// Changes whenever a parametric model changes shape.
const PARAMETRIC_VERSION: &str = "parametric-1";
/// Changes whenever the import of a model's files gives other materials or another shape.
const READING: &str = "models-2";
/// The name of the library of a folder of glTF models.
const GLTF: &str = "gltf";
/// The name of the library of Sweet Home 3D's furniture.
const SWEETHOME3D: &str = "sweethome3d";

const INSTALL: &str = "run `picofarm assets install`";

/// The source of a model.
#[derive(Debug, Clone)]
enum Recipe {
    /// One of our own builders and the variant's seed.
    Built(parametric::Build, u64),
    /// An entry of a furniture library.
    Stored(Arc<Archive>, Item),
    /// A row of a folder's list.
    File(folder::Row),
}

/// A model ready for use, and the changes made to it.
#[derive(Debug)]
struct Loaded {
    model: Arc<Model>,
    made_opaque: bool,
    untextured: bool,
}

/// One piece of furniture of the library.
#[derive(Debug)]
pub(crate) struct Asset {
    /// The name, for people.
    pub(crate) name: String,
    /// The category, a name of [`crate::LABELS`].
    pub(crate) label: &'static str,
    /// The height of its bottom above the floor if it is fixed to a wall or the ceiling, metres.
    pub(crate) elevation: f32,
    /// The creator and licence, if they must be named.
    pub(crate) attribution: Option<String>,
    /// The width (x), height (y) and depth (z) in metres, if the catalogue gives them.
    pub(crate) size: Option<[f32; 3]>,
    recipe: Recipe,
    loaded: OnceLock<Option<Loaded>>,
}

/// A named set of furniture. Models are loaded when first used and then shared.
#[derive(Debug)]
pub struct AssetLibrary {
    name: &'static str,
    fingerprint: String,
    assets: Vec<Asset>,
    by_label: BTreeMap<&'static str, Vec<usize>>,
}

impl AssetLibrary {
    /// Returns our own furniture of boxes, cylinders and lathes, which needs no files.
    pub fn parametric() -> Self {
        let mut assets = Vec::new();
        for (label, variants, build) in parametric::catalogue() {
            for k in 0..variants {
                let seed = (assets.len() as u64) << 8;
                assets.push(Asset {
                    name: format!("{label} {k}"),
                    label,
                    elevation: 0.0,
                    attribution: None,
                    size: None,
                    recipe: Recipe::Built(build, seed),
                    loaded: OnceLock::new(),
                });
            }
        }
        Self::new("parametric", PARAMETRIC_VERSION.to_owned(), assets)
    }

    /// Opens Sweet Home 3D's furniture: the CC0 and CC BY items of every `.sh3f` file of `dir` that
    /// fit into rooms. Each model is read on first use and then cached.
    ///
    /// # Errors
    /// [`SceneError::Assets`] if the folder has none, [`SceneError::Read`] or
    /// [`SceneError::Format`] for a file that cannot be read.
    pub fn sweethome3d(dir: &Path) -> Result<Self, SceneError> {
        let files = install::libraries_in(dir);
        if files.is_empty() {
            return Err(SceneError::Assets {
                name: SWEETHOME3D.into(),
                looked: format!("no .sh3f file in {}", dir.display()),
                hint: INSTALL,
            });
        }
        let (mut assets, mut newest) = (Vec::new(), String::new());
        let mut hash = Sha256::new_with_prefix(READING);
        for file in files {
            let archive = Arc::new(Archive::open(&file)?);
            archive.fingerprint(&mut hash)?;
            let catalogue = archive.catalogue(obj::MAX_BYTES)?;
            newest = newest.max(catalogue.version);
            assets.extend(catalogue.items.into_iter().map(|item| Asset {
                name: item.name.clone(),
                label: item.label,
                elevation: item.elevation,
                attribution: Some(item.attribution.clone()),
                size: Some(item.size),
                recipe: Recipe::Stored(archive.clone(), item),
                loaded: OnceLock::new(),
            }));
        }
        let digest = hex::encode(hash.finalize());
        let fingerprint = format!("{SWEETHOME3D}-{newest}:{}", &digest[..16]);
        Ok(Self::new(SWEETHOME3D, fingerprint, assets))
    }

    /// Opens a folder of `.glb` models with their list, `assets.csv`. The list has the header
    /// `path,label,up,front,scale` and a line for each model: its file in the folder, a name of
    /// [`crate::LABELS`], the axes that point up and to the front (`x`, `-x`, … `-z`), and metres
    /// per unit. Columns `name`, `elevation` (metres above the floor, for objects fixed to a wall
    /// or ceiling) and `attribution` are optional; columns may be in any order. Each model is read
    /// on first use. Models that cannot be read or have more than 100,000 triangles are omitted.
    ///
    /// The fingerprint covers the list, and the length and the first and last 64 KiB of every
    /// model.
    ///
    /// # Errors
    /// [`SceneError::Assets`] if the folder has no list, [`SceneError::Read`] for a file that
    /// cannot be read, [`SceneError::Format`] naming file, line and column otherwise.
    pub fn gltf(dir: &Path) -> Result<Self, SceneError> {
        let list = folder::open(dir)?;
        let assets = list.rows.into_iter().map(|row| Asset {
            name: row.name.clone(),
            label: row.label,
            elevation: row.elevation,
            attribution: row.attribution.clone(),
            size: None,
            recipe: Recipe::File(row),
            loaded: OnceLock::new(),
        });
        let fingerprint = format!("{GLTF}:{}", list.digest);
        Ok(Self::new(GLTF, fingerprint, assets.collect()))
    }

    /// The names of the libraries.
    pub const NAMES: [&str; 3] = ["sweethome3d", "parametric", "gltf"];
    /// The libraries among which `auto` chooses, best first. A folder of a user's own models must
    /// be named explicitly.
    const AUTO: [&str; 2] = ["sweethome3d", "parametric"];

    /// Opens the library that a job's `assets` names: a name, a fingerprint, or `auto` for the best
    /// installed one. Files are searched as by [`Self::find`].
    ///
    /// # Errors
    /// As for [`Self::find`].
    pub fn named(name: &str, dirs: &[PathBuf]) -> Result<Self, SceneError> {
        if name == "auto" {
            for name in Self::AUTO {
                match Self::find(name, dirs) {
                    Err(SceneError::Assets { .. }) => {}
                    found => return found,
                }
            }
        }
        for known in Self::NAMES {
            if name != known && name.starts_with(known) {
                let library = Self::find(known, dirs)?;
                if library.fingerprint() == name {
                    return Ok(library);
                }
            }
        }
        Self::find(name, dirs)
    }

    /// Opens the library called `name` (`parametric`, `sweethome3d` or `gltf`). Files are searched
    /// in each of `dirs` and its subfolder of the library's name; those of Sweet Home 3D also in
    /// Debian's installation folder.
    ///
    /// # Errors
    /// [`SceneError::Assets`] if its files are in none of the folders, [`SceneError::Invalid`] for
    /// an unknown name; otherwise as for [`AssetLibrary::sweethome3d`].
    pub fn find(name: &str, dirs: &[PathBuf]) -> Result<Self, SceneError> {
        match name {
            "parametric" => Ok(Self::parametric()),
            SWEETHOME3D => {
                let system = Path::new("/").join(install::INSIDE_PACKAGE);
                let mut folders: Vec<PathBuf> = dirs
                    .iter()
                    .flat_map(|d| {
                        [
                            d.clone(),
                            d.join(install::FOLDER),
                            d.join(install::INSIDE_PACKAGE),
                        ]
                    })
                    .collect();
                folders.push(system);
                match folders
                    .iter()
                    .find(|f| !install::libraries_in(f).is_empty())
                {
                    Some(folder) => Self::sweethome3d(folder),
                    None => Err(SceneError::Assets {
                        name: name.into(),
                        looked: format!("no .sh3f file in {folders:?}"),
                        hint: INSTALL,
                    }),
                }
            }
            GLTF => {
                let folders: Vec<PathBuf> = dirs
                    .iter()
                    .flat_map(|d| [d.join(GLTF), d.clone()])
                    .collect();
                let found = folders.iter().find(|d| d.join(folder::LIST).is_file());
                found.map_or_else(
                    || {
                        Err(SceneError::Assets {
                            name: name.into(),
                            looked: format!("no {} in {folders:?}", folder::LIST),
                            hint: folder::WRITE,
                        })
                    },
                    |folder| Self::gltf(folder),
                )
            }
            other => Err(SceneError::Invalid {
                scene: "assets".into(),
                field: "assets".into(),
                what: format!(
                    "{other:?} is not known; use \"parametric\", \"{SWEETHOME3D}\" or \"{GLTF}\""
                ),
            }),
        }
    }

    fn new(name: &'static str, fingerprint: String, assets: Vec<Asset>) -> Self {
        let mut by_label: BTreeMap<_, Vec<usize>> = BTreeMap::new();
        for (k, asset) in assets.iter().enumerate() {
            by_label.entry(asset.label).or_default().push(k);
        }
        Self {
            name,
            fingerprint,
            assets,
            by_label,
        }
    }

    /// Returns the name by which jobs request this library.
    pub fn name(&self) -> &str {
        self.name
    }

    /// Returns a fingerprint of the exact set of assets, which is part of the input of a generated
    /// scene.
    pub fn fingerprint(&self) -> &str {
        &self.fingerprint
    }

    /// Returns the number of models.
    pub fn len(&self) -> usize {
        self.assets.len()
    }

    /// Returns whether the library has no models.
    pub fn is_empty(&self) -> bool {
        self.assets.is_empty()
    }

    /// Returns the first model of a category of our own furniture, in its own frame.
    pub(crate) fn first(&self, label: &str) -> Mesh {
        let asset = self.by_label.get(label).and_then(|of| of.first());
        let model = asset.and_then(|&k| self.assets[k].model());
        let model = model.expect("our own furniture has models of the categories that we ask for");
        (*model.mesh).clone()
    }

    /// Returns a random asset of a category with its model, if `fits` accepts its (width, height,
    /// depth) and elevation. Returns `None` if the category is empty or a few draws do not fit.
    pub(crate) fn draw(
        &self,
        rng: &mut Rng,
        label: &str,
        fits: impl Fn([f32; 3], f32) -> bool,
    ) -> Option<(&Asset, Arc<Model>)> {
        let candidates = self.by_label.get(label)?;
        for _ in 0..12 {
            let asset = &self.assets[*rng.pick(candidates)];
            // The catalogue's size avoids loading models that do not fit.
            if asset.size.is_some_and(|size| !fits(size, asset.elevation)) {
                continue;
            }
            if let Some(model) = asset.model()
                && fits(model.size(), asset.elevation)
            {
                return Some((asset, model));
            }
        }
        None
    }
}

impl Asset {
    /// Returns the model, loaded once, or `None` if it cannot be used (unreadable, empty or too
    /// many triangles).
    fn model(&self) -> Option<Arc<Model>> {
        self.loaded().map(|l| l.model.clone())
    }

    /// Returns the changes that made the model usable, for the scene's notes.
    pub(crate) fn changes(&self) -> impl Iterator<Item = &'static str> {
        let (opaque, plain) = self
            .loaded()
            .map_or((false, false), |l| (l.made_opaque, l.untextured));
        let opaque = opaque.then_some("transparent materials made opaque");
        opaque
            .into_iter()
            .chain(plain.then_some("textures left out"))
    }

    fn loaded(&self) -> Option<&Loaded> {
        let load = || {
            let (mesh, made_opaque, untextured) = match &self.recipe {
                Recipe::Built(build, seed) => (build(&mut Rng::new(*seed, 0)), false, false),
                Recipe::Stored(archive, item) => {
                    let l = obj::load(archive, item)?;
                    (l.mesh, l.made_opaque, l.untextured)
                }
                Recipe::File(row) => {
                    let (mesh, made_opaque) = folder::load(row)?;
                    (mesh, made_opaque, false)
                }
            };
            let model = Model::new(standing(mesh));
            if model.is_none() {
                tracing::warn!(
                    model = self.name,
                    "furniture model left out: no ray finds its triangles"
                );
            }
            Some(Loaded {
                model: Arc::new(model?),
                made_opaque,
                untextured,
            })
        };
        self.loaded.get_or_init(load).as_ref()
    }
}

/// Moves the mesh so that its bounding box is on y = 0, centred on the vertical axis.
fn standing(mut mesh: Mesh) -> Mesh {
    if let Some((lo, hi)) = mesh.bounds() {
        let mut offset = (lo + hi) * 0.5;
        offset.y = lo.y;
        for p in &mut mesh.positions {
            *p = *p - offset;
        }
    }
    mesh
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::LABELS;

    #[test]
    fn threads_share_a_library() {
        fn shared<T: Send + Sync>() {}
        shared::<AssetLibrary>();
    }

    #[test]
    fn every_parametric_model_stands_on_the_floor_and_has_a_plausible_size() {
        let library = AssetLibrary::parametric();
        for asset in &library.assets {
            let model = asset
                .model()
                .unwrap_or_else(|| panic!("{} is empty", asset.name));
            let [w, h, d] = model.size();
            assert!(LABELS.contains(&asset.label), "{}", asset.label);
            assert!(
                w.min(d) > 0.004 && w.max(d) < 2.6 && h > 0.004 && h < 2.3,
                "{}: {w} {h} {d}",
                asset.name
            );
            assert!(
                model.lo.y.abs() < 1e-6 && (model.lo.x + model.hi.x).abs() < 1e-5,
                "{}",
                asset.name
            );
            assert!(model.mesh.triangles.len() < 6000, "{}", asset.name);
            assert!(model.mesh.triangle_material.is_sorted());
        }
    }
}
