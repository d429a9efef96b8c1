//! Tests of stored models: published models are retained despite the leftovers of killed trainings,
//! torn or damaged checkpoints are skipped, and collection deletes only unneeded objects.

use crate::common;

use std::{path::PathBuf, sync::Arc, time::Duration};

use crate::pieces;
use bytes::Bytes;
use object_store::{ObjectStore, memory::InMemory, path::Path};
use picofarm_dataset::*;
use picofarm_results::*;
use picofarm_store::published::Manifest as _;
use picofarm_store::*;
use proptest::prelude::*;
use serde_json::json;

const NOW: Duration = Duration::ZERO;

fn local() -> (tempfile::TempDir, Models) {
    let dir = tempfile::tempdir().unwrap();
    let (store, prefix) = open_store(dir.path().to_str().unwrap()).unwrap();
    (dir, Models::new(store, &prefix))
}

fn model(name: &str, key: &str, weights: &'static [u8]) -> NewModel {
    let lineage = Lineage {
        promoted: None,
        dataset: "rooms".into(),
        seed: 7,
        ..Lineage::default()
    };
    let settings = json!({"target": "tof", "seed": 7});
    let metrics = json!({"mae_m": 0.02, "loss": 0.01});
    NewModel {
        manifest: ModelManifest {
            name: name.into(),
            kind: "tof".into(),
            training_key: key.into(),
            settings,
            lineage,
            metrics,
            ..ModelManifest::default()
        },
        objects: vec![
            ("weights.safetensors".into(), Bytes::from_static(weights)),
            ("history.jsonl".into(), Bytes::from_static(b"{}\n")),
        ],
    }
}

fn files(dir: &std::path::Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    let mut folders = vec![dir.to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            match path.is_dir() {
                true => folders.push(path),
                false => found.push(path),
            }
        }
    }
    found.sort();
    found
}

#[tokio::test]
async fn a_model_comes_back_as_it_was_published_and_twice_is_once() {
    let (dir, models) = local();
    assert_eq!(models.finished("m", "k").await.unwrap(), None);
    let first = models.publish(model("m", "k", b"w"), false).await.unwrap();
    let before = files(dir.path());
    let again = models.publish(model("m", "k", b"w"), true).await.unwrap();
    assert_eq!((&again.manifest, again.adopted), (&first.manifest, false));
    assert_eq!(files(dir.path()), before);
    let found = models.finished("m", "k").await.unwrap().unwrap();
    assert_eq!(found, first.manifest);
    assert_eq!(found.lineage.seed, 7);
    assert_eq!(found.total_bytes(), 4);
    let weights = models.read(&found, "weights.safetensors").await.unwrap();
    assert_eq!(&weights[..], b"w");
    assert_eq!(models.names().await.unwrap(), ["m"]);
    let manifest = std::fs::read(dir.path().join("models/m/manifest.json")).unwrap();
    assert_eq!(found.sha256(), sha256_hex(&manifest));
}

#[tokio::test]
async fn a_name_is_one_trainings_and_its_other_bits_are_adopted_or_an_alarm() {
    let (dir, models) = local();
    let first = models.publish(model("m", "k", b"w"), false).await.unwrap();
    let before = files(dir.path());
    let other = models.publish(model("m", "other", b"x"), false).await;
    let said = other.unwrap_err().to_string();
    assert!(said.contains("choose another name"), "{said}");
    assert!(models.finished("m", "other").await.is_err());
    let bits = models.publish(model("m", "k", b"x"), false).await.unwrap();
    assert_eq!((bits.manifest, bits.adopted), (first.manifest, true));
    let exact = models.publish(model("m", "k", b"x"), true).await;
    assert!(
        matches!(exact, Err(StorageError::Conflict { .. })),
        "{exact:?}"
    );
    // Nothing of the losers remains except, after the alarm, the evidence.
    let mut after = files(dir.path());
    after.retain(|path| !before.contains(path));
    assert_eq!(after.len(), 2, "{after:?}");
}

