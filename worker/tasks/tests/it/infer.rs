//! Predictions of models as tasks: equal to those of evaluations, published once, repaired, and
//! refused for unsuitable inputs. Also reports about models. The data are synthetic: nothing is
//! rendered.

use crate::place;

use std::sync::Arc;

use picofarm_dataset::{Dataset, Quantity};
use picofarm_proto::spec::{StageSpec, TaskSpec};
use picofarm_results::{Predicted, PredictionManifest, Predictions, TimesUsed};
use picofarm_store::open_store;
use picofarm_store::published::Manifest as _;
use picofarm_tasks::{Control, Output, TaskError};
use serde_json::{Value, json};

use place::*;

impl Place {
    async fn seen(&self) -> Predictions {
        let (store, prefix) = open_store(&self.store()).unwrap();
        Predictions::open(store, prefix.join("seen")).await.unwrap()
    }

    async fn infer(&self, more: Value, scene: u64) -> Result<Output, TaskError> {
        run_at(self.inference(more), scene, Arc::default()).await
    }

    async fn manifest(&self, scene: u64) -> PredictionManifest {
        self.seen().await.manifest(scene).await.unwrap()
    }

    async fn rooms(&self) -> Dataset {
        let (store, prefix) = open_store(&self.store()).unwrap();
        Dataset::open(store, prefix.join("rooms")).await.unwrap()
    }

    fn forget(&self, name: &str) {
        std::fs::remove_file(self.dir.path().join(name)).unwrap();
    }
}

/// Returns the inference of models over another data set.
fn of(place: &Place, dataset: &str, models: &[&str]) -> StageSpec {
    let mut stage = place.inference(json!({"models": models}));
    let TaskSpec::Infer(task) = &mut stage.task else {
        panic!("{stage:?}")
    };
    task.source.dataset = dataset.into();
    stage
}

fn iou(said: &[u8], truth: &[u8]) -> f64 {
    let count = |f: fn(bool, bool) -> bool| {
        let pairs = said.iter().zip(truth);
        pairs.filter(|(s, t)| f(**s > 127, **t > 0)).count() as f64
    };
    count(|s, t| s && t) / count(|s, t| s || t)
}

