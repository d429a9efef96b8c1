//! Sharded evaluations: the figures are the same to the bit, whatever happens to the shards.

use crate::place;

use std::{path::PathBuf, sync::Arc};

use picofarm_proto::spec::{StageSpec, TaskSpec, kinds::EvaluateShardTask};
use picofarm_tasks::{Output, TaskError};
use serde_json::json;

use place::*;

/// An evaluation of the training side, which has five scenes.
fn evaluation(place: &Place, shards: u32) -> StageSpec {
    place.evaluation(json!({"models": ["m", "sh", "s"], "side": "train", "shards": shards}))
}

fn shards_of(evaluation: &StageSpec) -> StageSpec {
    let TaskSpec::Evaluate(whole) = evaluation.task.clone() else {
        panic!("an evaluation")
    };
    StageSpec::new(EvaluateShardTask { whole }.into())
}

/// Returns the names of the stored shards of three models.
fn left(place: &Place) -> Vec<PathBuf> {
    let files = place.files("models").into_keys();
    files
        .filter(|path| path.components().any(|c| c.as_os_str() == "shards"))
        .collect()
}

/// Returns the bytes of the stored evaluations.
fn found(place: &Place) -> Files {
    let files = place.files("models").into_iter();
    files
        .filter(|(path, _)| path.components().any(|c| c.as_os_str() == "evaluations"))
        .collect()
}

async fn forget(place: &Place) {
    for model in ["m", "sh", "s"] {
        let folder = place.dir.path().join(format!("models/{model}/evaluations"));
        std::fs::remove_dir_all(folder).unwrap();
    }
}

async fn run_one(stage: StageSpec, index: u64) -> Result<Output, TaskError> {
    run_at(stage, index, Arc::default()).await
}

async fn run_all(place: &Place, evaluation: &StageSpec, order: &[u64]) -> Vec<Output> {
    let mut outputs = Vec::new();
    for index in order {
        outputs.push(run_one(shards_of(evaluation), *index).await.unwrap());
    }
    assert!(!left(place).is_empty());
    outputs
}

#[tokio::test(flavor = "multi_thread")]
async fn figures_are_the_same_to_the_bit_over_1_2_and_7_shards_in_any_order() {
    let place = Place::new().await;
    place.train_all().await;
    run(evaluation(&place, 1)).await.unwrap();
    let whole = found(&place);
    assert_eq!(whole.len(), 3);
    for (shards, order) in [(2, vec![1, 0]), (7, vec![3, 0, 6, 2, 5, 1, 4])] {
        forget(&place).await;
        let stage = evaluation(&place, shards);
        let outputs = run_all(&place, &stage, &order).await;
        assert!(outputs.iter().all(|o| !o.adopted));
        let again = run_one(shards_of(&stage), 0).await.unwrap();
        assert!(again.adopted, "a shard that is there is not made again");
        assert_eq!(left(&place).len(), 3 * shards as usize);
        run(stage.clone()).await.unwrap();
        assert_eq!(found(&place), whole, "{shards} shards");
        assert_eq!(left(&place), [] as [PathBuf; 0], "shards are deleted");
        // A late shard task finds the evaluation and writes nothing.
        assert!(run_one(shards_of(&stage), 1).await.unwrap().adopted);
        assert_eq!(left(&place), [] as [PathBuf; 0]);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn shards_that_are_missing_damaged_or_of_another_scene_are_recomputed() {
    let place = Place::new().await;
    place.train_all().await;
    run(evaluation(&place, 1)).await.unwrap();
    let whole = found(&place);
    forget(&place).await;
    let stage = evaluation(&place, 3);
    run_all(&place, &stage, &[0, 1, 2]).await;
    let there = left(&place);
    assert_eq!(there.len(), 9);
    let at = |k: usize| place.dir.path().join("models").join(&there[k]);
    // Shards that are missing, truncated, corrupted, not packed at all, or another shard with the
    // same number of scenes (5 scenes in 3 shards are 1, 2, 2).
    std::fs::remove_file(at(0)).unwrap();
    let bytes = std::fs::read(at(1)).unwrap();
    std::fs::write(at(1), &bytes[..bytes.len() / 2]).unwrap();
    let mut bytes = std::fs::read(at(2)).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 4;
    std::fs::write(at(2), bytes).unwrap();
    std::fs::write(at(3), b"[]").unwrap();
    std::fs::copy(at(7), at(8)).unwrap();
    run(stage).await.unwrap();
    assert_eq!(found(&place), whole);
    assert_eq!(left(&place), [] as [PathBuf; 0]);
}