#[tokio::test]
async fn what_a_killed_training_left_is_in_nobodys_way() {
    let (dir, models) = local();
    // Objects of other settings and of the same ones, without a manifest, and an unfinished file of
    // a manifest.
    models
        .publish(model("m", "other", b"x"), false)
        .await
        .unwrap();
    models.publish(model("n", "k", b"w"), false).await.unwrap();
    for name in ["m", "n"] {
        std::fs::remove_file(dir.path().join(format!("models/{name}/manifest.json"))).unwrap();
    }
    models
        .put_checkpoint("m", "other", 5, pieces(&[b"5"]))
        .await
        .unwrap();
    std::fs::write(dir.path().join("models/m/manifest.json#1"), b"{").unwrap();
    assert_eq!(models.newest_checkpoint("m", "k").await.unwrap(), None);
    for name in ["m", "n"] {
        let published = models.publish(model(name, "k", b"w"), true).await.unwrap();
        assert!(!published.adopted);
        assert!(models.finished(name, "k").await.unwrap().is_some());
    }
}

#[tokio::test]
async fn a_missing_object_is_named_and_publishing_again_puts_it_back() {
    let (dir, models) = local();
    let found = models
        .publish(model("m", "k", b"w"), false)
        .await
        .unwrap()
        .manifest;
    let object = found.object("weights.safetensors").unwrap();
    let path = dir.path().join("models/m").join(&object.key);
    std::fs::remove_file(&path).unwrap();
    let said = models.finished("m", "k").await.unwrap_err().to_string();
    assert!(said.contains("weights.safetensors"), "{said}");
    models.publish(model("m", "k", b"w"), true).await.unwrap();
    assert!(models.finished("m", "k").await.unwrap().is_some());
    std::fs::write(&path, b"v").unwrap();
    assert!(models.read(&found, "weights.safetensors").await.is_err());
    let manifest = dir.path().join("models/m/manifest.json");
    let text = std::fs::read_to_string(&manifest).unwrap();
    std::fs::write(&manifest, text.replace("0.02", "0.01")).unwrap();
    assert!(matches!(
        models.look("m").await,
        Err(StorageError::Damaged { .. })
    ));
}

#[tokio::test]
async fn who_asks_for_a_model_that_is_not_there_hears_which_are() {
    let (_dir, models) = local();
    let said = models.manifest("m").await.unwrap_err().to_string();
    assert!(said.contains("there are: none"), "{said}");
    models.publish(model("a", "k", b"w"), false).await.unwrap();
    models
        .put_checkpoint("m", "k", 5, pieces(&[b"5"]))
        .await
        .unwrap();
    let said = models.manifest("x").await.unwrap_err().to_string();
    assert!(said.contains("no \"x\"; there are: a"), "{said}");
    let said = models.manifest("m").await.unwrap_err().to_string();
    assert!(said.contains("not trained to its end"), "{said}");
    assert!(models.manifest("../m").await.is_err());
}

#[tokio::test]
async fn the_newest_two_checkpoints_are_kept_and_none_after_the_end() {
    let (dir, models) = local();
    for step in [10, 20, 30, 1_000_000_000_000] {
        let content = pieces(&[format!("at {step}").as_bytes()]);
        models
            .put_checkpoint("m", "k", step, content)
            .await
            .unwrap();
    }
    models
        .put_checkpoint("m", "other", 1, pieces(&[b""]))
        .await
        .unwrap();
    let steps: Vec<u64> = models
        .checkpoints("m")
        .await
        .unwrap()
        .iter()
        .map(|c| c.step)
        .collect();
    assert_eq!(steps, [30, 1_000_000_000_000, 1]);
    // A slow worker deletes nothing of a worker at a later step.
    models
        .put_checkpoint("m", "k", 25, pieces(&[b""]))
        .await
        .unwrap();
    let newest = models.newest_checkpoint("m", "k").await.unwrap().unwrap();
    assert_eq!((newest.0, newest.1.len()), (1_000_000_000_000, 1));
    assert_eq!(newest.1[0], "at 1000000000000");
    models.delete_checkpoints("m", "k").await.unwrap();
    assert_eq!(models.newest_checkpoint("m", "k").await.unwrap(), None);
    let left = files(dir.path());
    assert_eq!(left.len(), 1, "{left:?}");
}

#[tokio::test]
async fn a_damaged_checkpoint_is_replaced_and_a_whole_one_stands() {
    let (dir, models) = local();
    let put = |content: &'static [u8]| models.put_checkpoint("m", "k", 7, pieces(&[content]));
    put(b"first").await.unwrap();
    put(b"other").await.unwrap();
    assert_eq!(
        models.newest_checkpoint("m", "k").await.unwrap().unwrap().1,
        ["first"]
    );
    let path = files(dir.path()).pop().unwrap();
    std::fs::write(path, b"torn").unwrap();
    put(b"other").await.unwrap();
    assert_eq!(
        models.newest_checkpoint("m", "k").await.unwrap().unwrap().1,
        ["other"]
    );
}

