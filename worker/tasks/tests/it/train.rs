//! Training and evaluation as tasks: published once, resumed after a stop or a loss, and refused
//! for unsuitable inputs. The data are synthetic: nothing is rendered.

use crate::place;
use picofarm_store::published::Manifest as _;

use std::{path::Path, sync::Arc};

use picofarm_proto::split::Parts;
use picofarm_tasks::{Control, model_version};
use serde_json::json;

use place::*;

#[tokio::test(flavor = "multi_thread")]
async fn a_model_is_trained_once_and_says_where_it_comes_from() {
    let place = Place::new().await;
    let control = Arc::new(Control::default());
    let output = run_with(place.training(json!({})), control.clone())
        .await
        .unwrap();
    assert!(!output.adopted);
    let (fraction, at) = control.progress();
    assert_eq!(fraction, 1.0);
    assert!(
        at.text.starts_with("epoch 40/40, loss ") && at.text.ends_with(" samples/s"),
        "{at:?}"
    );
    assert!(
        at.figures["loss"].is_finite() && at.figures["steps"] > 0.0,
        "{at:?}"
    );
    assert!(at.figures["validation_loss"] > 0.0, "{at:?}");
    let models = place.models();
    let manifest = models.manifest("m").await.unwrap();
    assert_eq!(manifest.sha256(), output.manifest_sha256);
    assert_eq!(manifest.total_bytes(), output.bytes);
    let from = &manifest.lineage;
    assert_eq!(
        (&*from.dataset, from.seed, &*from.code),
        ("rooms", 5, &*model_version())
    );
    assert_eq!((from.training_scenes, from.validation_scenes), (5, 2));
    assert_eq!((&*from.split.name, from.split.version), ("default", 1));
    assert_eq!(models.checkpoints("m").await.unwrap(), []);
    let before = place.files("models");
    let again = run(place.training(json!({"checkpoint_minutes": 5.0})))
        .await
        .unwrap();
    assert!(again.adopted);
    assert_eq!(again.manifest_sha256, output.manifest_sha256);
    let mut forced = place.training(json!({}));
    forced.force = true;
    assert!(!run(forced).await.unwrap().adopted);
    assert_eq!(place.files("models"), before);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_training_that_is_stopped_again_and_again_ends_as_one_that_never_was() {
    let calm = Place::new().await;
    run(calm.training(json!({}))).await.unwrap();
    let place = Place::new().await;
    let mut stops = 0;
    for share in [0.01, 0.2, 0.3, 0.5, 0.7, 0.9] {
        if !run_until(place.training(json!({})), share).await {
            break;
        }
        stops += 1;
        assert!(!place.models().checkpoints("m").await.unwrap().is_empty());
        if stops % 2 == 0 {
            // The newest checkpoint is truncated, so the previous one is used.
            let checkpoints = place.files("models/m/checkpoints");
            let (newest, bytes) = checkpoints.last_key_value().unwrap();
            let path = place.dir.path().join("models/m/checkpoints").join(newest);
            std::fs::write(path, &bytes[..bytes.len() / 2]).unwrap();
        }
    }
    assert!(stops > 0, "no training was stopped half-way");
    run(place.training(json!({}))).await.unwrap();
    assert_eq!(place.files("models"), calm.files("models"));
}

#[tokio::test(flavor = "multi_thread")]
async fn what_was_trained_of_other_settings_under_the_name_is_in_nobodys_way() {
    let place = Place::new().await;
    assert!(run_until(place.training(json!({"seed": 6})), 0.01).await);
    run(place.training(json!({}))).await.unwrap();
    let calm = Place::new().await;
    run(calm.training(json!({}))).await.unwrap();
    let manifest = Path::new("m/manifest.json");
    assert_eq!(
        place.files("models")[manifest],
        calm.files("models")[manifest]
    );
    let said = refused(place.training(json!({"seed": 6}))).await;
    assert!(said.contains("choose another name"), "{said}");
}

#[tokio::test(flavor = "multi_thread")]
async fn models_build_on_models_of_the_store() {
    let place = Place::new().await;
    run(place.training(json!({}))).await.unwrap();
    let mirrors = json!({"target": "specular", "model": "s", "specular": {"on": "m"}});
    run(place.training(mirrors)).await.unwrap();
    let models = place.models();
    let (tof, mirrors) = (
        models.manifest("m").await.unwrap(),
        models.manifest("s").await.unwrap(),
    );
    assert_eq!(mirrors.lineage.models["m"], tof.sha256());
    place.predict("m", "depths").await;
    let shadows = json!({"target": "shadow", "model": "sh", "shadow": {"times": "depths"}, "histogram": "transient_spots", "spots": [1]});
    run(place.training(shadows)).await.unwrap();
    run(place.evaluation(json!({"models": ["s", "sh"]})))
        .await
        .unwrap();
    let found = models.evaluations("sh").await.unwrap();
    assert_eq!(found[0].histogram, "transient_spots");
    assert!(
        found[0].metrics["iou"].is_number()
            && found[0].metrics["baselines"]["all"]["iou"].is_number()
    );
    let more = json!({"model": "n", "from": "m", "scenes": 2});
    run(place.training(more)).await.unwrap();
    assert_eq!(
        models.manifest("n").await.unwrap().lineage.training_scenes,
        2
    );
    for (more, part) in [
        (
            json!({"target": "specular", "model": "x", "specular": {"on": "m"}, "net": {"width": 4, "levels": 2}}),
            "train.net.width: is 4, but 2",
        ),
        (
            json!({"target": "shadow", "model": "x", "from": "m"}),
            "train.from: \"m\" predicts \"tof\"",
        ),
        (
            json!({"model": "x", "from": "nobody"}),
            "holds no \"nobody\"; there are: m, n, s, sh",
        ),
    ] {
        let said = refused(place.training(more)).await;
        assert!(said.contains(part), "{said}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn what_cannot_be_trained_is_refused_by_name() {
    let place = Place::new().await;
    place.split("lone", Parts::Counts([8, 0, 0])).await;
    for (more, part) in [
        (json!({"split": "nobody"}), "train.split"),
        (json!({"scenes": 6}), "train.scenes: 6 scenes"),
        (json!({"histogram": "transient_25"}), "train.histogram"),
        (
            json!({"histogram": "transient_spots", "spots": [2]}),
            "train.spots: 2",
        ),
        (json!({"version": "other"}), "train.version"),
        (json!({"input": {"bins": 9}}), "train.input.bins: 9 is more"),
        (
            json!({"input": {"bins": 5}}),
            "leave out 3 of the data set's 8; give 8 (sums of 1) or 4 (sums of 2)",
        ),
        (
            json!({"net": {"width": 2, "levels": 5}}),
            "train.net.levels",
        ),
        (json!({"optimise": {"batch": 9}}), "optimise.batch"),
        (
            json!({"split": "lone", "optimise": {"early_stop": 3}}),
            "train.optimise.early_stop",
        ),
    ] {
        let said = refused(place.training(more)).await;
        assert!(said.contains(part), "{said}");
    }
    std::fs::remove_file(place.dir.path().join("rooms/manifests/3.json")).unwrap();
    let said = refused(place.training(json!({"split": "lone"}))).await;
    assert!(
        said.contains("source") && said.contains("scene 3"),
        "{said}"
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn an_evaluation_is_kept_beside_each_model_and_made_once() {
    let place = Place::new().await;
    run(place.training(json!({}))).await.unwrap();
    let first = run(place.evaluation(json!({}))).await.unwrap();
    assert!(!first.adopted);
    let found = place.models().evaluations("m").await.unwrap();
    let [evaluation] = &found[..] else {
        panic!("{found:?}")
    };
    assert_eq!((&*evaluation.side, evaluation.scenes), ("test", 1));
    assert_eq!(evaluation.histogram, "transient");
    let figures = &evaluation.metrics;
    assert!(
        figures["mae_m"].is_number() && figures["baselines"]["constant"]["mae_m"].is_number(),
        "{figures}"
    );
    let again = run(place.evaluation(json!({}))).await.unwrap();
    assert_eq!(
        (again.adopted, again.manifest_sha256),
        (true, first.manifest_sha256)
    );
    run(place.evaluation(json!({"side": "train", "scenes": 3})))
        .await
        .unwrap();
    assert_eq!(place.models().evaluations("m").await.unwrap().len(), 2);
    for (more, part) in [
        (json!({"models": ["m", "nobody"]}), "evaluate.models[1]"),
        (json!({"scenes": 9}), "evaluate.scenes"),
        (json!({"histogram": "transient_4"}), "evaluate.histogram"),
    ] {
        let said = refused(place.evaluation(more)).await;
        assert!(said.contains(part), "{said}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn scenes_without_the_truth_that_is_needed_are_refused_by_name() {
    let shadow = json!({"target": "shadow"});
    let known_times = json!({"target": "shadow", "shadow": {"variant": "index"}});
    let mirrors = json!({"target": "specular"});
    for (missing, refused_are, trained_are) in [
        (
            "depth",
            [json!({}), shadow.clone()],
            [known_times.clone(), mirrors.clone()],
        ),
        (
            "visibility",
            [shadow.clone(), known_times.clone()],
            [json!({}), mirrors.clone()],
        ),
        (
            "specular",
            [mirrors.clone(), mirrors],
            [json!({}), shadow.clone()],
        ),
        (
            "spots.path",
            [shadow.clone(), shadow],
            [json!({}), known_times],
        ),
    ] {
        // Scenes 0, 3 and 6 lack it, on either side of the split.
        let place = Place::lacking(&[missing, "normal"]).await;
        for more in refused_are {
            let said = refused(place.training(more)).await;
            assert!(
                said.starts_with("source: ")
                    && said.contains("rooms")
                    && said.contains(&format!(" lack {missing} (scene ")),
                "{said}"
            );
            assert!(said.contains("import these scenes with"), "{said}");
        }
        assert!(place.files("models").is_empty(), "{missing}");
        for (which, mut more) in trained_are.into_iter().enumerate() {
            more["model"] = format!("m{which}").into();
            more["optimise"] = json!({"epochs": 1, "batch": 2});
            run(place.training(more)).await.unwrap();
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn models_are_not_judged_by_truth_that_is_missing() {
    let place = Place::new().await;
    place.train_all().await;
    let alone =
        json!({"target": "shadow", "model": "given", "optimise": {"epochs": 1, "batch": 2}});
    run(place.training(alone)).await.unwrap();
    let link = |other: &Place| {
        for folder in ["models", "depths"] {
            let (from, to) = (place.dir.path().join(folder), other.dir.path().join(folder));
            std::os::unix::fs::symlink(from, to).unwrap();
        }
    };
    for (missing, model) in [
        ("depth", "m"),
        ("depth", "given"),
        ("visibility", "sh"),
        ("specular", "s"),
        ("spots.path", "sh"),
    ] {
        let other = Place::lacking(&[missing]).await;
        link(&other);
        let evaluation = json!({"models": [model], "side": "train"});
        let said = refused(other.evaluation(evaluation)).await;
        assert!(said.contains(&format!(" lack {missing} (scene ")), "{said}");
    }
    // Inference needs no ground truth except for its own inputs.
    let other = Place::lacking(&["depth", "visibility", "specular"]).await;
    link(&other);
    run(other.inference(json!({}))).await.unwrap();
    let said = refused(other.inference(json!({"models": ["given"]}))).await;
    assert!(
        said.contains("1 scene of") && said.contains("lack depth (scene 0)"),
        "{said}"
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn two_bounce_times_follow_from_the_depths_that_an_infer_stage_has_kept() {
    let place = Place::new().await;
    place.train_all().await;
    let short = json!({"epochs": 10, "batch": 2});
    let shadows = |model: &str, times: &str| {
        let shadow = json!({"times": times});
        place.training(
            json!({"target": "shadow", "model": model, "shadow": shadow, "optimise": short}),
        )
    };
    let models = place.models();
    let (tof, kept) = (
        models.manifest("m").await.unwrap(),
        models.manifest("sh").await.unwrap(),
    );
    assert_eq!(kept.lineage.models["m"], tof.sha256());
    assert_eq!(kept.lineage.times.as_ref().unwrap().predictions, "depths");

    // The name of the folder does not affect the result; its bytes do.
    place.predict("m", "again").await;
    place
        .predict_with(json!({"model": "other", "seed": 9}), "others")
        .await;
    for (name, times) in [("copy", "again"), ("else", "others"), ("true", "truth")] {
        run(shadows(name, times)).await.unwrap();
    }
    let of = async |name: &str| models.manifest(name).await.unwrap();
    let key = async |name: &str| of(name).await.training_key;
    assert_eq!(key("copy").await, kept.training_key);
    assert_ne!(key("else").await, kept.training_key);
    assert_ne!(key("true").await, kept.training_key);
    assert!(of("true").await.lineage.times.is_none());
    let hash = |manifest: &picofarm_results::ModelManifest| {
        manifest
            .object("weights.safetensors")
            .unwrap()
            .sha256
            .clone()
    };
    assert_eq!(hash(&of("copy").await), hash(&kept));
    assert_ne!(hash(&of("else").await), hash(&kept));
    assert_ne!(hash(&of("true").await), hash(&kept));

    // An evaluation uses the training's times unless its settings name others.
    for (model, times, found) in [
        ("sh", "", "depths"),
        ("sh", "others", "others"),
        ("sh", "truth", "truth"),
        ("copy", "", "again"),
        ("true", "", "truth"),
        ("m", "truth", ""),
    ] {
        let (there, asked) = (
            models.evaluations(model).await.unwrap(),
            json!({"models": [model], "times": times}),
        );
        run(place.evaluation(asked)).await.unwrap();
        let mut after = models.evaluations(model).await.unwrap();
        after.retain(|e| there.iter().all(|other| other.key != e.key));
        let said: Vec<&str> = after.iter().map(|e| &*e.times).collect();
        assert_eq!(said, [found], "{model} {times}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn predictions_that_do_not_fit_are_refused_by_name_before_anything_is_learnt() {
    let place = Place::new().await;
    place.train_all().await;
    let short = json!({"epochs": 1, "batch": 2});
    let shadows = |times: &str| {
        let shadow = json!({"times": times});
        place.training(
            json!({"target": "shadow", "model": "x", "shadow": shadow, "optimise": short}),
        )
    };
    // Predictions of masks only.
    place.predict("s", "mirrors").await;
    // A scene is missing.
    place.predict("m", "short").await;
    std::fs::remove_file(place.dir.path().join("short/manifests/4.json")).unwrap();
    // Depths from two models.
    place.predict("m", "mixed").await;
    place
        .predict_with(json!({"model": "other", "seed": 9}), "others")
        .await;
    for file in ["manifests/4.json", "depth/c/4/0/0"] {
        let [from, to] = ["others", "mixed"].map(|f| place.dir.path().join(f).join(file));
        std::fs::copy(from, to).unwrap();
    }
    for (times, part) in [
        ("nowhere", "nowhere"),
        ("rooms", "rooms"),
        (
            "mirrors",
            "holds no depths; give its infer stage a \"tof\" model",
        ),
        ("short", "holds nothing of scene 4"),
        ("mixed", "holds predictions of \"tof\" by "),
    ] {
        let said = refused(shadows(times)).await;
        assert!(
            said.starts_with("train.shadow.times: ") && said.contains(part),
            "{said}"
        );
    }
    // The scenes are made again, so that earlier predictions belong to other scenes.
    let other = Place::lacking(&["normal"]).await;
    for folder in ["models", "depths"] {
        let (from, to) = (place.dir.path().join(folder), other.dir.path().join(folder));
        std::os::unix::fs::symlink(from, to).unwrap();
    }
    let said = refused(other.evaluation(json!({"models": ["sh"], "side": "train"}))).await;
    assert!(
        said.contains("which is not the scene that is read here"),
        "{said}"
    );
    assert!(said.contains("evaluate.times gives others"), "{said}");
    let said = refused(other.inference(json!({"models": ["sh"]}))).await;
    assert!(
        said.contains("a \"tof\" model in infer.models gives others"),
        "{said}"
    );
    assert!(models_are(&place, &["m", "other", "s", "sh"]).await);
}

async fn models_are(place: &Place, names: &[&str]) -> bool {
    place.models().names().await.unwrap() == names
}

#[tokio::test(flavor = "multi_thread")]
async fn processes_train_together_to_the_bits_of_one_and_leave_nothing_behind() {
    let alone = Place::new().await;
    let settings = |processes: u32| json!({"processes": processes, "optimise": {"epochs": 60, "batch": 4, "accumulate": 4}});
    run(alone.training(settings(1))).await.unwrap();
    let place = Place::new().await;
    let stage = place.training(settings(3));
    assert_eq!(stage.tasks(), 3);
    let all = (0..3).map(|task| run_at(stage.clone(), task, Arc::default()));
    let found = futures::future::join_all(all).await;
    let outputs: Vec<_> = found.into_iter().map(Result::unwrap).collect();
    // At least one of the processes has stored the network; any may be the one.
    assert!(outputs.iter().any(|output| !output.adopted), "{outputs:?}");
    for output in &outputs {
        assert_eq!(output.manifest_sha256, outputs[0].manifest_sha256);
    }
    assert_same(&place.files("models"), &alone.files("models"));
    // On a second run, each process finds the stored model.
    for task in 0..3 {
        assert!(
            run_at(stage.clone(), task, Arc::default())
                .await
                .unwrap()
                .adopted
        );
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_sensor_draws_anew_at_each_visit_and_the_same_on_any_machine() {
    let sensor = json!({"scale": {"kind": "peak", "photons": 40.0}, "pulse": {"kind": "none"}, "jitter": {"kind": "gaussian", "fwhm_ps": 0.0}});
    let with = |more: serde_json::Value| {
        let mut settings =
            json!({"sensor": sensor, "augment": false, "optimise": {"epochs": 6, "batch": 5}});
        for (name, value) in more.as_object().unwrap() {
            settings[name] = value.clone();
        }
        settings
    };
    let (place, again, calm) = (Place::new().await, Place::new().await, Place::new().await);
    run(place.training(with(json!({})))).await.unwrap();
    // The training is stopped half-way and resumed elsewhere.
    assert!(run_until(again.training(with(json!({}))), 0.4).await);
    run(again.training(with(json!({})))).await.unwrap();
    assert_eq!(place.files("models"), again.files("models"));
    let manifest = place.models().manifest("m").await.unwrap();
    assert!(manifest.lineage.measurement.photon_noise);
    run(calm.training(json!({"augment": false, "optimise": {"epochs": 6, "batch": 5}})))
        .await
        .unwrap();
    assert_ne!(
        place.files("models").keys().collect::<Vec<_>>(),
        calm.files("models").keys().collect::<Vec<_>>(),
        "photons change what is learnt"
    );
    // A step sees all five scenes. With a learning rate of almost zero, its loss varies only with
    // the noise.
    let still = json!({"model": "still", "optimise": {"epochs": 6, "batch": 5, "learning_rate": 1e-8, "weight_decay": 0.0, "schedule": "constant"}});
    let losses = |place: &Place| {
        let path = place.files("models/still");
        let (_, history) = path
            .iter()
            .find(|(name, _)| name.ends_with("history.jsonl"))
            .unwrap();
        let lines = String::from_utf8_lossy(history).into_owned();
        lines
            .lines()
            .map(|line| {
                serde_json::from_str::<serde_json::Value>(line).unwrap()["loss"]
                    .as_f64()
                    .unwrap()
            })
            .collect::<Vec<_>>()
    };
    run(place.training(with(still.clone()))).await.unwrap();
    let mut settings = still;
    settings["augment"] = json!(false);
    run(calm.training(settings)).await.unwrap();
    let spread = |losses: &[f64]| {
        let most = losses
            .iter()
            .fold(0.0, |a: f64, b| a.max((b - losses[0]).abs()));
        most / losses[0]
    };
    let (noisy, quiet) = (losses(&place), losses(&calm));
    assert!(spread(&quiet) < 1e-5, "{quiet:?}");
    assert!(spread(&noisy) > 1e-4, "{noisy:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn an_evaluation_goes_through_the_sensor_that_a_model_was_trained_with_unless_told_otherwise()
{
    let place = Place::new().await;
    let sensor = json!({"scale": {"kind": "peak", "photons": 10.0}});
    run(place.training(json!({"sensor": sensor, "optimise": {"epochs": 6, "batch": 2}})))
        .await
        .unwrap();
    for more in [
        json!({}),
        json!({"sensor": false}),
        json!({"shards": 2, "sensor": true}),
    ] {
        run(place.evaluation(more)).await.unwrap();
    }
    let found = place.models().evaluations("m").await.unwrap();
    let mut through: Vec<bool> = found.iter().map(|e| e.sensor).collect();
    through.sort_unstable();
    assert_eq!(through, [false, true], "shards change nothing");
    assert_ne!(found[0].metrics["mae_m"], found[1].metrics["mae_m"]);
    run(place.report(json!({"pictures": 1}))).await.unwrap();
    let said = refused(place.training(json!({"model": "n", "sensor": {"rebin": 2}}))).await;
    assert!(
        said.contains("train.sensor.rebin") && said.contains("input.bins"),
        "{said}"
    );
    let said =
        refused(place.training(json!({"model": "n", "sensor": {"dark_per_bin": -1.0}}))).await;
    assert!(said.contains("train.sensor.dark_per_bin"), "{said}");
}
