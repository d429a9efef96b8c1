//! Tests of checking, repairing and removing models: every flipped byte is found, restored objects
//! have the recorded SHA-256, and a removal killed at any point continues to the same end.

use crate::common;

use std::{
    collections::BTreeMap,
    panic::AssertUnwindSafe,
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering::SeqCst},
    },
};

use crate::pieces;
use bytes::Bytes;
use common::tricky::{Moment, Tricky};
use futures::{FutureExt, TryStreamExt};
use object_store::{ObjectStore, ObjectStoreExt, memory::InMemory, path::Path};
use picofarm_results::*;
use picofarm_store::published::Manifest as _;
use picofarm_store::*;
use serde_json::json;

const WEIGHTS: &[u8] = b"the weights of a network";

fn new_model(name: &str, key: &str, builds_on: &[(&str, String)]) -> NewModel {
    let models = builds_on
        .iter()
        .map(|(n, sha256)| ((*n).to_owned(), sha256.clone()));
    NewModel {
        manifest: ModelManifest {
            name: name.into(),
            kind: "tof".into(),
            training_key: key.into(),
            lineage: Lineage {
                models: models.collect(),
                ..Lineage::default()
            },
            ..ModelManifest::default()
        },
        objects: vec![
            ("weights.safetensors".into(), Bytes::from_static(WEIGHTS)),
            ("history.jsonl".into(), Bytes::from(format!("{key}\n"))),
        ],
    }
}

async fn put_evaluation(models: &Models, model: &ModelManifest) {
    let evaluation = Evaluation {
        predicts: String::new(),
        key: "e".into(),
        model: model.name.clone(),
        model_sha256: model.sha256(),
        dataset: "rooms".into(),
        data: "d".into(),
        split: SplitUsed::default(),
        side: "test".into(),
        scenes: 3,
        histogram: "transient".into(),
        sensor: false,
        times: String::new(),
        code: "model".into(),
        metrics: json!({"mae_m": 0.25}),
    };
    assert!(models.put_evaluation(&evaluation).await.unwrap());
    assert_eq!(models.evaluations(&model.name).await.unwrap(), [evaluation]);
}

/// Publishes a model with each kind of object: manifest, weights, history, an evaluation, a
/// checkpoint and a speed.
async fn whole(models: &Models) -> ModelManifest {
    let made = models
        .publish(new_model("m", "k", &[]), true)
        .await
        .unwrap()
        .manifest;
    put_evaluation(models, &made).await;
    let content = pieces(&[b"a checkpoint"]);
    models.put_checkpoint("m", "k", 5, content).await.unwrap();
    let speed = TrainingSpeed {
        training_key: "k".into(),
        samples_per_s: 2.0,
        data_wait_share: 0.5,
        threads: 2,
        gpu: None,
    };
    models.put_speed("m", &speed).await.unwrap();
    made
}

fn in_memory() -> (Arc<InMemory>, Models) {
    let memory = Arc::new(InMemory::new());
    let models = Models::new(memory.clone(), &Path::from("a/store"));
    (memory, models)
}

async fn objects(store: &InMemory) -> BTreeMap<String, Bytes> {
    let mut all = BTreeMap::new();
    for meta in store.list(None).try_collect::<Vec<_>>().await.unwrap() {
        let got = store.get(&meta.location).await.unwrap();
        all.insert(meta.location.to_string(), got.bytes().await.unwrap());
    }
    all
}

async fn put(store: &InMemory, at: &str, bytes: impl Into<Bytes>) {
    store
        .put(&Path::from(at), bytes.into().into())
        .await
        .unwrap();
}

