//! Sweeps as tasks: trials that fall behind stop, trials that diverge report it, and the best model
//! is promoted.

use crate::place;

use picofarm_proto::spec::{JobSpec, PromoteSettings, PromoteTask, StageSpec, TaskSpec};
use picofarm_results::*;
use picofarm_store::published::Manifest as _;
use picofarm_tasks::model_version;
use serde_json::{Value, json};

use place::*;

/// Returns the stages of a sweep over the place's data set, as a job file would.
fn sweep(place: &Place, sweep: &Value, train: &Value) -> Vec<StageSpec> {
    let mut settings = json!({
        "target": "tof", "model": "m", "version": model_version(), "seed": 5, "net": {"width": 2, "levels": 2},
        "optimise": {"epochs": 9, "batch": 2, "learning_rate": "{lr}"},
    });
    for (name, value) in train.as_object().unwrap() {
        settings[name] = value.clone();
    }
    let job = json!({"name": "n", "stage": [{
        "name": "tof", "kind": "train", "source": {"store": place.store(), "dataset": "rooms"}, "count": SCENES,
        "sweep": sweep, "train": settings,
    }]});
    let spec: JobSpec = serde_json::from_value(job).unwrap();
    spec.check().unwrap();
    let mut stages = spec.stages;
    if let Some(TaskSpec::Promote(task)) = stages.last_mut().map(|s| &mut s.task) {
        task.promote.version = model_version();
    }
    stages
}

fn promotion(place: &Place, among: &[&str]) -> StageSpec {
    StageSpec::new(TaskSpec::Promote(PromoteTask {
        source: Some(place.source()),
        count: SCENES,
        promote: PromoteSettings {
            model: "best".into(),
            store: String::new(),
            among: among.iter().map(|&name| name.to_owned()).collect(),
            tolerate_missing: false,
            version: model_version(),
        },
    }))
}

async fn all_trials(place: &Place) -> Vec<TrialRecord> {
    let models = place.models();
    let ids = models.sweeps("m").await.unwrap();
    assert_eq!(ids.len(), 1);
    models.trials("m", ids.first().unwrap()).await.unwrap().0
}

#[tokio::test(flavor = "multi_thread")]
async fn trials_that_fall_behind_stop_and_the_best_gets_the_name() {
    let place = Place::new().await;
    // A far too small learning rate learns nothing. A later trial stops if it is no better than the
    // earlier ones.
    let over = json!({"over": {"lr": [1e-2, 1e-8, 2e-8, 3e-2]}, "stop": {"halving": {"first": 3, "factor": 3}}});
    let stages = sweep(&place, &over, &json!({}));
    let mut outputs = Vec::new();
    for stage in stages.clone() {
        outputs.push(run(stage).await.unwrap());
    }
    let trials = all_trials(&place).await;
    let ends: Vec<(&TrialEnd, u64)> = trials.iter().map(|t| (&t.end, t.epochs)).collect();
    assert_eq!(
        ends[..3],
        [
            (&TrialEnd::Finished, 9),
            (&TrialEnd::Pruned, 3),
            (&TrialEnd::Pruned, 3)
        ]
    );
    for trial in &trials {
        assert_eq!(trial.history.len() as u64, trial.epochs);
        assert_eq!(
            outputs[trial.index as usize].manifest_sha256,
            trial.sha256()
        );
        let there = place.models().look(&trial.model).await.unwrap().is_some();
        assert_eq!(there, trial.end == TrialEnd::Finished);
        assert_eq!(place.models().checkpoints(&trial.model).await.unwrap(), []);
    }
    // The promoted model is a copy and records its origin.
    let best = place.models().manifest("m").await.unwrap();
    let promoted = best.lineage.promoted.clone().unwrap();
    let source = place.models().manifest(&promoted.model).await.unwrap();
    assert_eq!(promoted.manifest_sha256, source.sha256());
    let finished = trials.iter().filter(|t| t.end == TrialEnd::Finished);
    let least = finished
        .clone()
        .map(|t| t.loss.unwrap())
        .fold(f64::MAX, f64::min);
    let chosen = finished
        .clone()
        .find(|t| t.model == promoted.model)
        .unwrap();
    assert_eq!(chosen.loss, Some(least));
    assert_eq!(promoted.values, chosen.values);
    assert_eq!(
        (promoted.finished, promoted.begun),
        (finished.count() as u64, 4)
    );
    assert_eq!(
        place
            .models()
            .read(&best, "weights.safetensors")
            .await
            .unwrap(),
        place
            .models()
            .read(&source, "weights.safetensors")
            .await
            .unwrap()
    );
    // On a second run, nothing is computed and nothing changes.
    let before = place.files("models");
    for (stage, output) in stages.iter().zip(&outputs) {
        let again = run(stage.clone()).await.unwrap();
        assert_eq!(again.manifest_sha256, output.manifest_sha256);
    }
    assert_same(&place.files("models"), &before);
    // With `force`, finished trials run again and end in the same way.
    for mut stage in stages {
        stage.force = true;
        run(stage).await.unwrap();
    }
    assert_same(&place.files("models"), &before);
}

