//! A data set of very many scenes of a few bytes each: real objects under real keys with correct
//! manifests. They are written without the store, and hard-linked if the file system supports it,
//! so that the data set needs folders rather than bytes.

use std::{
    collections::BTreeMap,
    fs, io,
    path::{Path, PathBuf},
};

use picofarm_dataset::{
    Dataset, DatasetSpec, Gate, Intrinsics, Manifest, Profile, Provenance, SceneRecord, Subsets,
    Wavelength,
};
use picofarm_store::open_store;

use picofarm_cli::{
    dataset::failed,
    error::{CliError, Code, Result, io as io_error},
};

/// The data set.
pub struct Simulated {
    pub folder: PathBuf,
    manifest: Manifest,
    /// A file to link to, by the key without its scene.
    models: BTreeMap<String, PathBuf>,
    pub scenes: u64,
}

impl Simulated {
    /// Creates the data set with one properly published scene and capacity `room`.
    pub async fn start(folder: &Path, room: u64) -> Result<Self> {
        let spec = DatasetSpec {
            scenes: room,
            height: 1,
            width: 1,
            spots: 1,
            subsets: Subsets::NONE,
            per_spot: false,
            wavelengths_nm: Wavelength::NONE,
            two_bounce: false,
            gate: Gate {
                start_m: 1.0,
                bin_width_m: 0.0384,
                bins: 4,
            },
            profile: Profile::default(),
        };
        let (store, prefix) = open_store(&folder.display().to_string()).map_err(failed)?;
        let dataset = Dataset::create_or_open(store, prefix, &spec)
            .await
            .map_err(failed)?;
        let record = SceneRecord {
            transient: &[0.0, 1.0, 0.5, 0.25],
            subsets: &[],
            depth: &[1.0],
            range: &[1.0],
            normal: &[0.0, 0.0, -1.0],
            instance: &[1],
            label: &[1],
            specular: &[0],
            visibility: &[1],
            two_bounce: &[],
            rgb: &[0.5; 3],
            spots: &[None],
            intrinsics: Intrinsics {
                fx: 1.0,
                fy: 1.0,
                cx: 0.5,
                cy: 0.5,
            },
            camera: [[0.0; 4]; 4],
            laser: [0.0; 3],
            scale: 400.0,
        };
        let provenance = Provenance {
            task_key: "0".repeat(64),
            renderer: "simulated".into(),
            seed: 0,
            plan: serde_json::json!({"kind": "simulated"}),
        };
        let manifest = dataset.publish(0, &record, &provenance).await;
        Ok(Self {
            folder: folder.to_owned(),
            manifest: manifest.map_err(failed)?,
            models: BTreeMap::new(),
            scenes: 1,
        })
    }

    /// Adds a scene.
    pub fn add(&mut self) -> Result<()> {
        let scene = self.scenes;
        let mut manifest = self.manifest.clone();
        manifest.scene = scene;
        for object in &mut manifest.objects {
            let model = object.key.clone();
            object.key = renamed(&model, scene);
            let to = self.folder.join(&object.key);
            let parent = to.parent().unwrap_or(&self.folder);
            fs::create_dir_all(parent).map_err(|e| io_error(parent.display(), &e))?;
            let from = self
                .models
                .entry(model)
                .or_insert_with_key(|model| self.folder.join(model));
            match fs::hard_link(&*from, &to) {
                Ok(()) => {}
                // The file system does not support links, or no more links to this file.
                Err(e)
                    if matches!(
                        e.kind(),
                        io::ErrorKind::TooManyLinks
                            | io::ErrorKind::Unsupported
                            | io::ErrorKind::PermissionDenied
                    ) =>
                {
                    fs::copy(&*from, &to).map_err(|e| io_error(to.display(), &e))?;
                    *from = to;
                }
                Err(e) => return Err(io_error(to.display(), &e)),
            }
        }
        let path = self.folder.join(Manifest::key(scene));
        fs::write(&path, manifest.sealed().to_bytes()).map_err(|e| io_error(path.display(), &e))?;
        self.scenes += 1;
        Ok(())
    }

    /// Removes the manifest of the last scene, so that there is something to collect.
    pub fn orphan(&self) -> Result<PathBuf> {
        let path = self.folder.join(Manifest::key(self.scenes - 1));
        let away = self.folder.with_extension("orphan");
        fs::rename(&path, &away).map_err(|e| io_error(path.display(), &e))?;
        Ok(away)
    }

    /// Restores the manifest.
    pub fn adopt(&self, away: &Path) -> Result<()> {
        let path = self.folder.join(Manifest::key(self.scenes - 1));
        fs::rename(away, &path).map_err(|e| io_error(path.display(), &e))
    }
}

/// Converts the key of scene 0's object to another scene.
fn renamed(key: &str, scene: u64) -> String {
    let mut parts: Vec<&str> = key.split('/').collect();
    let number = scene.to_string();
    if let Some(part) = parts.get_mut(2) {
        *part = &number;
    }
    parts.join("/")
}

/// Checks that the folder is empty or does not exist.
pub fn empty(folder: &Path) -> Result<()> {
    match fs::read_dir(folder) {
        Err(e) if e.kind() == io::ErrorKind::NotFound => Ok(()),
        Err(e) => Err(io_error(folder.display(), &e)),
        Ok(mut entries) => match entries.next() {
            None => Ok(()),
            Some(_) => Err(CliError::new(
                Code::Input,
                format!(
                    "--dir: {} is not empty, and would be removed at the end",
                    folder.display()
                ),
            )
            .hint("name a folder that does not exist")),
        },
    }
}
