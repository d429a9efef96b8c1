//! Repairs broken scenes by making them again: from the data set's recipe, a job file, the data set
//! that they were reprocessed from, or the files that they were imported from. The task's key shows
//! whether the right inputs were used, and the manifest's hashes show whether the result is the
//! same.

pub(crate) mod recipe;
pub(crate) mod remade;

use std::path::PathBuf;

use picofarm_dataset::{
    Dataset, DatasetSpec, EncodedScene, Manifest, Recipe, Restored, remains, restore_root,
};
use picofarm_exchange::import::{Format, ImportOptions, Source, import_scene};
use picofarm_files::Opener;
use picofarm_proto::{
    key::{StageKey, TaskKey, stage_key},
    spec::{
        JobSpec, OutputSettings, RenderTask, ReprocessSettings, ReprocessTask, SourceSettings,
        TaskSpec,
    },
};
use picofarm_scene::AssetLibrary;
use picofarm_store::{StorageError, open_store};
use serde_json::Value;
use tokio::runtime::Handle;

use crate::{
    errors::dataset_error,
    input::scenes,
    making::{rendered, reprocessed},
    stores::{STORE_PATIENCE, Stores, dataset_spec},
    task::{Control, TaskError},
};

/// Information from the user on how the data set was made, in addition to its own recipes.
#[derive(Debug, Clone, Default)]
pub struct Hints {
    /// The job that made it.
    pub job: Option<JobSpec>,
    /// Current location of the data set that it was reprocessed from.
    pub source: Option<SourceSettings>,
    /// Current location of the files that it was imported from.
    pub files: Option<PathBuf>,
}

/// Repairs a data set.
pub struct Repairer {
    libraries: Vec<AssetLibrary>,
    stores: Stores,
    store: String,
    dataset: String,
    hints: Hints,
}

/// Whether the recipe of a rendering leads to the scene whose task has this key.
pub fn leads_to(recipe: &Recipe, scene: u64, task_key: &str) -> bool {
    match recipe::read(recipe, recipe::HERE, recipe::HERE) {
        Ok((stage, TaskSpec::Render(task))) => {
            recipe::made(&stage, &task, scene, task_key).is_some()
        }
        _ => false,
    }
}

/// How a scene is made.
#[derive(Debug)]
enum Origin {
    Render(StageKey, Box<RenderTask>),
    Reprocess(Box<ReprocessTask>),
    Import(PathBuf),
}

impl Repairer {
    /// Creates a repairer for the data set `dataset` in `store`. `runtime` serves store requests
    /// and must not own the thread that calls [`Self::run`].
    pub fn new(
        asset_dirs: &[PathBuf],
        runtime: Handle,
        store: &str,
        dataset: &str,
        hints: Hints,
    ) -> Self {
        Self {
            libraries: scenes::find_libraries(asset_dirs),
            stores: Stores::new(runtime, STORE_PATIENCE),
            store: store.to_owned(),
            dataset: dataset.to_owned(),
            hints,
        }
    }

    /// Makes a scene again and restores its broken objects. See [`Dataset::restore`]. Blocks, and
    /// computes on rayon's current pool.
    ///
    /// # Errors
    /// [`TaskError::User`] if it is unknown how the scene was made, or if the result differs.
    pub fn run(
        &self,
        scene: u64,
        witness: Option<&str>,
        control: &Control,
    ) -> Result<Restored, TaskError> {
        let dataset = self
            .stores
            .open_source(&self.store, &self.dataset, control)?;
        let manifest = self.manifest(&dataset, scene, control)?;
        let encoded = self.make(&dataset, scene, manifest.as_ref(), control)?;
        self.stores.wait(control, dataset.restore(encoded, witness))
    }

