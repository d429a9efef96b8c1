//! The data sets in the given stores. Nothing else is read.

use std::{
    collections::BTreeSet,
    path::PathBuf,
    sync::Arc,
    time::{Duration, Instant},
};

use object_store::{ObjectStore, path::Path};
use picofarm_dataset::Dataset;
use picofarm_results::Predicted;
use picofarm_store::{StorageError, open_store};
use tokio::sync::Mutex;

use super::{
    SceneId, Truth,
    cache::Cache,
    contents::Catalogue,
    light::{Light, has_parts},
    made::{Kind, Made},
    models::{Recent, StoreModels, Sweep},
    volume::Volume,
};
use crate::{App, answer::Problem};

/// Levels of folders below a store that are searched for data sets.
const DEPTH: usize = 2;
/// Most data sets and folders that are looked at in a store.
const MOST: usize = 400;
/// Time for which a list of data sets is used again.
const FRESH: Duration = Duration::from_secs(4);
/// Time for which a list serves to find results about a scene. Long lists take seconds.
const RECENT: Duration = Duration::from_secs(60);
/// Bytes of images in memory.
const IMAGES: usize = 192 << 20;
/// Bytes of predictions in memory.
const PREDICTIONS: usize = 32 << 20;
/// Bytes of volumes in memory.
const VOLUMES: usize = 320 << 20;

/// A store, a data set or a render that the user named.
struct Place {
    /// As the user named it.
    name: String,
    store: Arc<dyn ObjectStore>,
    prefix: Path,
    /// The folder, of a place on this machine.
    folder: Option<PathBuf>,
}

/// A data set that was found.
#[derive(Debug, Clone)]
pub struct DataSet {
    /// Its name in URLs: the position of its place, and the path below that.
    pub id: String,
    /// Its location for people.
    pub place: String,
    /// The data set.
    pub dataset: Dataset,
    /// Its finished scenes, ascending.
    pub scenes: Vec<u64>,
}

/// A store or a folder in it that cannot be read.
#[derive(Debug, Clone)]
pub struct Unread {
    /// Its name in URLs, as of a data set.
    pub id: String,
    /// Its location for people.
    pub place: String,
    /// Why.
    pub why: String,
    /// What the user can do.
    pub hint: Option<String>,
}

/// What there is in the stores.
#[derive(Debug, Default)]
pub struct Listing {
    /// The data sets.
    pub sets: Vec<DataSet>,
    /// Results about their scenes.
    pub made: Vec<Made>,
    /// Folders with models, which may have no data set.
    pub models: Vec<String>,
    /// What cannot be read.
    pub unread: Vec<Unread>,
}

/// The stores of a server, and what it has decoded of them.
pub struct Stores {
    places: Vec<Place>,
    listed: Mutex<Option<(Instant, Arc<Listing>)>>,
    truths: Cache<SceneId, Truth>,
    volumes: Cache<(SceneId, Light), Volume>,
    pub(super) catalogue: Catalogue,
    pub(super) recent_models: Recent<StoreModels>,
    pub(super) recent_sweeps: Recent<Sweep>,
    /// By the name of the group, and the task key of the scene's predictions.
    pub(super) predicted: Cache<(String, String), Predicted>,
}

impl Stores {
    /// Opens the stores, without reading them.
    ///
    /// # Errors
    /// Fails if a URL is not usable.
    pub fn open(names: &[String]) -> Result<Self, StorageError> {
        let open = |name: &String| {
            let (store, prefix) = open_store(name)?;
            let folder = (!name.contains("://")).then(|| PathBuf::from(name));
            Ok(Place {
                name: name.trim_end_matches('/').to_owned(),
                store,
                prefix,
                folder,
            })
        };
        Ok(Self {
            places: names
                .iter()
                .map(open)
                .collect::<Result<_, StorageError>>()?,
            listed: Mutex::default(),
            truths: Cache::new(IMAGES),
            volumes: Cache::new(VOLUMES),
            catalogue: Catalogue::default(),
            recent_models: Recent::default(),
            recent_sweeps: Recent::default(),
            predicted: Cache::new(PREDICTIONS),
        })
    }

