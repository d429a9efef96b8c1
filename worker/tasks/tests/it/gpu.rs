//! Stages that request a GPU: training, inference and evaluation work there as on the CPU. Tests
//! every device that the drivers list, including software devices.
#![cfg(any(feature = "cuda", feature = "wgpu"))]

use crate::place;

use std::sync::Arc;

use picofarm_model::device::{Gpus, gpus};
use picofarm_proto::spec::{Resources, StageSpec};
use picofarm_results::Predictions;
use picofarm_store::open_store;
use picofarm_tasks::{Output, TaskError};
use serde_json::json;

use place::*;

/// Returns all GPUs that the drivers list. Prints a message if there are none.
fn listed() -> Vec<String> {
    let listed: Vec<String> = gpus().iter().map(|gpu| gpu.id().to_owned()).collect();
    if listed.is_empty() {
        eprintln!("SKIPPED graphics processors: no driver lists any (Debian: mesa-vulkan-drivers)");
    }
    listed
}

async fn run_there(id: &str, mut stage: StageSpec, index: u64) -> Result<Output, TaskError> {
    stage.resources = Resources {
        gpus: 1,
        ..Resources::default()
    };
    let gpus = Gpus::named(vec![id.to_owned()]);
    run_on(gpus, stage, index, Arc::default()).await
}

fn close(a: f64, b: f64) -> bool {
    (a - b).abs() <= 1e-3 * a.abs().max(b.abs())
}

#[tokio::test(flavor = "multi_thread")]
async fn what_is_trained_predicted_and_judged_on_a_device_is_what_the_cpu_finds() {
    for id in listed() {
        let (there, here) = (Place::new().await, Place::new().await);
        let short = json!({"optimise": {"epochs": 4, "batch": 2}});
        run_there(&id, there.training(short.clone()), 0)
            .await
            .unwrap();
        run(here.training(short)).await.unwrap();
        let speed = |place: &Place| {
            let path = place.dir.path().join("models/m/speed.json");
            std::fs::read_to_string(path).unwrap()
        };
        assert!(speed(&there).contains(&id) && !speed(&here).contains("gpu"));
        // Evaluates and predicts with the same network on the GPU (there) and on the CPU (here).
        let twin = Place::new().await;
        copy(
            &there.dir.path().join("models"),
            &twin.dir.path().join("models"),
        );
        let evaluation = json!({"models": ["m"]});
        let infer = json!({"models": ["m"]});
        run_there(&id, there.evaluation(evaluation.clone()), 0)
            .await
            .unwrap();
        run(twin.evaluation(evaluation.clone())).await.unwrap();
        run(here.evaluation(evaluation)).await.unwrap();
        let mut found = Vec::new();
        for place in [&there, &twin, &here] {
            let found_here = place.models().evaluations("m").await.unwrap();
            found.push(found_here[0].metrics["mae_m"].as_f64().unwrap());
        }
        assert!(
            close(found[0], found[1]) && close(found[0], found[2]),
            "{id}: {found:?}"
        );
        run_there(&id, there.inference(infer.clone()), 3)
            .await
            .unwrap();
        run_at(twin.inference(infer), 3, Arc::default())
            .await
            .unwrap();
        let mut depths = Vec::new();
        for place in [&there, &twin] {
            let (store, prefix) = open_store(&place.store()).unwrap();
            let seen = Predictions::open(store, prefix.join("seen")).await.unwrap();
            depths.push(seen.read_depth(3).await.unwrap());
        }
        for (a, b) in depths[0].iter().zip(&depths[1]) {
            assert!((a - b).abs() < 1e-3, "{id}: {a} and {b}");
        }
        run_there(&id, there.report(json!({"pictures": 1})), 0)
            .await
            .unwrap();
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_stage_that_asks_for_one_is_handed_back_where_there_is_none() {
    let place = Place::new().await;
    let mut stage = place.training(json!({}));
    stage.resources.gpus = 1;
    match run(stage).await {
        Err(TaskError::Interrupted(text)) => assert!(text.contains("--gpus"), "{text}"),
        other => panic!("{other:?}"),
    }
}

fn copy(from: &std::path::Path, to: &std::path::Path) {
    std::fs::create_dir_all(to).unwrap();
    for entry in std::fs::read_dir(from).unwrap() {
        let entry = entry.unwrap();
        let target = to.join(entry.file_name());
        match entry.file_type().unwrap().is_dir() {
            true => copy(&entry.path(), &target),
            false => drop(std::fs::copy(entry.path(), target).unwrap()),
        }
    }
}
