//! Recipes of a data set, for regenerating its scenes: `recipes/<key>.json` or, if each scene has
//! its own source files, `recipes/<key>/<scene>.json`. They are create-only and never change; the
//! first writer wins. A recipe is proved by its output: the same task key, and the same bytes.

use futures::TryStreamExt;
use object_store::ObjectStore;
use serde_json::Value;

use crate::layout::group::pretty;
use crate::scenes::dataset::Dataset;
use picofarm_store::StorageError;
use picofarm_store::objects;
use picofarm_store::sealed::{seal, unseal};

/// Format version of recipes.
const FORMAT: u64 = 1;

/// A stored recipe.
#[derive(Debug, Clone, PartialEq)]
pub struct Recipe {
    /// The key under which it is stored.
    pub key: String,
    /// The only scene to which it applies.
    pub scene: Option<u64>,
    /// The recipe itself.
    pub content: Value,
    /// Its location for messages.
    pub place: String,
}

impl Dataset {
    /// Stores a recipe create-only. Returns `false` if there already is one.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn create_recipe(
        &self,
        key: &str,
        scene: Option<u64>,
        content: &Value,
    ) -> Result<bool, StorageError> {
        let path = self.path(&recipe_key(key, scene));
        // A recipe for all scenes usually exists already, and a lookup is cheaper than a write.
        if objects::size(&*self.store, &path).await?.is_some() {
            return Ok(false);
        }
        let sealed = seal(&pretty(
            &serde_json::json!({"format": FORMAT, "recipe": content}),
        ));
        objects::create(&*self.store, &path, sealed.into()).await
    }

    /// Returns the recipe of `scene` under `key`: its own, or the one for all scenes.
    ///
    /// # Errors
    /// [`StorageError::Damaged`], [`StorageError::Store`].
    pub async fn recipe(&self, key: &str, scene: u64) -> Result<Option<Recipe>, StorageError> {
        for scene in [Some(scene), None] {
            let path = self.path(&recipe_key(key, scene));
            let Some(bytes) = objects::get(&*self.store, &path).await? else {
                continue;
            };
            let place = self.shown(&path);
            let content = parse(&bytes).map_err(|what| StorageError::Damaged {
                object: place.clone(),
                what,
            })?;
            return Ok(Some(Recipe {
                key: key.to_owned(),
                scene,
                content,
                place,
            }));
        }
        Ok(None)
    }

    /// Returns the keys of all recipes, ascending.
    ///
    /// # Errors
    /// [`StorageError::Store`].
    pub async fn recipe_keys(&self) -> Result<Vec<String>, StorageError> {
        let folder = self.path("recipes");
        let failed = |e| StorageError::store("list", self.shown(&folder), e);
        let mut keys = std::collections::BTreeSet::new();
        let mut listed = self.store.list(Some(&folder));
        while let Some(object) = listed.try_next().await.map_err(failed)? {
            let name = self.relative(&object.location);
            if is_recipe(&name) {
                let key = name.split('/').nth(1).unwrap_or_default();
                keys.insert(key.trim_end_matches(".json").to_owned());
            }
        }
        Ok(keys.into_iter().collect())
    }
}

fn recipe_key(key: &str, scene: Option<u64>) -> String {
    match scene {
        None => format!("recipes/{key}.json"),
        Some(scene) => format!("recipes/{key}/{scene}.json"),
    }
}

/// Parses a stored recipe.
pub(crate) fn parse(bytes: &[u8]) -> Result<Value, String> {
    let sealed: Value = serde_json::from_slice(bytes).map_err(|e| format!("not JSON: {e}"))?;
    let checksum = sealed["checksum"].as_str().ok_or("it has no checksum")?;
    unseal(bytes, checksum)?;
    match sealed["format"].as_u64() {
        Some(FORMAT) if sealed["recipe"].is_object() => Ok(sealed["recipe"].clone()),
        Some(FORMAT) => Err("it holds no recipe".into()),
        Some(n) => Err(format!(
            "written in format {n}, this program knows {FORMAT}"
        )),
        None => Err("it has no format".into()),
    }
}

/// Returns whether a key relative to the data set belongs to a recipe.
pub(crate) fn is_recipe(key: &str) -> bool {
    let hex = |text: &str| text.len() == 64 && text.bytes().all(|b| b.is_ascii_hexdigit());
    let parts: Vec<&str> = key.split('/').collect();
    match parts[..] {
        ["recipes", file] => file.strip_suffix(".json").is_some_and(hex),
        ["recipes", key, file] => {
            let scene = file
                .strip_suffix(".json")
                .and_then(|s| s.parse::<u64>().ok());
            hex(key) && scene.is_some_and(|scene| file == format!("{scene}.json"))
        }
        _ => false,
    }
}