#[tokio::test(flavor = "multi_thread")]
async fn who_is_worse_than_the_median_of_the_others_stops() {
    let place = Place::new().await;
    let stop = json!({"median": {"first": 3, "every": 2, "least": 2}});
    let over = json!({"over": {"lr": [1e-2, 3e-2, 1e-8, 2e-8]}, "stop": stop});
    for stage in sweep(&place, &over, &json!({})) {
        run(stage).await.unwrap();
    }
    let trials = all_trials(&place).await;
    let ends: Vec<(&TrialEnd, u64)> = trials.iter().map(|t| (&t.end, t.epochs)).collect();
    // The second trial has only one other to compare with, which is too few. The third learns
    // nothing and has two.
    let (finished, pruned) = ((&TrialEnd::Finished, 9), (&TrialEnd::Pruned, 3));
    assert_eq!(ends, [finished, finished, pruned, pruned]);
    // The rungs of the trials and the sweep's domain are stored.
    let id = place.models().sweeps("m").await.unwrap();
    let (_, rungs) = place
        .models()
        .trials("m", id.first().unwrap())
        .await
        .unwrap();
    let asked: Vec<(u64, u64)> = rungs.iter().map(|r| (r.epochs, r.index)).collect();
    assert_eq!(
        asked,
        [
            (3, 0),
            (3, 1),
            (3, 2),
            (3, 3),
            (5, 0),
            (5, 1),
            (7, 0),
            (7, 1)
        ]
    );
    assert_eq!(trials[2].over["lr"], json!([1e-2, 3e-2, 1e-8, 2e-8]));
}