#[tokio::test]
async fn every_flipped_cut_or_added_byte_and_every_missing_object_is_found() {
    let (store, models) = in_memory();
    whole(&models).await;
    let sound = models.verify("m").await.unwrap();
    assert!(sound.is_sound(), "{:?}", sound.problems);
    assert_eq!(
        (sound.objects, sound.evaluations, sound.checkpoints),
        (2, 1, 1)
    );
    for (at, bytes) in objects(&store).await {
        // The speed is not a result, and has no checksum.
        if at.ends_with("speed.json") {
            continue;
        }
        for byte in [
            0,
            bytes.len() / 3,
            bytes.len() / 2,
            bytes.len() - 2,
            bytes.len() - 1,
        ] {
            let mut flipped = bytes.to_vec();
            flipped[byte] ^= 1;
            put(&store, &at, flipped).await;
            let found = models.verify("m").await.unwrap();
            assert!(!found.is_sound(), "{at}: byte {byte}");
            assert!(
                found.problems.iter().any(|p| p.object.ends_with(&at)),
                "{at}: {:?}",
                found.problems
            );
        }
        for other in [
            bytes.slice(..bytes.len() - 1),
            Bytes::from([&bytes[..], b" "].concat()),
        ] {
            put(&store, &at, other).await;
            assert!(
                !models.verify("m").await.unwrap().is_sound(),
                "{at}: another length"
            );
        }
        let is_object = at.ends_with(".safetensors") || at.ends_with(".jsonl");
        store.delete(&Path::from(&*at)).await.unwrap();
        assert_eq!(
            !models.verify("m").await.unwrap().is_sound(),
            is_object,
            "{at} is missing"
        );
        put(&store, &at, bytes).await;
    }
    put(&store, "a/store/models/m/notes.txt", "mine").await;
    let found = models.verify("m").await.unwrap().problems;
    assert!(
        matches!(&found[..], [p] if p.fault == Fault::Foreign),
        "{found:?}"
    );
    let said = models.verify("nobody").await.unwrap_err().to_string();
    assert!(said.contains("there are: m"), "{said}");
}

#[tokio::test]
async fn what_is_damaged_is_not_adopted_and_training_again_puts_it_back() {
    let (store, models) = in_memory();
    whole(&models).await;
    let before = objects(&store).await;
    for file in ["weights.safetensors", "history.jsonl"] {
        let at = before.keys().find(|at| at.ends_with(file)).unwrap();
        for damaged in [
            None,
            Some(before[at].slice(1..)),
            Some(Bytes::from(vec![7; before[at].len()])),
        ] {
            match damaged {
                None => store.delete(&Path::from(&**at)).await.unwrap(),
                Some(bytes) => put(&store, at, bytes).await,
            }
            let found = models.finished("m", "k").await;
            assert!(
                matches!(found, Err(StorageError::Damaged { .. })),
                "{found:?}"
            );
            // Different bits, as from a GPU, restore nothing.
            let mut other = new_model("m", "k", &[]);
            other.objects[0].1 = Bytes::from_static(b"other bits");
            let said = models.publish(other, false).await;
            assert!(
                matches!(said, Err(StorageError::Damaged { .. })),
                "{said:?}"
            );
            models
                .publish(new_model("m", "k", &[]), false)
                .await
                .unwrap();
            assert_eq!(objects(&store).await, before);
        }
    }
}

