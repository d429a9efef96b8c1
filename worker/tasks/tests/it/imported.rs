//! Imported networks as models of a store work like those trained here.

use crate::place;

use std::collections::BTreeMap;

use picofarm_dataset::{Dataset, Manifest};
use picofarm_model::weights;
use picofarm_results::NewModel;
use picofarm_store::open_store;
use picofarm_tasks::{ImportFor, NotImported, TaskError, imported};
use serde_json::{Value, json};

use place::*;

struct Rooms {
    dataset: Dataset,
    scene: Manifest,
}

impl Rooms {
    async fn of(place: &Place) -> Self {
        let (store, prefix) = open_store(&place.store()).unwrap();
        let dataset = Dataset::open(store, prefix.join("rooms")).await.unwrap();
        let scene = dataset.manifest(0).await.unwrap();
        Self { dataset, scene }
    }

    fn import(&self, weights: &[u8], settings: Value) -> Result<NewModel, NotImported> {
        let of = ImportFor {
            dataset: "rooms",
            spec: self.dataset.spec(),
            scene: &self.scene,
        };
        imported(weights, settings, of, "net.safetensors")
    }
}

/// Returns a model's tensors as PyTorch would have saved them: without metadata, with the prefix of
/// a wrapper.
async fn foreign(place: &Place, model: &str) -> Vec<u8> {
    let models = place.models();
    let manifest = models.manifest(model).await.unwrap();
    let bytes = models.read(&manifest, "weights.safetensors").await.unwrap();
    let (named, _) = weights::read(&bytes).unwrap();
    let wrapped = named.into_iter().map(|(n, v)| (format!("module.{n}"), v));
    weights::write(&wrapped.collect(), &BTreeMap::new())
}