#[tokio::test(flavor = "multi_thread")]
async fn what_is_kept_is_what_evaluations_found() {
    let place = Place::new().await;
    place.train_all().await;
    run(place.evaluation(json!({"models": ["m", "sh", "s"]})))
        .await
        .unwrap();
    for scene in 0..SCENES {
        assert!(!place.infer(json!({}), scene).await.unwrap().adopted);
    }
    let mut figures = std::collections::BTreeMap::new();
    for name in ["m", "sh", "s"] {
        let found = place.models().evaluations(name).await.unwrap();
        figures.insert(name, found[0].metrics.clone());
    }
    let scene = figures["m"]["by_scene_index"][0].as_u64().unwrap();
    let Predicted {
        depth_m,
        lit,
        specular,
        ..
    } = place.seen().await.read(scene).await.unwrap();
    let rooms = place.rooms().await;
    let depth = rooms.read::<f32>(scene, Quantity::Depth).await.unwrap();
    let pixels = (SIDE * SIDE) as usize;
    assert_eq!(
        (depth_m.len(), lit.len(), specular.len()),
        (pixels, 2 * pixels, pixels)
    );
    let errors = depth_m
        .iter()
        .zip(&depth)
        .map(|(a, b)| f64::from(a - b).abs());
    let (mae, found) = (
        errors.sum::<f64>() / pixels as f64,
        figures["m"]["mae_m"].as_f64().unwrap(),
    );
    // Depths outside 0 to 4.5 m are clamped to that range, which brings them nearer to the truth.
    assert!(mae > 0.5 * found && mae <= found + 1e-5, "{mae}, {found}");
    let mirrors = rooms.read::<u8>(scene, Quantity::Specular).await.unwrap();
    let light = rooms.read_visibility(scene).await.unwrap();
    for (name, ours) in [("s", iou(&specular, &mirrors)), ("sh", iou(&lit, &light))] {
        let found = figures[name]["iou"].as_f64().unwrap();
        assert!((ours - found).abs() < 1e-9, "{name}: {ours}, {found}");
    }
    let manifest = place.manifest(scene).await;
    // The manifest has agreement figures, whatever the quality of the predictions.
    let agreement = &manifest.agreement;
    assert!(
        agreement["verdict"].is_string() && agreement["reasons"].is_array(),
        "{agreement}"
    );
    let models = place.models();
    let (tof, shadow) = (
        models.manifest("m").await.unwrap(),
        models.manifest("sh").await.unwrap(),
    );
    assert_eq!(manifest.models["tof"].manifest_sha256, tof.sha256());
    assert_eq!(manifest.models["shadow"].manifest_sha256, shadow.sha256());
    assert_eq!(manifest.models["specular"].name, "s");
    let Some(TimesUsed::Model(times)) = &manifest.two_bounce_times else {
        panic!("{manifest:?}");
    };
    assert_eq!(times.manifest_sha256, tof.sha256());
    assert_eq!(manifest.source.dataset, "rooms");
    let made = rooms.manifest(scene).await.unwrap();
    assert_eq!(manifest.source.task_key, made.provenance.task_key);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_task_that_is_run_again_adopts_or_completes_what_is_there() {
    let place = Place::new().await;
    place.train_all().await;
    let first = place.infer(json!({}), 3).await.unwrap();
    let before = place.files("seen");
    let again = place.infer(json!({}), 3).await.unwrap();
    assert_eq!(
        (again.adopted, &again.manifest_sha256, again.bytes),
        (true, &first.manifest_sha256, first.bytes)
    );
    // Simulates a kill before the manifest was written, with an object missing too.
    place.forget("seen/manifests/3.json");
    place.forget("seen/lit/c/3/0/0/0");
    assert!(!place.infer(json!({}), 3).await.unwrap().adopted);
    assert_same(&place.files("seen"), &before);
    // An object is lost later.
    place.forget("seen/depth/c/3/0/0");
    assert!(!place.infer(json!({}), 3).await.unwrap().adopted);
    assert_same(&place.files("seen"), &before);
    let mut forced = place.inference(json!({}));
    forced.force = true;
    let forced = run_at(forced, 3, Arc::default()).await.unwrap();
    assert!(!forced.adopted);
    assert_same(&place.files("seen"), &before);
    // Another store with the same trainings has the same predictions.
    let other = Place::new().await;
    other.train_all().await;
    other.infer(json!({}), 3).await.unwrap();
    assert_same(&other.files("seen"), &before);
    // The scene's data change, and so does the key. Predictions with another key are not replaced.
    let said = match place.infer(json!({"models": ["m", "s"]}), 3).await {
        Err(TaskError::User(text)) => text,
        other => panic!("{other:?}"),
    };
    assert!(said.contains("output.dataset"), "{said}");
}

#[tokio::test(flavor = "multi_thread")]
async fn times_follow_from_the_stages_own_depths_else_from_those_of_the_training() {
    let place = Place::new().await;
    place.train_all().await;
    let short = json!({"epochs": 5, "batch": 2});
    for settings in [
        json!({"model": "n", "seed": 9, "optimise": short}),
        json!({"target": "shadow", "model": "true", "optimise": short}),
        json!({"target": "shadow", "model": "all", "shadow": {"variant": "all"}, "optimise": short}),
    ] {
        run(place.training(settings)).await.unwrap();
    }
    for (models, times) in [
        (json!(["n", "sh"]), Some("n")),
        (json!(["sh"]), Some("m")),
        (json!(["true", "n"]), Some("n")),
        (json!(["true"]), Some("")),
        (json!(["n", "all"]), None),
        (json!(["n"]), None),
    ] {
        let output = json!({"models": models});
        let mut stage = place.inference(output);
        let TaskSpec::Infer(task) = &mut stage.task else {
            panic!("{stage:?}")
        };
        task.output.dataset = format!("seen-{}", task.infer.models.join("-"));
        let (dataset, of) = (task.output.dataset.clone(), task.infer.models.clone());
        run_at(stage, 0, Arc::default()).await.unwrap();
        let (store, prefix) = open_store(&place.store()).unwrap();
        let there = Predictions::open(store, prefix.join(dataset))
            .await
            .unwrap();
        let manifest = there.manifest(0).await.unwrap();
        let found = manifest.two_bounce_times.map(|times| match times {
            TimesUsed::Truth => String::new(),
            TimesUsed::Model(model) => model.name,
        });
        assert_eq!(found.as_deref(), times, "{of:?}");
        let predicted = there.read(0).await.unwrap();
        assert_eq!(
            predicted.depth_m.is_empty(),
            !of.contains(&"n".to_owned()),
            "{of:?}"
        );
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn models_that_do_not_fit_are_refused_by_name_and_nothing_is_made() {
    let place = Place::new().await;
    place.train_all().await;
    let short = json!({"epochs": 1, "batch": 2});
    run(place.training(json!({"model": "n", "seed": 9, "optimise": short})))
        .await
        .unwrap();
    let one = json!({"target": "shadow", "model": "one", "histogram": "transient_spots", "spots": [1], "optimise": short});
    run(place.training(one)).await.unwrap();
    for (more, part) in [
        (
            json!({"models": ["m", "n"]}),
            "\"m\" and \"n\" both predict \"tof\"",
        ),
        (
            json!({"models": ["m", "nobody"]}),
            "infer.models[1]: model: ",
        ),
        (
            json!({"models": ["one"], "histogram": "transient"}),
            "trained on histograms of 1 spots, these are of 2",
        ),
        (json!({"histogram": "transient_4"}), "infer.histogram"),
        (json!({"version": "other"}), "infer.version"),
    ] {
        let said = refused(place.inference(more)).await;
        assert!(said.contains(part), "{said}");
    }
    for (name, form, part) in [
        (
            "fine",
            [SIDE, 12],
            "\"m\" was trained on 8 bins of 1.5 m from 1 m, but the data set has 12",
        ),
        (
            "odd",
            [7, BINS],
            "\"m\" takes images whose sides are multiples of 2; the data set has 7x7 pixels",
        ),
    ] {
        place.publish(name, 0, form).await;
        let said = refused(of(&place, name, &["m"])).await;
        assert!(
            said.contains("infer.models[0]: ") && said.contains(part),
            "{said}"
        );
    }
    assert_eq!(place.files("seen").len(), 0);
    place.infer(json!({"models": ["one"]}), 0).await.unwrap();
    assert_eq!(place.seen().await.spec().spots, [1]);
    place.publish("more", 0, [SIDE, BINS]).await;
    let mut onto = of(&place, "more", &["m"]);
    let TaskSpec::Infer(task) = &mut onto.task else {
        panic!("{onto:?}")
    };
    task.output.dataset = "rooms".into();
    let said = refused(onto).await;
    assert!(
        said.contains("output.dataset") && said.contains("is a data set"),
        "{said}"
    );
    place.forget("rooms/manifests/5.json");
    let said = match place.infer(json!({"models": ["one"]}), 5).await {
        Err(TaskError::User(text)) => text,
        other => panic!("{other:?}"),
    };
    assert!(said.contains("scene 5 is not there"), "{said}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_report_is_made_once_of_models_and_what_is_said_of_them() {
    let place = Place::new().await;
    place.train_all().await;
    run(place.evaluation(json!({"models": ["m", "sh"]})))
        .await
        .unwrap();
    let all = json!({"models": ["m", "sh", "s"], "title": "All of them"});
    let control = Arc::new(Control::default());
    let first = run_at(place.report(all.clone()), 0, control.clone())
        .await
        .unwrap();
    assert_eq!((first.adopted, control.fraction()), (false, 1.0));
    let files = place.files("reports/main");
    let names: Vec<&str> = files.keys().map(|path| path.to_str().unwrap()).collect();
    assert_eq!(names, ["manifest.json", "report.html", "report.json"]);
    let text = |name: &str| {
        let bytes = &files[std::path::Path::new(name)];
        String::from_utf8(bytes.clone()).unwrap()
    };
    let page = text("report.html");
    assert!(page.contains("<title>All of them</title>") && page.contains("3 models"));
    assert!(page.contains("<svg") && page.contains("data:image/png"));
    let document: Value = serde_json::from_str(&text("report.json")).unwrap();
    assert_eq!(document["models"][1]["name"], "sh");
    assert!(document["models"][1]["evaluated"]["metrics"]["iou"].is_number());
    assert!(document["models"][2]["evaluated"].is_null());
    let manifest: Value = serde_json::from_str(&text("manifest.json")).unwrap();
    assert_eq!(manifest["models"][0]["name"], "m");
    assert!(manifest["models"][0]["evaluation"].is_string());
    assert!(manifest["models"][2]["evaluation"].is_null());
    let again = run(place.report(all.clone())).await.unwrap();
    assert_eq!(
        (again.adopted, &again.manifest_sha256),
        (true, &first.manifest_sha256)
    );
    // Simulates a kill before the manifest was written.
    place.forget("reports/main/manifest.json");
    place.forget("reports/main/report.json");
    assert!(!run(place.report(all.clone())).await.unwrap().adopted);
    assert_same(&place.files("reports/main"), &files);
    // A new evaluation exists now, but the report's name belongs to the earlier results.
    run(place.evaluation(json!({"models": ["s"]})))
        .await
        .unwrap();
    let said = refused(place.report(all)).await;
    assert!(said.contains("choose another name"), "{said}");
    for (more, part) in [
        (
            json!({"name": "x", "models": ["m", "nobody"]}),
            "report.models[1]",
        ),
        (json!({"name": "x", "version": "other"}), "report.version"),
    ] {
        let said = refused(place.report(more)).await;
        assert!(said.contains(part), "{said}");
    }
}