#[tokio::test]
async fn repair_takes_only_bytes_of_the_recorded_hash_and_names_what_stays() {
    let (store, models) = in_memory();
    whole(&models).await;
    // The same weights, with another history.
    models
        .publish(new_model("twin", "other", &[]), true)
        .await
        .unwrap();
    let before = objects(&store).await;
    let at = |part: &str| {
        before
            .keys()
            .find(|at| at.contains("/m/") && at.contains(part))
            .unwrap()
            .clone()
    };
    for part in ["weights", "history", "evaluations", "checkpoints"] {
        let mut flipped = before[&at(part)].to_vec();
        flipped[1] ^= 1;
        put(&store, &at(part), flipped).await;
    }
    let broken = objects(&store).await;
    let wrong = Bytes::from_static(b"a history that it never had\n");
    let dry = models
        .repair("m", std::slice::from_ref(&wrong), true)
        .await
        .unwrap();
    assert_eq!(objects(&store).await, broken, "a dry run changes nothing");
    let done = models.repair("m", &[wrong], false).await.unwrap();
    assert_eq!(dry, done);
    assert!(
        matches!(&done.written[..], [w] if w.ends_with(&at("weights"))),
        "{done:?}"
    );
    assert_eq!(done.deleted.len(), 2, "{done:?}");
    assert!(
        matches!(&done.left[..], [p] if p.object.ends_with(&at("history"))),
        "{done:?}"
    );
    let now = objects(&store).await;
    assert_eq!(now[&at("weights")], before[&at("weights")]);
    assert_eq!(
        now[&at("history")],
        broken[&at("history")],
        "nothing is invented"
    );
    // With the correct bytes it is intact again, and a second run finds no problems.
    let right = before[&at("history")].clone();
    let done = models.repair("m", &[right], false).await.unwrap();
    assert!(done.left.is_empty() && done.written.len() == 1, "{done:?}");
    assert!(models.verify("m").await.unwrap().is_sound());
    assert_eq!(
        models.repair("m", &[], false).await.unwrap(),
        ModelRepair::default()
    );
}

#[tokio::test]
async fn who_builds_on_a_model_is_found() {
    let (store, models) = in_memory();
    let made = whole(&models).await;
    assert!(models.dependents("m").await.unwrap().is_empty());
    models
        .publish(new_model("n", "kn", &[("m", made.sha256())]), true)
        .await
        .unwrap();
    models
        .publish(new_model("p", "kp", &[("m", "of an older m".into())]), true)
        .await
        .unwrap();
    let spec = PredictionSpec {
        scenes: 2,
        height: 2,
        width: 2,
        depth: true,
        spots: vec![],
        specular: false,
        confidence: false,
        evidence: None,
    };
    for (group, model) in [("seen", "m"), ("others", "n")] {
        let prefix = Path::from("a/store").join(group);
        let there = Predictions::create_or_open(store.clone(), prefix, &spec)
            .await
            .unwrap();
        let used = ModelUsed {
            name: model.into(),
            manifest_sha256: models.manifest(model).await.unwrap().sha256(),
            histogram: "transient".into(),
            spots: vec![],
        };
        let manifest = PredictionManifest {
            scene: 1,
            task_key: "t".into(),
            models: [("tof".to_owned(), used)].into(),
            ..PredictionManifest::default()
        };
        let predicted = Predicted {
            depth_m: vec![1.0; 4],
            ..Predicted::default()
        };
        there
            .publish(&there.encode(manifest, &predicted).unwrap())
            .await
            .unwrap();
    }
    let found = models.dependents("m").await.unwrap();
    assert_eq!(found.models, ["n"]);
    assert_eq!(found.predictions, ["a/store/seen"]);
    // An unreadable manifest may depend on any model.
    put(&store, "a/store/models/p/manifest.json", "{").await;
    let found = models.dependents("m").await.unwrap();
    assert_eq!(found.models, ["n", "p (its manifest cannot be read)"]);
}

