//! Models, sweeps and reports of a store, whose names and values try to break pages.

use std::path::Path;

use picofarm_results::{
    Evaluation, Lineage, ModelManifest, Models, NewModel, ReportManifest, ReportedModel, Reports,
    Rung, SplitUsed, TrialEnd, TrialRecord,
};
use picofarm_store::published::Manifest as _;
use serde_json::json;

use crate::{client::Web, farm::EVIL, room};

const ID: &str = "0123456789abcdef";

/// Writes the model `depth` with a sweep, an evaluation and a report into a store.
fn write(store: &Path) {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .unwrap();
    runtime.block_on(async {
        let (at, prefix) = picofarm_store::open_store(&store.display().to_string()).unwrap();
        let models = Models::new(at.clone(), &prefix);
        let manifest = ModelManifest {
            name: "depth".into(),
            kind: "tof".into(),
            training_key: "key".into(),
            settings: json!({"target": "tof", "note": EVIL}),
            lineage: Lineage {
                dataset: "rooms".into(),
                training_scenes: 8,
                ..Lineage::default()
            },
            metrics: json!({"mae_m": 0.25, "word": EVIL}),
            ..ModelManifest::default()
        };
        let history = [1, 2, 3].map(|epoch| {
            let line = json!({"epoch": epoch, "step": 10 * epoch, "loss": 1.0 / f64::from(epoch),
                              "validation": {"mae_m": 0.5 / f64::from(epoch)}});
            format!("{line}\n")
        });
        let objects = vec![
            ("weights.safetensors".to_owned(), "weights".into()),
            ("history.jsonl".to_owned(), history.concat().into()),
        ];
        let published = models.publish(NewModel { manifest, objects }, true).await.unwrap();
        let sha256 = published.manifest.sha256();
        let evaluation = Evaluation {
            key: "evaluation".into(),
            model: "depth".into(),
            model_sha256: sha256.clone(),
            predicts: String::new(),
            dataset: "rooms".into(),
            data: String::new(),
            split: SplitUsed::default(),
            side: EVIL.into(),
            scenes: 2,
            histogram: "transient".into(),
            times: String::new(),
            sensor: false,
            code: "code".into(),
            metrics: json!({"mae_m": 0.2, "by_scene_index": [0, 2], "by_scene": [{"mae_m": 0.1}, {"mae_m": 0.3}]}),
        };
        assert!(models.put_evaluation(&evaluation).await.unwrap());
        for (index, end, losses) in [
            (0, TrialEnd::Finished, &[0.9, 0.25][..]),
            (1, TrialEnd::Pruned, &[1.5]),
            (2, TrialEnd::Diverged(EVIL.into()), &[0.8]),
        ] {
            let line = |(i, mae): (usize, &f64)| json!({"epoch": i + 1, "step": i, "loss": mae, "validation": {"mae_m": mae}});
            let trial = TrialRecord {
                sweep: "depth".into(),
                id: ID.into(),
                index,
                values: [("lr".to_owned(), json!(0.1 * (index + 1) as f64)), ("net".to_owned(), json!(EVIL))].into(),
                over: [].into(),
                model: format!("depth.{index}"),
                kind: "tof".into(),
                training_key: format!("key {index}"),
                end,
                epochs: losses.len() as u64,
                loss: losses.last().copied(),
                history: losses.iter().enumerate().map(line).collect(),
            };
            models.put_trial(&trial).await.unwrap();
        }
        for (index, loss) in [(0, 0.9), (1, 1.5), (3, 0.7)] {
            let rung = Rung { index, epochs: 1, loss };
            models.put_rung("depth", ID, &rung).await.unwrap();
        }
        let report = ReportManifest {
            name: "report".into(),
            models: vec![ReportedModel {
                name: "depth".into(),
                manifest_sha256: sha256,
                ..ReportedModel::default()
            }],
            ..ReportManifest::default()
        };
        let page = format!("<style>p {{ color: red }}</style><p>report {EVIL}</p>");
        let objects = [("report.html", page.into())];
        Reports::new(at, &prefix).publish(report, &objects).await.unwrap();
    });
}