    /// Rewrites the root metadata of a data set that cannot be opened.
    ///
    /// # Errors
    /// [`TaskError::User`] if neither a recipe nor the job states the data set's properties, or if
    /// its arrays contradict them.
    pub fn restore_root(&self, control: &Control) -> Result<Dataset, TaskError> {
        let (store, prefix) = open_store(&self.store).map_err(dataset_error)?;
        let prefix = prefix.join(&*self.dataset);
        let left = self
            .stores
            .wait(control, remains(store.clone(), prefix.clone()))?;
        let stages = self.hints.job.iter().flat_map(|job| &job.stages);
        let mut tasks: Vec<_> = stages.map(|s| (stage_key(s), s.task.clone())).collect();
        // Hints from the user are not used unless a scene confirms them.
        if left.scene.is_none() {
            tasks.clear();
        }
        for stored in &left.recipes {
            tasks.push(recipe::read(stored, &self.store, &self.dataset)?);
        }
        let mut last = None;
        for (stage, task) in tasks {
            let Some(spec) = self.described(&task, control)? else {
                continue;
            };
            if let Some((scene, key)) = &left.scene {
                let (_, ours) = self.keyed(Some(stage), task, *scene, Some(key), control)?;
                if ours.to_string() != *key {
                    continue;
                }
            }
            let restored = restore_root(store.clone(), prefix.clone(), &spec);
            match self.stores.wait(control, restored) {
                Err(error @ (TaskError::User(_) | TaskError::Damaged(_))) => last = Some(error),
                other => return other,
            }
        }
        Err(last.unwrap_or_else(|| {
            TaskError::User(format!(
                "{}/{}: zarr.json is broken or missing, and no recipe leads to its scenes; check the location, or give \
                 the job file that made the data set with --job",
                self.store, self.dataset
            ))
        }))
    }

    /// Returns the properties of the data set that a task makes.
    fn described(
        &self,
        task: &TaskSpec,
        control: &Control,
    ) -> Result<Option<DatasetSpec>, TaskError> {
        match task {
            TaskSpec::Render(task) => dataset_spec(task).map(Some),
            TaskSpec::Reprocess(task) => {
                let place = self.hints.source.as_ref().unwrap_or(&task.source);
                let source = self
                    .stores
                    .open_source(&place.store, &place.dataset, control)?;
                let profile = &task.output.profile;
                reprocessed::target_spec(source.spec(), &task.reprocess, profile).map(Some)
            }
            _ => Ok(None),
        }
    }

    /// Describes in one line how the scene would be made, without making it.
    ///
    /// # Errors
    /// [`TaskError::User`] if this is unknown.
    pub fn explain(&self, scene: u64, control: &Control) -> Result<String, TaskError> {
        let dataset = self
            .stores
            .open_source(&self.store, &self.dataset, control)?;
        let manifest = self.manifest(&dataset, scene, control)?;
        let (origin, _) = self.origin(&dataset, scene, manifest.as_ref(), control)?;
        Ok(match origin {
            Origin::Render(key, _) => format!("rendered again, stage {key}"),
            Origin::Reprocess(task) => {
                let SourceSettings { store, dataset } = &task.source;
                format!("measured again from {store}/{dataset}")
            }
            Origin::Import(files) => format!("imported again from {}", files.display()),
        })
    }

    /// Reads the scene's manifest, if it is usable.
    fn manifest(
        &self,
        dataset: &Dataset,
        scene: u64,
        control: &Control,
    ) -> Result<Option<Manifest>, TaskError> {
        let read = async {
            match dataset.manifest(scene).await {
                Ok(manifest) => Ok(Some(manifest)),
                Err(StorageError::NotPublished { .. } | StorageError::Damaged { .. }) => Ok(None),
                Err(error) => Err(error),
            }
        };
        self.stores.wait(control, read)
    }