#[tokio::test]
async fn a_removal_killed_anywhere_goes_on_to_the_same_end() {
    let mut cut = 0;
    loop {
        let (memory, models) = in_memory();
        whole(&models).await;
        models
            .publish(new_model("n", "kn", &[]), true)
            .await
            .unwrap();
        // A checkpoint of another training under the name, which continues.
        models
            .put_checkpoint("m", "later", 1, pieces(&[b"c"]))
            .await
            .unwrap();
        let seen = Arc::new(AtomicUsize::new(0));
        let counted = seen.clone();
        let dying = Tricky::new(memory.clone()).acting(move |moment, _| {
            let now = counted.fetch_add(1, SeqCst);
            let dies = now == cut && moment != Moment::BeforePut;
            Box::pin(async move { assert!(!dies, "killed") })
        });
        let dying = Models::new(Arc::new(dying), &Path::from("a/store"));
        let killed = AssertUnwindSafe(dying.remove("m", false))
            .catch_unwind()
            .await
            .is_err();
        // A model either exists and is intact, or does not exist.
        let there = models.look("m").await.unwrap();
        let check = models.verify("m").await.unwrap();
        assert!(
            there.is_none() || check.problems.is_empty(),
            "cut {cut}: {:?}",
            check.problems
        );
        // If it was killed after the note was deleted, nothing is left to do.
        if killed && check.removing {
            models.remove("m", false).await.unwrap();
        }
        let left: Vec<String> = objects(&memory).await.into_keys().collect();
        let of_m: Vec<&String> = left.iter().filter(|at| at.contains("/m/")).collect();
        assert!(
            matches!(&of_m[..], [one] if one.contains("checkpoints/later")),
            "cut {cut}: {of_m:?}"
        );
        assert!(models.finished("n", "kn").await.unwrap().is_some());
        let again = models.remove("m", false).await.unwrap_err().to_string();
        assert!(again.contains("not trained to its end"), "{again}");
        if seen.load(SeqCst) <= cut {
            break;
        }
        cut += 1;
    }
    assert!(cut > 8, "{cut} moments");
}

#[tokio::test]
async fn a_model_that_is_trained_again_while_it_is_removed_keeps_its_objects() {
    let (memory, models) = in_memory();
    whole(&models).await;
    let (once, publisher) = (AtomicUsize::new(0), models.clone());
    let racing = Tricky::new(memory.clone()).acting(move |moment, path| {
        let publisher = publisher.clone();
        let now = moment == Moment::AfterDelete
            && path.as_ref().ends_with("manifest.json")
            && once.fetch_add(1, SeqCst) == 0;
        Box::pin(async move {
            if now {
                publisher
                    .publish(new_model("m", "k", &[]), true)
                    .await
                    .unwrap();
            }
        })
    });
    let racing = Models::new(Arc::new(racing), &Path::from("a/store"));
    racing.remove("m", false).await.unwrap();
    assert!(models.finished("m", "k").await.unwrap().is_some());
    assert!(models.verify("m").await.unwrap().is_sound());
}

#[tokio::test]
async fn a_model_that_is_still_trained_or_cannot_be_read_goes_only_by_force() {
    let (store, models) = in_memory();
    models
        .put_checkpoint("m", "k", 1, pieces(&[b"c"]))
        .await
        .unwrap();
    let said = models.remove("m", false).await.unwrap_err().to_string();
    assert!(said.contains("not trained to its end"), "{said}");
    assert_eq!(objects(&store).await.len(), 1);
    models.remove("m", true).await.unwrap();
    assert!(objects(&store).await.is_empty());
    whole(&models).await;
    put(&store, "a/store/models/m/manifest.json", "{\"format\": 1").await;
    let said = models.remove("m", false).await;
    assert!(
        matches!(said, Err(StorageError::Damaged { .. })),
        "{said:?}"
    );
    let removed = models.remove("m", true).await.unwrap();
    assert_eq!(removed.left, Vec::<String>::new());
    assert!(objects(&store).await.is_empty());
}

#[tokio::test]
async fn the_folder_that_a_removed_model_leaves_on_a_disk_is_no_model() {
    let dir = tempfile::tempdir().unwrap();
    let (store, prefix) = open_store(dir.path().to_str().unwrap()).unwrap();
    let models = Models::new(store, &prefix);
    whole(&models).await;
    assert_eq!(models.names().await.unwrap(), ["m"]);
    models.remove("m", false).await.unwrap();
    assert!(dir.path().join("models/m").is_dir());
    assert_eq!(models.names().await.unwrap(), Vec::<String>::new());
    let said = models.manifest("m").await.unwrap_err().to_string();
    assert!(said.contains("there are: none"), "{said}");
}
