//! The check that a store is safe for several writers.

use bytes::Bytes;
use futures::future::join_all;
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt};

use crate::error::DatasetError;
use crate::objects;

/// Writers racing.
const RACERS: usize = 16;
/// Repetitions when an answer was lost on the way.
const ATTEMPTS: usize = 3;
/// What the probe's objects are called, beside the data sets.
pub(crate) const PROBE: &str = ".probe-";

/// What an attempt found.
enum Finding {
    Safe,
    /// The promise that was broken.
    Broken(String),
    /// A put succeeded, but its answer was lost, so that its repetition was refused: nothing is shown either way.
    Unclear,
}

/// Checks that the store keeps the promise on which publishing rests: of several create-only puts to one key exactly
/// one succeeds, and its bytes stay. One after the other, then sixteen at once. Leaves nothing behind.
///
/// # Errors
/// [`DatasetError::UnsafeStore`] says which promise was broken; [`DatasetError::Store`] where the store refuses
/// altogether (read-only, full, no permission) or loses answer after answer.
pub async fn probe(store: &dyn ObjectStore, prefix: &Path) -> Result<(), DatasetError> {
    for _ in 0..ATTEMPTS {
        let id = uuid::Uuid::new_v4();
        let name = |part: &str| prefix.clone().join(format!("{PROBE}{id}-{part}"));
        let (sequential, race) = (name("sequential"), name("race"));
        let result = probe_at(store, &sequential, &race).await;
        for path in [&sequential, &race] {
            match store.delete(path).await {
                Ok(()) | Err(object_store::Error::NotFound { .. }) => {}
                // The probe's own finding comes first.
                Err(e) if result.is_ok() => {
                    return Err(DatasetError::store(
                        "delete",
                        objects::shown(store, path),
                        e,
                    ));
                }
                Err(_) => {}
            }
        }
        match result? {
            Finding::Safe => return Ok(()),
            Finding::Broken(what) => {
                return Err(DatasetError::UnsafeStore {
                    prefix: objects::shown(store, prefix),
                    what,
                });
            }
            Finding::Unclear => {}
        }
    }
    Err(DatasetError::Store {
        action: "probe",
        object: objects::shown(store, prefix),
        hint: None,
        account: format!(
            "answers to writes were lost {ATTEMPTS} times in a row, so it could not be shown to be safe"
        ),
    })
}

async fn probe_at(
    store: &dyn ObjectStore,
    sequential: &Path,
    race: &Path,
) -> Result<Finding, DatasetError> {
    let broken = |what: &str| Ok(Finding::Broken(what.into()));
    // Told apart from any other writer's, so that one can recognise one's own.
    let body = |i: usize| Bytes::from(format!("writer {i:02} of {sequential}\n").repeat(64));
    if !objects::create(store, sequential, body(0)).await? {
        return match objects::get(store, sequential).await? {
            Some(stored) if stored == body(0) => Ok(Finding::Unclear),
            _ => broken("a create-only put to a new key was refused"),
        };
    }
    if objects::create(store, sequential, body(1)).await? {
        return broken("a create-only put to an existing key succeeded");
    }
    if objects::get(store, sequential).await? != Some(body(0)) {
        return broken("a refused create-only put changed the object");
    }
    let racers = (0..RACERS).map(|i| objects::create(store, race, body(i)));
    let mut winners = Vec::new();
    for (i, won) in join_all(racers).await.into_iter().enumerate() {
        if won? {
            winners.push(i);
        }
    }
    let stored = objects::get(store, race).await?;
    match winners[..] {
        [winner] if stored == Some(body(winner)) => Ok(Finding::Safe),
        [_] => broken("the object does not hold the bytes of the put that succeeded"),
        [] if (0..RACERS).any(|i| stored == Some(body(i))) => Ok(Finding::Unclear),
        _ => Ok(Finding::Broken(format!(
            "{} of {RACERS} simultaneous create-only puts to one key succeeded, exactly one should",
            winners.len()
        ))),
    }
}