#[tokio::test(flavor = "multi_thread")]
async fn trials_of_a_bracket_are_compared_with_one_another_alone() {
    let place = Place::new().await;
    // Of 9 epochs, with the only rung after 3: trials 0, 2 and 4 are judged there, 1 and 3 never.
    let stop = json!({"hyperband": {"first": 3, "factor": 3}});
    let over = json!({"over": {"lr": [1e-2, 1e-8, 2e-8, 3e-8]}, "stop": stop});
    for stage in sweep(&place, &over, &json!({})) {
        run(stage).await.unwrap();
    }
    let trials = all_trials(&place).await;
    let ends: Vec<(&TrialEnd, u64)> = trials.iter().map(|t| (&t.end, t.epochs)).collect();
    let (finished, pruned) = ((&TrialEnd::Finished, 9), (&TrialEnd::Pruned, 3));
    assert_eq!(ends, [finished, finished, pruned, finished]);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_trial_computes_what_the_training_computes_without_a_sweep() {
    let place = Place::new().await;
    let stages = sweep(&place, &json!({"over": {"lr": [1e-2]}}), &json!({}));
    run(stages[0].clone()).await.unwrap();
    let calm = Place::new().await;
    let plain = calm.training(
        json!({"model": "m.0", "optimise": {"epochs": 9, "batch": 2, "learning_rate": 1e-2},
                                     "checkpoint_minutes": 10.0}),
    );
    run(plain).await.unwrap();
    assert_same(&place.files("models/m.0"), &calm.files("models/m.0"));
    // A trial adopts the result of a plain training with the same key.
    let taken = sweep(&calm, &json!({"over": {"lr": [1e-2]}}), &json!({}));
    assert!(run(taken[0].clone()).await.unwrap().adopted);
    assert_eq!(all_trials(&calm).await, all_trials(&place).await);
}

#[tokio::test(flavor = "multi_thread")]
async fn trials_that_are_stopped_again_and_again_end_as_those_that_never_were() {
    let over =
        json!({"over": {"lr": [1e-2, 1e-8, 3e-2]}, "stop": {"halving": {"first": 4, "factor": 2}}});
    let train = json!({"optimise": {"epochs": 40, "batch": 2, "learning_rate": "{lr}"}, "checkpoint_minutes": 0.01});
    let (calm, place) = (Place::new().await, Place::new().await);
    for stage in sweep(&calm, &over, &train) {
        run(stage).await.unwrap();
    }
    let mut stops = 0;
    for stage in sweep(&place, &over, &train) {
        // A share of 0.1 is the first rung: some stops happen exactly there.
        for share in [0.05, 0.099, 0.0995, 0.2, 0.5] {
            stops += u32::from(run_until(stage.clone(), share).await);
        }
        run(stage).await.unwrap();
    }
    assert!(stops > 3, "{stops}");
    assert_same(&place.files("models"), &calm.files("models"));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_trial_whose_numbers_break_is_a_result_and_not_a_failure() {
    let place = Place::new().await;
    let over = json!({"over": {"lr": [10.0, 1e-2]}});
    // With this weight decay, each step makes the weights of the last layer nine times as large.
    let optimise = |lr: Value| json!({"epochs": 40, "batch": 2, "learning_rate": lr, "weight_decay": 0.999, "schedule": "constant"});
    for stage in sweep(&place, &over, &json!({"optimise": optimise(json!("{lr}"))})) {
        run(stage).await.unwrap();
    }
    let trials = all_trials(&place).await;
    let TrialEnd::Diverged(what) = &trials[0].end else {
        panic!("{:?}", trials[0].end);
    };
    assert!(
        what.contains("not finite") || what.contains("NaN"),
        "{what}"
    );
    let best = place.models().manifest("m").await.unwrap();
    assert_eq!(best.lineage.promoted.unwrap().model, "m.1");
    // Outside a sweep, divergence is the training's own failure.
    let plain = place.training(json!({"model": "x", "optimise": optimise(json!(10.0))}));
    assert!(refused(plain).await.contains("finite"));
}

#[tokio::test(flavor = "multi_thread")]
async fn what_cannot_be_compared_is_refused() {
    let place = Place::new().await;
    place
        .split("bare", picofarm_proto::split::Parts::Counts([5, 0, 3]))
        .await;
    let stages = sweep(
        &place,
        &json!({"over": {"lr": [1e-2]}}),
        &json!({"split": "bare"}),
    );
    let said = refused(stages[0].clone()).await;
    assert!(
        said.contains("has no validation scenes to compare trials by"),
        "{said}"
    );
    let short = json!({"epochs": 1, "batch": 2});
    // Nothing is trained for a name that the best trial could not get.
    run(place.training(json!({"model": "m", "optimise": short})))
        .await
        .unwrap();
    let stages = sweep(&place, &json!({"over": {"lr": [1e-2]}}), &json!({}));
    let said = refused(stages[0].clone()).await;
    assert!(
        said.contains("\"m\" is the model of another training"),
        "{said}"
    );
    assert!(place.models().look("m.0").await.unwrap().is_none());
    run(place.training(json!({"model": "bare", "split": "bare", "optimise": short})))
        .await
        .unwrap();
    run(place.training(json!({"model": "a", "optimise": short})))
        .await
        .unwrap();
    run(place.training(json!({"model": "b", "target": "specular", "optimise": short})))
        .await
        .unwrap();
    let said = refused(promotion(&place, &["bare"])).await;
    assert!(
        said.contains("\"bare\" was validated on no scenes"),
        "{said}"
    );
    let said = refused(promotion(&place, &["a", "b"])).await;
    assert!(said.contains("choose among models of one kind"), "{said}");
    let said = refused(promotion(&place, &["a", "z"])).await;
    assert!(
        said.contains("promote.among[1]") && said.contains("holds no \"z\""),
        "{said}"
    );
    assert!(place.models().look("best").await.unwrap().is_none());
    // A different model under the name is kept.
    run(promotion(&place, &["a"])).await.unwrap();
    run(place.training(json!({"model": "c", "seed": 9, "optimise": {"epochs": 40, "batch": 2}})))
        .await
        .unwrap();
    let before = place.files("models");
    let said = refused(promotion(&place, &["c"])).await;
    assert!(
        said.contains("holds the model of another training"),
        "{said}"
    );
    assert_same(&place.files("models"), &before);
}
