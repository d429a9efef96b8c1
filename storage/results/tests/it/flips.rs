//! Tests that every changed byte of a model's records is detected.

use std::collections::BTreeMap;
use std::sync::Arc;

use futures::TryStreamExt;
use object_store::memory::InMemory;
use object_store::path::Path;
use object_store::{ObjectStore, ObjectStoreExt};
use picofarm_results::*;
use picofarm_store::StorageError;
use serde_json::json;

type Objects = BTreeMap<String, Vec<u8>>;

async fn objects(store: &InMemory) -> Objects {
    let listed: Vec<_> = store.list(None).try_collect().await.unwrap();
    let mut all = Objects::new();
    for object in listed {
        let bytes = store.get(&object.location).await.unwrap().bytes().await;
        all.insert(object.location.to_string(), bytes.unwrap().to_vec());
    }
    all
}

#[tokio::test]
async fn changed_records_of_models_are_refused() {
    let memory = Arc::new(InMemory::new());
    let models = Models::new(memory.clone(), &Path::from("store"));
    let evaluation = Evaluation {
        predicts: String::new(),
        key: "k".into(),
        model: "m".into(),
        model_sha256: "0".repeat(64),
        dataset: "d".into(),
        data: "s".into(),
        split: SplitUsed {
            name: "default".into(),
            version: 1,
            sha256: "1".repeat(64),
        },
        side: "test".into(),
        scenes: 4,
        histogram: "transient".into(),
        sensor: false,
        times: String::new(),
        code: "c".into(),
        metrics: json!({"l1_m": 0.25}),
    };
    models.put_evaluation(&evaluation).await.unwrap();
    let speed = TrainingSpeed {
        training_key: "t".into(),
        samples_per_s: 2.5,
        data_wait_share: 0.1,
        threads: 2,
        gpu: None,
    };
    models.put_speed("m", &speed).await.unwrap();
    let trial = TrialRecord {
        sweep: "s".into(),
        id: "i".into(),
        index: 0,
        values: BTreeMap::new(),
        over: BTreeMap::new(),
        model: "m".into(),
        kind: "tof".into(),
        training_key: "t".into(),
        end: TrialEnd::Finished,
        epochs: 2,
        loss: Some(0.5),
        history: vec![json!({"epoch": 1})],
    };
    models.put_trial(&trial).await.unwrap();
    let rung = Rung {
        index: 0,
        epochs: 1,
        loss: 0.75,
    };
    models.put_rung("s", "i", &rung).await.unwrap();
    let read = async || {
        let found = (
            models.evaluation("m", "k").await?,
            models.speed("m", "t").await?,
            models.trials("s", "i").await?,
        );
        Ok::<_, StorageError>(found)
    };
    let before = read().await.unwrap();
    assert_eq!(before.0.as_ref(), Some(&evaluation));
    let all = objects(&memory).await;
    assert_eq!(all.len(), 4);
    for (key, bytes) in all {
        let path = Path::from(key.as_str());
        for at in 0..bytes.len() {
            let mut changed = bytes.clone();
            changed[at] ^= 1;
            memory.put(&path, changed.into()).await.unwrap();
            let said = match read().await {
                Err(error) => error.to_string(),
                Ok(found) => panic!("byte {at} of {key} changed unseen: {found:?}"),
            };
            assert!(said.contains(&key), "{said}");
        }
        memory.put(&path, bytes.into()).await.unwrap();
    }
}
