//! Scene files, jobs and messages with content that a database rejects and a terminal would
//! interpret.

use std::{
    path::{Path, PathBuf},
    time::Duration,
};

use picofarm_proto::{
    PROTOCOL,
    wire::{self, farm_client::FarmClient, session_request::Message as Say},
};
use serde_json::Value;

use crate::job::Job;

/// Writes a glTF file that names an extension with a NUL byte, an escape sequence and a line break.
/// No reader knows this extension, and error messages quote it.
///
/// # Panics
/// If it cannot be written.
pub fn scene(folder: &Path, number: u64) -> PathBuf {
    let path = folder.join(format!("poison-{number}.gltf"));
    let name = format!("x\\u0000y\\u001b]0;owned\\u0007\\n{number}");
    let text = format!(
        r#"{{"asset":{{"version":"2.0"}},"extensionsUsed":["{name}"],"extensionsRequired":["{name}"]}}"#
    );
    std::fs::write(&path, text).expect("the test's folder is writable");
    path
}

/// Returns a job with an unreadable scene. The reason for its failure contains a NUL byte.
pub fn job(store: &Path, folder: &Path, number: u64) -> Job {
    let scene = scene(folder, number);
    Job {
        name: format!("poison-{number}"),
        dataset: format!("poison-{number}"),
        max_failures: 1,
        ..Job::files(store, &[&scene])
    }
}

/// Checks that the history of such a job contains the reason for its failure, with nothing that a
/// terminal would interpret.
pub fn assert_told(events: &[Value]) {
    let said = events.iter().any(|e| {
        let message = e["message"].as_str().unwrap_or_default();
        message.contains("owned") && !message.contains(['\0', '\u{1b}', '\n'])
    });
    assert!(said, "the history says which extension it was: {events:?}");
}

/// Opens a session with invalid numbers, and with texts that Postgres rejects and a terminal would
/// interpret.
///
/// # Panics
/// If no runtime can be created.
pub fn lie(url: &str) {
    let name = "w\0orker\x1b]0;owned\x07\nforged line";
    let hello = wire::Hello {
        worker_id: uuid::Uuid::new_v4().to_string(),
        incarnation: uuid::Uuid::new_v4().to_string(),
        name: name.into(),
        version: name.into(),
        protocol: PROTOCOL,
        labels: vec![name.into()],
        assets: vec!["x".repeat(100_000)],
        ..wire::Hello::default()
    };
    let failed = wire::TaskFailed {
        lease: Some(wire::LeaseRef {
            range_id: uuid::Uuid::new_v4().to_string(),
            epoch: u64::MAX,
        }),
        kind: wire::FailureKind::User.into(),
        message: name.into(),
        ..wire::TaskFailed::default()
    };
    let done = wire::TaskDone {
        bytes: u64::MAX,
        seconds: -1e300,
        ..wire::TaskDone::default()
    };
    let said = [Say::Hello(hello), Say::Failed(failed), Say::Done(done)];
    let said = said.map(|message| wire::SessionRequest {
        message: Some(message),
    });
    let url = url.to_owned();
    let runtime = tokio::runtime::Runtime::new().expect("threads can be had");
    runtime.block_on(async {
        // The coordinator may refuse it or not answer at all.
        let Ok(mut client) = FarmClient::connect(url).await else {
            return;
        };
        if let Ok(answer) = client.session(tokio_stream::iter(said)).await {
            let mut heard = answer.into_inner();
            let enough = Duration::from_secs(2);
            while let Ok(Ok(Some(_))) = tokio::time::timeout(enough, heard.message()).await {}
        }
    });
}