    /// Returns the names of the stores.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.places.iter().map(|place| &*place.name)
    }

    /// Returns the folders that may have models: the named stores, and those with data sets or
    /// models.
    pub async fn folders(&self) -> BTreeSet<String> {
        let listed = self.list().await;
        let parents = listed.sets.iter().filter_map(|set| set.id.rsplit_once('/'));
        let parents = parents.map(|(parent, _)| parent.to_owned());
        let named = (0..self.places.len()).map(|position| position.to_string());
        let found = listed.models.iter().cloned();
        parents.chain(named).chain(found).collect()
    }

    /// Returns the data sets, and what cannot be read.
    pub async fn list(&self) -> Arc<Listing> {
        let mut listed = self.listed.lock().await;
        if let Some((at, sets)) = &*listed
            && at.elapsed() < FRESH
        {
            return Arc::clone(sets);
        }
        let mut found = Listing::default();
        for (position, place) in self.places.iter().enumerate() {
            place.search(position, &mut found).await;
        }
        let found = Arc::new(found);
        *listed = Some((Instant::now(), Arc::clone(&found)));
        found
    }

    /// Returns a list that may be a minute old.
    pub async fn recent(&self) -> Arc<Listing> {
        if let Some((at, sets)) = &*self.listed.lock().await
            && at.elapsed() < RECENT
        {
            return Arc::clone(sets);
        }
        self.list().await
    }

    /// Opens the data set of a URL.
    ///
    /// # Errors
    /// Fails if its name leads out of the stores, or if there is none.
    pub async fn dataset(&self, id: &str) -> Result<Dataset, Problem> {
        let (store, prefix) = self.open_at(id)?;
        Ok(Dataset::open(store, prefix).await?)
    }

    /// Returns the store and the folder in it that a URL names.
    ///
    /// # Errors
    /// Fails if the name leads out of the stores.
    pub fn open_at(&self, id: &str) -> Result<(Arc<dyn ObjectStore>, Path), Problem> {
        let (place, rest) = self.find(id)?;
        let parts = rest.split('/').filter(|part| !part.is_empty());
        let prefix = parts.fold(place.prefix.clone(), |prefix, part| prefix.join(part));
        Ok((Arc::clone(&place.store), prefix))
    }

    /// Returns the folder of a data set on this machine.
    ///
    /// # Errors
    /// Fails if the name leads out of the stores.
    pub fn folder(&self, id: &str) -> Result<Option<PathBuf>, Problem> {
        let (place, rest) = self.find(id)?;
        Ok(place.folder.as_ref().map(|folder| match rest {
            "" => folder.clone(),
            rest => folder.join(rest),
        }))
    }

    /// Returns the location of a data set for people, as the user named its store.
    ///
    /// # Errors
    /// Fails if the name leads out of the stores.
    pub fn place(&self, id: &str) -> Result<String, Problem> {
        let (place, rest) = self.find(id)?;
        Ok(match rest {
            "" => place.name.clone(),
            rest => format!("{}/{rest}", place.name),
        })
    }

    /// Returns the name in URLs of the data set at a location that a job names; `None` outside of
    /// the stores. The data set need not exist.
    pub fn locate(&self, store: &str, dataset: &str) -> Option<String> {
        let location = format!("{}/{dataset}", store.trim_end_matches('/'));
        let mut places = self.places.iter().enumerate();
        places.find_map(|(position, place)| {
            let base = match &place.folder {
                Some(folder) => std::path::absolute(folder).ok()?.display().to_string(),
                None => place.name.clone(),
            };
            let rest = location.strip_prefix(base.trim_end_matches('/'))?;
            (rest.is_empty() || rest.starts_with('/')).then(|| format!("{position}{rest}"))
        })
    }

    fn find<'a>(&self, id: &'a str) -> Result<(&Place, &'a str), Problem> {
        let missing = || Problem::missing(format!("there is no data set or store {id:?}"));
        let (position, rest) = id.split_once('/').unwrap_or((id, ""));
        let position: usize = position.parse().map_err(|_| missing())?;
        let place = self.places.get(position).ok_or_else(missing)?;
        let climbs = |part: &str| matches!(part, "" | "." | "..") || part.contains(['\\', '\0']);
        match !rest.is_empty() && rest.split('/').any(climbs) {
            true => Err(missing()),
            false => Ok((place, rest)),
        }
    }

    /// Returns the images of a scene.
    ///
    /// # Errors
    /// Fails if the scene cannot be read.
    pub async fn truth(&self, app: &App, id: &SceneId) -> Result<Arc<Truth>, Problem> {
        if let Some(truth) = self.truths.get(id) {
            return Ok(truth);
        }
        let _place = app.limits.images.acquire().await;
        if let Some(truth) = self.truths.get(id) {
            return Ok(truth);
        }
        let dataset = self.dataset(&id.set).await?;
        let truth = Arc::new(Truth::read(&dataset, id.scene).await?);
        // Damage may be repaired at any time.
        if truth.is_whole() {
            self.truths
                .insert(id.clone(), Arc::clone(&truth), truth.bytes());
        }
        Ok(truth)
    }

    /// Returns the volume of a scene.
    ///
    /// # Errors
    /// Fails if the scene has no such light or cannot be read.
    pub async fn volume(
        &self,
        app: &App,
        id: &SceneId,
        light: Light,
    ) -> Result<Arc<Volume>, Problem> {
        let key = (id.clone(), light);
        if let Some(volume) = self.volumes.get(&key) {
            return Ok(volume);
        }
        let _place = app.limits.volumes.acquire().await;
        // Another request may have read it meanwhile.
        if let Some(volume) = self.volumes.get(&key) {
            return Ok(volume);
        }
        let dataset = self.dataset(&id.set).await?;
        let folder = self.folder(&id.set)?;
        let volume = Arc::new(Volume::read(dataset, folder, id.scene, light).await?);
        self.volumes
            .insert(key, Arc::clone(&volume), volume.bytes());
        Ok(volume)
    }
}