    fn make(
        &self,
        dataset: &Dataset,
        scene: u64,
        manifest: Option<&Manifest>,
        control: &Control,
    ) -> Result<EncodedScene, TaskError> {
        let (origin, key) = self.origin(dataset, scene, manifest, control)?;
        match origin {
            Origin::Render(_, task) => {
                let key = key.expect("a rendering has a key");
                rendered::make(
                    dataset,
                    (&self.libraries, &Opener::anywhere()),
                    &task,
                    scene,
                    &key,
                    control,
                )
            }
            Origin::Reprocess(task) => {
                let made = reprocessed::Reprocessing::open(&self.stores, &task, scene, control)?;
                made.encode(&self.stores, dataset, &task.reprocess, scene, control)
            }
            Origin::Import(files) => {
                let manifest = manifest.expect("an import is known by its manifest");
                import(dataset, scene, manifest, files)
            }
        }
    }

    /// Returns the origin to make the scene: the one with the manifest's key, or without a manifest
    /// the only candidate.
    fn origin(
        &self,
        dataset: &Dataset,
        scene: u64,
        manifest: Option<&Manifest>,
        control: &Control,
    ) -> Result<(Origin, Option<TaskKey>), TaskError> {
        let plan = manifest.map(|m| &m.provenance.plan);
        if plan.is_some_and(|plan| plan["kind"] == "import") {
            let files = self.hints.files.clone();
            let files = files.ok_or_else(|| imported(scene, plan.expect("just seen")))?;
            return Ok((Origin::Import(files), None));
        }
        let mut found: Vec<(Origin, TaskKey)> = Vec::new();
        let mut others: Vec<String> = Vec::new();
        let made_by = manifest.map(|m| &*m.provenance.task_key);
        for (stage, task) in self.candidates(dataset, scene, manifest, control)? {
            match self.keyed(stage, task, scene, made_by, control) {
                Ok((origin, key)) if found.iter().all(|(_, k)| *k != key) => {
                    found.push((origin, key))
                }
                Ok(_) => {}
                Err(TaskError::User(why) | TaskError::Damaged(why)) => others.push(why),
                Err(error) => return Err(error),
            }
        }
        let known = found.len();
        if let Some(key) = made_by {
            found.retain(|(_, k)| k.to_string() == key);
        }
        if found.len() == 1 {
            let (origin, key) = found.remove(0);
            return Ok((origin, Some(key)));
        }
        let why = match (manifest, known) {
            (Some(m), 1..) => format!(
                "it was made by the task {}, which is none of the {known} known ways",
                m.provenance.task_key
            ),
            (_, 0) => "the data set does not say how it was made (it is older than recipes, or they were deleted)".into(),
            (None, _) => format!("its manifest is broken or missing, and {known} recipes could have made it"),
        };
        let others = others.iter().map(|o| format!("; {o}")).collect::<String>();
        Err(TaskError::User(format!(
            "scene {scene}: {why}{others}; give the job file that made the data set with --job, or with --source the data \
             set that it was reprocessed from"
        )))
    }

    /// Returns all ways in which the scene may have been made.
    fn candidates(
        &self,
        dataset: &Dataset,
        scene: u64,
        manifest: Option<&Manifest>,
        control: &Control,
    ) -> Result<Vec<(Option<StageKey>, TaskSpec)>, TaskError> {
        let stages = self.hints.job.iter().flat_map(|job| &job.stages);
        let mut all: Vec<_> = stages
            .map(|s| (Some(stage_key(s)), s.task.clone()))
            .collect();
        for key in self.stores.wait(control, dataset.recipe_keys())? {
            let stored = self.stores.wait(control, dataset.recipe(&key, scene))?;
            let read = stored.map(|recipe| recipe::read(&recipe, &self.store, &self.dataset));
            if let Some((key, task)) = read.transpose()? {
                all.push((Some(key), task));
            }
        }
        if let (Some(manifest), Some(source)) = (manifest, &self.hints.source)
            && manifest.provenance.plan["kind"] == "reprocess"
        {
            all.push((None, self.reprocessed(manifest, source)?));
        }
        Ok(all)
    }

