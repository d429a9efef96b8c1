//! Checks that a store is safe for several writers.

use std::time::Duration;

use bytes::Bytes;
use futures::future::join_all;
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt};

use crate::error::StorageError;
use crate::objects;

/// Timeout for a store if nobody waits for the answer.
pub const PROBE_WITHIN: Duration = Duration::from_secs(30);
/// Timeout for deleting the probe's objects.
const DELETE_WITHIN: Duration = Duration::from_secs(5);
/// Number of concurrent writers.
const RACERS: usize = 16;
/// Number of attempts if an answer was lost.
const ATTEMPTS: usize = 3;
/// Prefix of the names of the probe's objects, which are next to the data sets.
pub const PROBE: &str = ".probe-";

/// The result of one attempt.
enum Finding {
    Safe,
    /// The violated guarantee.
    Broken(String),
    /// A put succeeded but its answer was lost, so its repetition was refused: this proves nothing.
    Unclear,
}

/// Checks the guarantee that publishing relies on: of several create-only puts to one key, exactly
/// one succeeds, and its bytes are retained. It tries sequential puts first, then sixteen
/// concurrent ones. It leaves no objects, even if the store does not answer `within` this time.
/// Only puts that a stalled server executes later remain, for a collector of garbage.
///
/// # Errors
/// [`StorageError::UnsafeStore`] names the violated guarantee; [`StorageError::Store`] if the store
/// refuses every request (read-only, full, no permission), loses answer after answer, or does not
/// answer in time.
pub async fn probe(
    store: &dyn ObjectStore,
    prefix: &Path,
    within: Duration,
) -> Result<(), StorageError> {
    let failed = |account: String| StorageError::Store {
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
        // The probe's own result takes precedence.
        let finding = result?;
        deleted?;
        match finding {
            Finding::Safe => return Ok(()),
            Finding::Broken(what) => {
                return Err(StorageError::UnsafeStore {
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

/// Deletes objects that may not exist. A failure does not prevent the other deletion.
async fn delete(store: &dyn ObjectStore, paths: [&Path; 2]) -> Result<(), StorageError> {
    let mut result = Ok(());
    for path in paths {
        match store.delete(path).await {
            Ok(()) | Err(object_store::Error::NotFound { .. }) => {}
            Err(e) => {
                result = result.and(Err(StorageError::store(
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
) -> Result<Finding, StorageError> {
    let broken = |what: &str| Ok(Finding::Broken(what.into()));
    // The body differs from any other writer's, so that a writer recognizes its own.
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