impl Stores {
    /// Returns the light of two bounces, and that of three and more, of a render that has them
    /// apart; `None` otherwise.
    ///
    /// # Errors
    /// Fails if the scene cannot be read.
    pub async fn parts(
        &self,
        app: &App,
        id: &SceneId,
    ) -> Result<Option<[Arc<Volume>; 2]>, Problem> {
        let folder = self.folder(&id.set)?;
        if folder.as_deref().is_none_or(|folder| !has_parts(folder)) {
            return Ok(None);
        }
        let two = self.volume(app, id, Light::Two).await?;
        Ok(Some([two, self.volume(app, id, Light::More).await?]))
    }
}

impl Place {
    /// Adds the data sets of this place, itself or those in its folders, and what cannot be read.
    async fn search(&self, position: usize, found: &mut Listing) {
        let unread = |below: &str, problem: Problem| Unread {
            id: format!("{position}{below}"),
            place: format!("{}{below}", self.name),
            why: problem.message,
            hint: problem.hint,
        };
        if let Some(folder) = &self.folder
            && !folder.is_dir()
        {
            let missing = Problem::missing("there is no such folder");
            found.unread.push(unread("", missing));
            return;
        }
        let mut folders = vec![(self.prefix.clone(), String::new(), 0)];
        let mut looked = 0;
        while let Some((prefix, below, depth)) = folders.pop() {
            looked += 1;
            if looked > MOST {
                let what = format!("only the first {MOST} folders are searched");
                found.unread.push(unread("", Problem::input(what)));
                return;
            }
            match self.look(&prefix, &below, depth).await {
                Ok(Found::Set(dataset, scenes)) => found.sets.push(DataSet {
                    id: format!("{position}{below}"),
                    place: format!("{}{below}", self.name),
                    dataset,
                    scenes,
                }),
                Ok(Found::Made(kind)) => found.made.push(Made {
                    id: format!("{position}{below}"),
                    place: format!("{}{below}", self.name),
                    kind,
                }),
                // The last is looked at first.
                Ok(Found::Folders(inner)) => {
                    if inner.iter().any(|(_, name, _)| name.ends_with("/models")) {
                        found.models.push(format!("{position}{below}"));
                    }
                    folders.extend(inner.into_iter().rev());
                }
                Err(error) => found.unread.push(unread(&below, error.into())),
            }
        }
    }