    /// Returns the reprocessing that a manifest describes.
    fn reprocessed(
        &self,
        manifest: &Manifest,
        source: &SourceSettings,
    ) -> Result<TaskSpec, TaskError> {
        let plan = &manifest.provenance.plan;
        let unusable = |e: serde_json::Error| {
            TaskError::User(format!("the manifest's provenance cannot be read: {e}"))
        };
        let histogram = serde_json::from_value(plan["histogram"].clone()).map_err(unusable)?;
        let mut settings = ReprocessSettings {
            histogram,
            sensor: serde_json::from_value(plan["sensor"].clone()).map_err(unusable)?,
            drop_left_over: plan["drop_left_over"] == true,
            // What was made once was allowed.
            on_counts: true,
            seed: plan["seed"].as_u64().unwrap_or_default(),
            version: manifest.provenance.renderer.clone(),
            spots: Vec::new(),
        };
        if plan["histogram"] == "transient_spots" {
            settings.spots = serde_json::from_value(plan["spots"].clone()).map_err(unusable)?;
        }
        Ok(TaskSpec::Reprocess(ReprocessTask {
            source: source.clone(),
            count: 1,
            reprocess: settings,
            output: OutputSettings {
                store: self.store.clone(),
                dataset: self.dataset.clone(),
                profile: manifest.profile.name().to_owned(),
            },
        }))
    }

    /// A candidate with the key of its task for `scene`; `made_by` is the key in the scene's
    /// manifest.
    fn keyed(
        &self,
        stage: Option<StageKey>,
        task: TaskSpec,
        scene: u64,
        made_by: Option<&str>,
        control: &Control,
    ) -> Result<(Origin, TaskKey), TaskError> {
        match task {
            TaskSpec::Render(task) => {
                let stage = stage.unwrap_or_else(|| task.stage_key());
                let key = match made_by.and_then(|key| recipe::made(&stage, &task, scene, key)) {
                    Some(key) => key,
                    None => rendered::scene_key(&task, scene)?,
                };
                Ok((Origin::Render(stage, Box::new(task)), key))
            }
            TaskSpec::Reprocess(mut task) => {
                if let Some(source) = &self.hints.source {
                    task.source = source.clone();
                }
                let made = reprocessed::Reprocessing::open(&self.stores, &task, scene, control)?;
                Ok((Origin::Reprocess(Box::new(task)), made.key))
            }
            other => Err(TaskError::User(format!(
                "the stage of kind {} makes no scenes",
                other.kind()
            ))),
        }
    }
}

/// Imports a scene from its files.
fn import(
    dataset: &Dataset,
    scene: u64,
    manifest: &Manifest,
    files: PathBuf,
) -> Result<EncodedScene, TaskError> {
    let plan = &manifest.provenance.plan;
    let user = |e: String| TaskError::User(format!("scene {scene}, imported: {e}"));
    let read = |field: &str| plan[field].clone();
    let format: Format = serde_json::from_value(read("format")).map_err(|e| user(e.to_string()))?;
    let options: ImportOptions =
        serde_json::from_value(read("options")).map_err(|e| user(e.to_string()))?;
    let name = plan["scene"].as_str().unwrap_or_default().to_owned();
    let source = Source::open(&files, Some(format), options, Some(&[name]))
        .map_err(|e| user(e.to_string()))?;
    let imported = import_scene(&source, 0).map_err(|e| user(e.to_string()))?;
    source
        .encode(dataset, scene, &imported)
        .map_err(|e| user(e.to_string()))
}

fn imported(scene: u64, plan: &Value) -> TaskError {
    let files = plan["files"].as_array();
    let names: Vec<&str> = files
        .into_iter()
        .flatten()
        .filter_map(|f| f["name"].as_str())
        .collect();
    TaskError::User(format!(
        "scene {scene} was imported ({}) from {}, which are not in the data set; give the folder that they lie in with \
         --files",
        plan["format"].as_str().unwrap_or("unknown format"),
        names.join(", ")
    ))
}