fn shown() -> (tempfile::TempDir, Web) {
    let folder = tempfile::tempdir().unwrap();
    // A store within the folder that the user named, as `up` has it.
    write(&folder.path().join("store"));
    room::write(&folder.path().join("store"));
    let web = Web::start(vec![folder.path().display().to_string()]);
    (folder, web)
}

#[test]
fn models_are_listed_with_what_they_predict_and_their_sweeps() {
    let (_folder, web) = shown();
    let html = web.get("/models").text();
    for text in [
        "/models/model?store=0%2Fstore&amp;name=depth",
        "<td>tof</td>",
        &format!("/models/sweep?store=0%2Fstore&amp;name=depth&amp;id={ID}"),
        "depth MAE",
    ] {
        assert!(html.contains(text), "{text}: {html}");
    }
    assert_eq!(web.get("/models?store=7").status, 404);
    assert_eq!(
        web.get("/models/model?store=0%2Fstore&name=shadow").status,
        404
    );
    assert_eq!(web.get("/models/model?store=0").status, 400);
}

#[test]
fn a_model_has_its_curve_and_its_scenes_by_error() {
    let (_folder, web) = shown();
    let html = web.get("/models/model?store=0%2Fstore&name=depth").text();
    assert_eq!(html.matches("</polyline>").count(), 2, "{html}");
    assert!(!html.contains(EVIL) && html.contains("&lt;script&gt;"));
    // Scene 2 has the larger error.
    let link = |scene: u32| {
        html.find(&format!("set=0%2Fstore%2Frooms&amp;scene={scene}"))
            .expect(&html)
    };
    assert!(link(2) < link(0));
    assert!(
        html.contains("/models/report?store=0%2Fstore&amp;name=report"),
        "{html}"
    );
}

#[test]
fn a_sweep_has_the_reason_of_each_end_and_its_address_the_order() {
    let (_folder, web) = shown();
    let path = format!("/models/sweep?store=0%2Fstore&name=depth&id={ID}");
    let html = web.get(&path).text();
    assert!(!html.contains(EVIL), "{html}");
    for text in [
        "2 of the 3 trials that reached 1 epochs were better",
        "became infinite or no number",
        "it has not ended; 1 epochs are done",
        "trial 0, 0.2500",
    ] {
        assert!(html.contains(text), "{text}: {html}");
    }
    let order = |path: &str| -> Vec<String> {
        let html = web.get(path).text();
        let (_, table) = html.split_once("<tbody>").expect(&html);
        let rows = table.split("<tr>").skip(1);
        let cell = |row: &str| {
            row.split("</td>")
                .next()
                .unwrap()
                .rsplit('>')
                .find(|t| !t.is_empty())
                .unwrap()
                .to_owned()
        };
        rows.map(|row| cell(&row.replace("</a>", ""))).collect()
    };
    assert_eq!(order(&path), ["0", "3", "2", "1"]);
    assert_eq!(order(&format!("{path}&sort=trial")), ["0", "1", "2", "3"]);
    assert_eq!(web.get(&format!("{path}&sort=age")).status, 400);
    assert_eq!(web.get(&path.replace(ID, "ffff")).status, 404);
}

#[test]
fn a_report_is_shown_in_a_sandbox_without_scripts() {
    let (_folder, web) = shown();
    let reply = web.get("/models/report?store=0%2Fstore&name=report");
    assert!(reply.text().contains("<p>report"));
    let policy = reply.header("content-security-policy").unwrap();
    assert!(policy.starts_with("sandbox;"), "{policy}");
    for word in ["script-src", "allow-"] {
        assert!(!policy.contains(word), "{policy}");
    }
    assert!(policy.contains("default-src 'none'"), "{policy}");
    assert_eq!(
        web.get("/models/report?store=0%2Fstore&name=other").status,
        404
    );
}
