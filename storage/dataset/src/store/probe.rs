//! The check that a store is safe for several writers.

use std::time::Duration;

use bytes::Bytes;
use futures::future::join_all;
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt};

use crate::error::DatasetError;
use crate::store::objects;

/// Longest that a store is waited for, where nobody waits for the answer.
pub const PROBE_WITHIN: Duration = Duration::from_secs(30);
/// Longest that deleting the probe's objects is waited for.
const DELETE_WITHIN: Duration = Duration::from_secs(5);
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
/// one succeeds, and its bytes stay. One after the other, then sixteen at once. Leaves nothing behind, also where the store
/// does not answer `within` that time; only puts that a stalled server carries out later stay, for
/// [`crate::Dataset::collect`].
///
/// # Errors
/// [`DatasetError::UnsafeStore`] says which promise was broken; [`DatasetError::Store`] where the store refuses
/// altogether (read-only, full, no permission), loses answer after answer or does not answer in time.
pub async fn probe(
    store: &dyn ObjectStore,
    prefix: &Path,
    within: Duration,
) -> Result<(), DatasetError> {
    let failed = |account: String| DatasetError::Store {
        action: "probe",
        object: objects::shown(store, prefix),
        hint: None,
        account,
    };
    let end = tokio::time::Instant::now() + within;
    for _ in 0..ATTEMPTS {
        let id = uuid::Uuid::new_v4();
        let name = |part: &str| prefix.clone().join(format!("{PROBE}{id}-{part}"));
        let (sequential, race) = (name("sequential"), name("race"));
        let answer = tokio::time::timeout_at(end, probe_at(store, &sequential, &race)).await;
        let result = answer.unwrap_or_else(|_| {
            let seconds = within.as_secs_f64();
            Err(failed(format!("it did not answer within {seconds} s")))
        });
        let deleted = tokio::time::timeout(DELETE_WITHIN, delete(store, [&sequential, &race]));
        let deleted = deleted.await.unwrap_or_else(|_| {
            let seconds = DELETE_WITHIN.as_secs();
            Err(failed(format!("it did not delete within {seconds} s")))
        });
        // The probe's own finding comes first.
        let finding = result?;
        deleted?;
        match finding {
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
    Err(failed(format!(
        "answers to writes were lost {ATTEMPTS} times in a row, so it could not be shown to be safe"
    )))
}

/// Deletes objects that may not be there, each of them whatever becomes of the others.
async fn delete(store: &dyn ObjectStore, paths: [&Path; 2]) -> Result<(), DatasetError> {
    let mut result = Ok(());
    for path in paths {
        match store.delete(path).await {
            Ok(()) | Err(object_store::Error::NotFound { .. }) => {}
            Err(e) => {
                result = result.and(Err(DatasetError::store(
                    "delete",
                    objects::shown(store, path),
                    e,
                )));
            }
        }
    }
    result
}

async fn probe_at(
    store: &dyn ObjectStore,
    sequential: &Path,
    race: &Path,
) -> Result<Finding, DatasetError> {
    let broken = |what: &str| Ok(Finding::Broken(what.into()));
    // Different from any other writer's, so that one can recognise one's own.
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
