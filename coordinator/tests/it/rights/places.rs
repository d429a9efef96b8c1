//! Folders that jobs write into belong to their first submitter.

use picofarm_coordinator::auth::Visibility;
use picofarm_proto::{
    spec::{JobSpec, TaskSpec},
    wire,
};
use tonic::Code;

use crate::rights::harness::{Farm, catalogs, spec};

const STORE: &str = "file:///nowhere";

fn job(name: &str, stage: &str) -> JobSpec {
    let text =
        format!(r#"{{"name": "{name}", "project": "", "stage": [{{"name": "s", {stage}}}]}}"#);
    let mut job: JobSpec = serde_json::from_str(&text).unwrap();
    for stage in &mut job.stages {
        if let Some(version) = stage.task.version_mut() {
            *version = "v1".into();
        }
        if let Some(store) = stage.task.models_store_mut() {
            *store = STORE.into();
        }
    }
    job
}

/// Returns a stage of each kind that would write into ada's data set "rooms", or replace her
/// results, with the field at fault.
fn trespasses() -> Vec<(&'static str, JobSpec)> {
    let source = r#""source": {"store": "file:///nowhere", "dataset": "other"}, "count": 2"#;
    let export = |dest: &str| {
        let stage = format!(r#""kind": "export", {source}, "export": {{"dest": "{dest}"}}"#);
        job(&format!("export to {dest}"), &stage)
    };
    let generate = |dest: &str| {
        let scenes = r#""scenes": {"kind": "primitive", "count": 1, "spots": 4}"#;
        let stage = format!(r#""kind": "generate", {scenes}, "generate": {{"dest": "{dest}"}}"#);
        job(&format!("generate to {dest}"), &stage)
    };
    let output = r#""output": {"store": "/nowhere", "dataset": "rooms"}"#;
    let reprocess =
        format!(r#""kind": "reprocess", {source}, "reprocess": {{"sensor": {{}}}}, {output}"#);
    let mut trespasses = vec![("output.dataset", job("reprocess", &reprocess))];
    for dest in [
        "/nowhere/rooms",
        "file:///nowhere/rooms/",
        "/nowhere//./rooms/deep",
        "/nowhere",
        "/",
    ] {
        trespasses.push(("export.dest", export(dest)));
        trespasses.push(("generate.dest", generate(dest)));
    }
    let mut other_settings = spec("rooms", "");
    other_settings.name = "other settings".into();
    let TaskSpec::Render(task) = &mut other_settings.stages[0].task else {
        panic!("the harness renders");
    };
    task.output.store = "/nowhere".into();
    trespasses.push(("output.dataset", other_settings));
    let mut more_scenes = spec("rooms", "");
    more_scenes.name = "more scenes".into();
    let TaskSpec::Render(task) = &mut more_scenes.stages[0].task else {
        panic!("the harness renders");
    };
    task.scenes.count += 1;
    trespasses.push(("output.dataset", more_scenes));
    trespasses
}

#[tokio::test]
async fn nobody_writes_into_the_folders_of_others() {
    let folder = tempfile::tempdir().unwrap();
    for catalog in catalogs(&folder).await {
        let farm = Farm::start(catalog, Visibility::All).await;
        farm.submit("ada", &spec("rooms", ""), false).await.unwrap();
        for (field, trespass) in trespasses() {
            let at = &trespass.name;
            let refused = farm.submit("bob", &trespass, false).await.unwrap_err();
            assert_eq!(refused.code(), Code::PermissionDenied, "{at}: {refused}");
            for part in [field, "\"ada\"", "/nowhere/rooms/"] {
                assert!(refused.message().contains(part), "{at}: {refused}");
            }
            let plan = wire::PlanJobRequest {
                spec: Some(trespass.clone().into()),
            };
            let planned = farm.jobs("bob").plan_job(plan).await.unwrap_err();
            assert_eq!(
                planned.message(),
                refused.message(),
                "plan and submit agree"
            );
        }
        // A folder with a similar name is a different one.
        farm.submit("bob", &spec("rooms2", ""), false)
            .await
            .unwrap();
        // A job for the same scenes reuses them.
        let mut same = spec("rooms", "");
        same.name = "the same scenes".into();
        farm.submit("bob", &same, false).await.unwrap();
        // The results that bob reuses are not his.
        let (_, trespass) = trespasses().swap_remove(1);
        farm.submit("bob", &trespass, false).await.unwrap_err();
        for who in ["ada", "root"] {
            let (_, mut own) = trespasses().swap_remove(1);
            own.nonce = who.into();
            farm.submit(who, &own, false).await.unwrap();
        }
        farm.stop().await;
    }
}

#[tokio::test]
async fn names_of_models_reports_and_splits_belong_to_their_makers() {
    let folder = tempfile::tempdir().unwrap();
    let source = r#""source": {"store": "file:///nowhere", "dataset": "rooms"}, "count": 4"#;
    let split =
        format!(r#""kind": "split", {source}, "split": {{"name": "half", "counts": [2, 1, 1]}}"#);
    let other_split = split.replace("[2, 1, 1]", "[1, 2, 1]");
    let report = r#""kind": "report", "report": {"name": "all", "store": "file:///nowhere", "models": ["m"]}"#;
    let other_report = report.replace(r#"["m"]"#, r#"["n"]"#);
    for catalog in catalogs(&folder).await {
        let farm = Farm::start(catalog, Visibility::All).await;
        farm.submit("ada", &spec("rooms", ""), false).await.unwrap();
        for (who, name, stage) in [("mia", "split", &*split), ("mia", "report", report)] {
            farm.submit(who, &job(name, stage), false).await.unwrap();
        }
        for (field, stage) in [
            ("split.name", &*other_split),
            ("report.name", &*other_report),
        ] {
            let refused = farm
                .submit("bob", &job("other", stage), false)
                .await
                .unwrap_err();
            assert_eq!(refused.code(), Code::PermissionDenied, "{refused}");
            for part in [field, "\"mia\""] {
                assert!(refused.message().contains(part), "{refused}");
            }
        }
        // The data set is ada's, so its splits are hers too.
        farm.submit("ada", &job("hers", &other_split), false)
            .await
            .unwrap();
        farm.stop().await;
    }
}

#[tokio::test]
async fn a_cancelled_job_that_made_nothing_holds_no_folder_and_hidden_owners_are_not_named() {
    let folder = tempfile::tempdir().unwrap();
    for catalog in catalogs(&folder).await {
        let farm = Farm::start(catalog, Visibility::Own).await;
        let ada = farm.submit("ada", &spec("rooms", ""), false).await.unwrap();
        let (_, trespass) = trespasses().swap_remove(1);
        let refused = farm.submit("bob", &trespass, false).await.unwrap_err();
        assert_eq!(refused.code(), Code::PermissionDenied);
        assert!(!refused.message().contains("ada"), "{refused}");
        assert!(refused.message().contains("may not see"), "{refused}");
        let cancel = wire::CancelJobRequest { job_id: ada.job };
        farm.jobs("ada").cancel_job(cancel).await.unwrap();
        farm.submit("bob", &trespass, false).await.unwrap();
        let refused = farm
            .submit("ada", &spec("rooms", ""), true)
            .await
            .unwrap_err();
        assert_eq!(
            refused.code(),
            Code::PermissionDenied,
            "the folder is bob's now"
        );
        farm.stop().await;
    }
}