    /// Looks at a folder: a data set, or the folders in it, ascending.
    async fn look(&self, prefix: &Path, below: &str, depth: usize) -> Result<Found, StorageError> {
        match Dataset::open(Arc::clone(&self.store), prefix.clone()).await {
            Ok(dataset) => {
                let scenes = dataset.scenes_present().await?;
                return Ok(Found::Set(dataset, scenes));
            }
            Err(StorageError::NoDataset { .. }) if depth < DEPTH => {}
            Err(StorageError::NoDataset { .. }) => return Ok(Found::Folders(Vec::new())),
            // Predictions and reconstructions. A data set's own fields begin with `spec.`.
            Err(StorageError::Invalid { field, .. }) if !field.starts_with("spec.") => {
                return Ok(match Kind::open(&self.store, prefix).await? {
                    Some(kind) => Found::Made(kind),
                    None => Found::Folders(Vec::new()),
                });
            }
            Err(error) => return Err(error),
        }
        let listed = self.store.list_with_delimiter(Some(prefix)).await;
        let listed = listed.map_err(|e| StorageError::store("list", prefix.to_string(), e))?;
        if Made::is_room(&listed.objects) {
            return Ok(Found::Made(Kind::Folder));
        }
        let mut inner: Vec<_> = listed
            .common_prefixes
            .into_iter()
            .filter_map(|path| {
                let name = path.filename()?.to_owned();
                let hidden = name.starts_with('.');
                (!hidden).then(|| (path, format!("{below}/{name}"), depth + 1))
            })
            .collect();
        inner.sort_by(|a, b| a.1.cmp(&b.1));
        Ok(Found::Folders(inner))
    }
}

/// What a folder is.
enum Found {
    /// A data set, with its finished scenes.
    Set(Dataset, Vec<u64>),
    /// Results about scenes.
    Made(Kind),
    /// Folders to look at: each with its path below the store and its depth.
    Folders(Vec<(Path, String, usize)>),
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_that_lead_out_of_the_stores_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let store = folder.path().display().to_string();
        let stores = Stores::open(std::slice::from_ref(&store)).unwrap();
        assert_eq!(
            stores.folder("0/a/b").unwrap(),
            Some(PathBuf::from(&store).join("a/b"))
        );
        assert_eq!(stores.locate(&store, "rooms"), Some("0/rooms".into()));
        let below = format!("{store}/a/");
        assert_eq!(stores.locate(&below, "b"), Some("0/a/b".into()));
        assert_eq!(stores.locate("/elsewhere", "rooms"), None);
        assert_eq!(stores.locate(&format!("{store}s"), "rooms"), None);
        for id in [
            "1",
            "",
            "x",
            "-1",
            "0/..",
            "0/../x",
            "0/a/../../x",
            "0//etc",
            "0/./a",
            "0/a\\..\\b",
            "/etc",
            "0/a/",
        ] {
            assert!(stores.folder(id).is_err(), "{id}");
        }
    }

    #[tokio::test]
    async fn a_store_without_data_sets_may_have_models() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir_all(folder.path().join("mine/models/net")).unwrap();
        std::fs::write(folder.path().join("mine/models/net/manifest.json"), "{}").unwrap();
        let stores = Stores::open(&[folder.path().display().to_string()]).unwrap();
        let found = stores.folders().await;
        assert_eq!(found, ["0", "0/mine"].map(str::to_owned).into());
    }
}