#[tokio::test]
async fn a_checkpoint_in_pieces_counts_when_its_head_lies_there_and_each_piece_is_whole() {
    let (dir, models) = local();
    let many: Vec<Vec<u8>> = (0..9u8).map(|i| vec![i; 100 + usize::from(i)]).collect();
    let many: Vec<&[u8]> = many.iter().map(Vec::as_slice).collect();
    let newest = async || models.newest_checkpoint("m", "k").await.unwrap();
    let put = async |step| {
        let put = models.put_checkpoint("m", "k", step, pieces(&many));
        put.await.unwrap();
    };
    put(3).await;
    put(7).await;
    let (step, found) = newest().await.unwrap();
    assert!(step == 7 && found == many);
    assert_eq!(files(dir.path()).len(), 18);
    assert_eq!(models.verify("m").await.unwrap().checkpoints, 2);
    // If any of its objects is damaged or missing, the previous checkpoint is used, the check
    // reports it, and writing it again repairs it.
    let of_7 = |path: &&PathBuf| path.to_str().unwrap().contains("/000000000007.");
    for path in files(dir.path()).iter().filter(of_7) {
        for gone in [false, true] {
            let was = std::fs::read(path).unwrap();
            match gone {
                true => std::fs::remove_file(path).unwrap(),
                false => std::fs::write(path, [&was[1..], b"x"].concat()).unwrap(),
            }
            assert_eq!(newest().await.unwrap().0, 3, "{path:?}");
            let check = models.verify("m").await.unwrap();
            let head_gone = gone && path.extension().unwrap() == "ckpt";
            assert_eq!(check.problems.len(), usize::from(!head_gone), "{path:?}");
            assert_eq!(
                check.unused.len(),
                if head_gone { 8 } else { 0 },
                "{path:?}"
            );
            put(7).await;
            let (step, found) = newest().await.unwrap();
            assert!(step == 7 && found == many, "{path:?}");
        }
    }
    // The write was interrupted before the head: it is not taken for a checkpoint, and the next one
    // deletes it.
    put(9).await;
    let head = files(dir.path())
        .into_iter()
        .find(|path| path.ends_with("000000000009.ckpt"));
    std::fs::remove_file(head.unwrap()).unwrap();
    assert_eq!(newest().await.unwrap().0, 7);
    let listed = models.checkpoints("m").await.unwrap();
    let listed: Vec<(u64, bool)> = listed.iter().map(|c| (c.step, c.finished)).collect();
    assert_eq!(listed, [(7, true), (9, false)]);
    put(11).await;
    put(12).await;
    let left = models.checkpoints("m").await.unwrap();
    assert_eq!(left.iter().map(|c| c.step).collect::<Vec<_>>(), [11, 12]);
    models.delete_checkpoints("m", "k").await.unwrap();
    assert_eq!(files(dir.path()), Vec::<PathBuf>::new());
}

#[tokio::test]
async fn collection_takes_what_nobody_needs_and_leaves_the_rest() {
    let dir = tempfile::tempdir().unwrap();
    let (store, prefix) = open_store(dir.path().to_str().unwrap()).unwrap();
    let models = Models::new(store.clone(), &prefix);
    let spec = common::spec(Profile::LOSSLESS);
    let dataset = Dataset::create_or_open(store, prefix.join("rooms"), &spec)
        .await
        .unwrap();
    models.publish(model("m", "k", b"w"), false).await.unwrap();
    models
        .publish(model("gone", "k", b"w"), false)
        .await
        .unwrap();
    std::fs::remove_file(dir.path().join("models/gone/manifest.json")).unwrap();
    models
        .put_checkpoint("m", "old", 7, pieces(&[b"a", b"b"]))
        .await
        .unwrap();
    std::fs::write(dir.path().join("models/m/notes.txt"), b"mine").unwrap();
    let young = collect_garbage(&dataset, MIN_GRACE, true).await.unwrap();
    assert_eq!(young.orphans, []);
    let found = collect_garbage(&dataset, NOW, false).await.unwrap();
    assert_eq!(found.orphans.len(), 4);
    assert_eq!(
        found
            .orphans
            .iter()
            .filter(|o| o.cause == OrphanCause::Checkpoint)
            .count(),
        2
    );
    assert_eq!(
        found
            .orphans
            .iter()
            .filter(|o| o.cause == OrphanCause::Model)
            .count(),
        2
    );
    collect_garbage(&dataset, NOW, true).await.unwrap();
    assert!(models.finished("m", "k").await.unwrap().is_some());
    assert_eq!(models.checkpoints("m").await.unwrap(), []);
    assert!(dir.path().join("models/m/notes.txt").exists());
    assert_eq!(
        collect_garbage(&dataset, NOW, true).await.unwrap().orphans,
        []
    );
}