#[tokio::test(flavor = "multi_thread")]
async fn an_imported_network_answers_as_the_one_it_was() {
    let place = Place::new().await;
    place.train_all().await;
    let rooms = Rooms::of(&place).await;
    let net = json!({"width": 2, "levels": 2});
    for (model, settings) in [
        ("m", json!({"target": "tof", "model": "m2", "net": net})),
        (
            "sh",
            json!({"target": "shadow", "model": "sh2", "net": net}),
        ),
        (
            "s",
            json!({"target": "specular", "model": "s2", "net": net}),
        ),
    ] {
        let new = rooms
            .import(&foreign(&place, model).await, settings)
            .unwrap();
        let models = place.models();
        let published = models.publish(new.clone(), false).await.unwrap();
        let name = published.manifest.name.clone();
        // Importing it again gives the same model.
        let again = models.publish(new, false).await.unwrap();
        assert_eq!(again.manifest, published.manifest);
        let times = if model == "sh" { "depths" } else { "" };
        run(place.evaluation(json!({"models": [model, name], "times": times})))
            .await
            .unwrap();
        let found = |found: Vec<picofarm_results::Evaluation>| found[0].metrics.clone();
        let ours = found(models.evaluations(model).await.unwrap());
        assert_eq!(
            found(models.evaluations(&name).await.unwrap()),
            ours,
            "{model}"
        );
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn what_does_not_fit_is_named() {
    let place = Place::new().await;
    run(place.training(json!({"optimise": {"epochs": 1, "batch": 2}})))
        .await
        .unwrap();
    let rooms = Rooms::of(&place).await;
    let weights = foreign(&place, "m").await;
    let settings = |more: Value| {
        let mut settings = json!({"target": "tof", "model": "i", "net": {"width": 2, "levels": 2}});
        for (name, value) in more.as_object().unwrap() {
            settings[name] = value.clone();
        }
        settings
    };
    assert!(rooms.import(&weights, settings(json!({}))).is_ok());
    for (more, said) in [
        (json!({"net": {"width": 4, "levels": 2}}), "check net.width"),
        (
            json!({"net": {"width": 2, "levels": 3}}),
            "is missing; the weights belong to another network",
        ),
        (json!({"input": {"bins": 4}}), "input.bins"),
        (json!({"target": "shadow"}), "has shape"),
        (json!({"from": "m"}), "train.from"),
        (
            json!({"shadow": {"times": "depths"}, "target": "shadow"}),
            "train.shadow.times",
        ),
        (
            json!({"specular": {"on": "m"}, "target": "specular"}),
            "train.specular.on",
        ),
        (json!({"histogram": "transient_25"}), "train.histogram"),
        (json!({"input": {"normalise": "log"}}), "train.input.max"),
        (json!({"nets": {}}), "nets"),
        (json!({"target": "depth"}), "depth"),
    ] {
        let refused = rooms.import(&weights, settings(more.clone()));
        let refused = refused.unwrap_err().to_string();
        assert!(refused.contains(said), "{more}: {refused}");
    }
    let (mut named, _) = weights::read(&weights).unwrap();
    let (name, (_, values)) = named.iter_mut().next().unwrap();
    let name = name.clone();
    values[0] = f32::NAN;
    let odd = weights::write(&named, &BTreeMap::new());
    let refused = rooms.import(&odd, settings(json!({}))).unwrap_err();
    assert!(matches!(refused, NotImported::Values(_)), "{refused:?}");
    let refused = refused.to_string();
    let part = name.trim_start_matches("module.");
    assert!(
        refused.contains("holds NaN") && refused.contains(part),
        "{refused}"
    );
    for torn in [
        &weights[..weights.len() - 1],
        &weights[..20],
        b"",
        b"PK\x03\x04",
    ] {
        let refused = rooms.import(torn, settings(json!({}))).unwrap_err();
        assert!(matches!(refused, NotImported::File(_)), "{refused:?}");
        assert!(refused.to_string().contains("safetensors"), "{refused}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_negative_variance_is_refused_by_its_name() {
    let place = Place::new().await;
    run(place.training(json!({"optimise": {"epochs": 1, "batch": 2}})))
        .await
        .unwrap();
    let rooms = Rooms::of(&place).await;
    let (mut named, _) = weights::read(&foreign(&place, "m").await).unwrap();
    let variance = named.keys().find(|name| name.ends_with("running_var"));
    let variance = variance.expect("it normalises").clone();
    named.get_mut(&variance).unwrap().1[0] = -0.25;
    let odd = weights::write(&named, &BTreeMap::new());
    let settings = json!({"target": "tof", "model": "i", "net": {"width": 2, "levels": 2}});
    let refused = rooms.import(&odd, settings).unwrap_err();
    assert!(matches!(refused, NotImported::Values(_)), "{refused:?}");
    let (refused, part) = (refused.to_string(), variance.trim_start_matches("module."));
    assert!(
        refused.contains(part) && refused.contains("-0.25 (value 0)"),
        "{refused}"
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn answers_that_are_no_numbers_fail_with_model_and_scene() {
    let place = Place::new().await;
    run(place.training(json!({"optimise": {"epochs": 1, "batch": 2}})))
        .await
        .unwrap();
    let rooms = Rooms::of(&place).await;
    let (mut named, _) = weights::read(&foreign(&place, "m").await).unwrap();
    let matching = named
        .iter_mut()
        .filter(|(name, _)| name.ends_with("weight"));
    for (_, (_, values)) in matching {
        values.fill(3e38);
    }
    let odd = weights::write(&named, &BTreeMap::new());
    let settings = json!({"target": "tof", "model": "odd", "net": {"width": 2, "levels": 2}});
    let new = rooms.import(&odd, settings).unwrap();
    place.models().publish(new, false).await.unwrap();
    let asked = [
        run(place.evaluation(json!({"models": ["odd"]}))).await,
        run(place.inference(json!({"models": ["odd"]}))).await,
    ];
    for said in asked {
        let Err(TaskError::User(said)) = said else {
            panic!("{said:?}")
        };
        assert!(
            said.contains("model \"odd\", scene ") && said.contains("the network answers"),
            "{said}"
        );
    }
    assert!(place.models().evaluations("odd").await.unwrap().is_empty());
}