#[tokio::test]
async fn an_evaluation_stands_beside_its_model() {
    let (_dir, models) = local();
    let evaluation = Evaluation {
        predicts: String::new(),
        key: "ab".into(),
        model: "m".into(),
        model_sha256: "cd".into(),
        dataset: "rooms".into(),
        data: "ef".into(),
        split: SplitUsed::default(),
        side: "test".into(),
        scenes: 3,
        histogram: "transient".into(),
        sensor: false,
        times: String::new(),
        code: "v".into(),
        metrics: json!({"mae_m": 0.5}),
    };
    assert!(models.put_evaluation(&evaluation).await.unwrap());
    assert!(!models.put_evaluation(&evaluation).await.unwrap());
    assert_eq!(models.evaluations("m").await.unwrap(), [evaluation]);
}

#[tokio::test]
async fn a_pin_is_the_id_of_a_snapshot_of_the_scenes() {
    let spec = common::spec(Profile::LOSSLESS);
    let (_, dataset) = common::in_memory(&spec).await;
    for scene in [0, 2, 3] {
        let made = common::Scene::new(&spec, scene);
        dataset
            .publish(scene, &made.record(), &common::provenance())
            .await
            .unwrap();
    }
    let all = dataset.present(&|_, _| {}).await.unwrap();
    assert_eq!(dataset.pin(&[0, 2, 3]).await.unwrap().id, all.id());
    assert_ne!(dataset.pin(&[0, 3]).await.unwrap().id, all.id());
    let missing = dataset.pin(&[0, 1]).await.unwrap_err().to_string();
    assert!(missing.contains("scene 1"), "{missing}");
}

/// Damage to the files of checkpoints.
#[derive(Debug, Clone)]
enum Harm {
    None,
    Cut(prop::sample::Index),
    Flip(prop::sample::Index, u8),
}

fn harm() -> impl Strategy<Value = Harm> {
    prop_oneof![
        Just(Harm::None),
        any::<prop::sample::Index>().prop_map(Harm::Cut),
        (any::<prop::sample::Index>(), 1..=255u8).prop_map(|(at, bits)| Harm::Flip(at, bits)),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, ..ProptestConfig::default() })]

    #[test]
    fn the_newest_checkpoint_that_is_whole_is_found_whatever_became_of_the_others(
        steps in prop::collection::btree_map(0u64..1000, (prop::collection::vec(any::<u8>(), 0..40), harm()), 1..5),
    ) {
        let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
        let store: Arc<dyn ObjectStore> = Arc::new(InMemory::new());
        // The checkpoints are written by independent workers, each into a separate store, so that
        // none deletes older ones.
        let mut expected = None;
        for (step, (content, harm)) in &steps {
            let own: Arc<dyn ObjectStore> = Arc::new(InMemory::new());
            let models = Models::new(own.clone(), &Path::from("s"));
            runtime.block_on(models.put_checkpoint("m", "k", *step, pieces(&[content]))).unwrap();
            let path = Path::from(format!("s/models/m/checkpoints/k/{step:012}.ckpt"));
            let mut bytes = runtime.block_on(async { own.get_opts(&path, Default::default()).await.unwrap().bytes().await }).unwrap().to_vec();
            match harm {
                Harm::None => expected = Some((*step, vec![Bytes::from(content.clone())])),
                Harm::Cut(at) => { let at = at.index(bytes.len()); bytes.truncate(at); }
                Harm::Flip(at, bits) => { let at = at.index(bytes.len()); bytes[at] ^= bits; }
            }
            runtime.block_on(store.put_opts(&path, bytes.into(), Default::default())).unwrap();
        }
        let models = Models::new(store, &Path::from("s"));
        prop_assert_eq!(runtime.block_on(models.newest_checkpoint("m", "k")).unwrap(), expected);
    }
}
