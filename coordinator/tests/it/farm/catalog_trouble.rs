//! The catalog's file is on a full disk, deleted, or replaced while the coordinator runs. Only
//! durable work is accepted, the coordinator reports the fault, and it recovers by itself.

use std::{path::PathBuf, process::Command};

use picofarm_database::CatalogPlace;
use picofarm_proto::{messages::JobState, wire};

use crate::farm::harness::{Farm, catalog_of, rendering, spec};

/// A small file system, unmounted when the value is dropped.
struct Disk(tempfile::TempDir);

impl Disk {
    /// Mounts a disk. Returns `None`, with a note on stderr, if the system does not allow mounting.
    fn mount() -> Option<Self> {
        let folder = tempfile::tempdir().unwrap();
        let tried = Command::new("mount")
            .args(["-t", "tmpfs", "-o", "size=4m", "picofarm-test"])
            .arg(folder.path())
            .output();
        match tried {
            Ok(output) if output.status.success() => Some(Self(folder)),
            tried => {
                eprintln!("skipped: a tmpfs cannot be mounted here ({tried:?})");
                None
            }
        }
    }

    /// Writes until the disk is full.
    fn fill(&self) {
        use std::io::Write;
        let mut file = std::fs::File::create(self.0.path().join("ballast")).unwrap();
        while file.write_all(&[1; 1024]).is_ok() {}
    }

    fn free(&self) {
        std::fs::remove_file(self.0.path().join("ballast")).unwrap();
    }
}

impl Drop for Disk {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("-l").arg(self.0.path()).status();
    }
}

/// Submits a job that the coordinator cannot accept now. Returns the message.
async fn refused(farm: &mut Farm, n: u64) -> String {
    let mut job = spec(3);
    rendering(&mut job).output.dataset = format!("refused-{n}");
    // A long text, so that it fits no existing page.
    rendering(&mut job).render.renderer = "r".repeat(4_000);
    let request = wire::SubmitJobRequest {
        spec: Some(job.into()),
        again: false,
    };
    match farm.jobs.submit_job(request).await {
        Ok(taken) => panic!("taken: {taken:?}"),
        Err(status) => status.message().to_owned(),
    }
}

#[tokio::test]
async fn a_full_disk_makes_it_unready_until_there_is_room_and_loses_nothing() {
    let Some(disk) = Disk::mount() else {
        return;
    };
    let path = disk.0.path().join("catalog.db");
    let mut farm = Farm::start_on(Some(CatalogPlace::Sqlite(path))).await;
    let before = farm.submit(&spec(6)).await.job_id;
    let mut worker = farm.worker().await;
    let lease = worker.lease().await;
    assert!(worker.done(&lease, lease.lo).await.accepted);
    disk.fill();
    // Text that fits into existing pages is durable. Afterwards there is no room.
    for n in 0.. {
        let mut job = spec(1);
        rendering(&mut job).output.dataset = format!("filler-{n}");
        rendering(&mut job).render.renderer = "r".repeat(4_000);
        let request = wire::SubmitJobRequest {
            spec: Some(job.into()),
            again: false,
        };
        if farm.jobs.submit_job(request).await.is_err() {
            break;
        }
    }
    farm.until_ready(Some("the catalog's disk is full")).await;
    // The state persists: no life begins that could not keep a promise.
    for n in 0..60 {
        let (status, words) = farm.readiness().await;
        assert!(
            status.contains("503") && words.contains("disk is full"),
            "{words}"
        );
        if n % 20 == 0 {
            let why = refused(&mut farm, n).await;
            assert!(why.contains("disk is full"), "{why}");
        }
        tokio::time::sleep(std::time::Duration::from_millis(50)).await;
    }
    disk.free();
    farm.until_ready(None).await;
    assert_eq!(farm.status(&before).await.tasks.done, 1);
    let mut again = worker.hello.clone();
    if lease.hi > lease.lo + 1 {
        again.held = vec![lease.lease];
    }
    let mut worker = farm.connect(again).await.unwrap();
    for index in lease.lo + 1..lease.hi {
        assert!(worker.done(&lease, index).await.accepted);
    }
    let done = worker.work(&mut farm, &before).await;
    assert_eq!((done.state, done.tasks.done), (JobState::Done, 6));
    farm.stop().await;
}

fn file_of(farm: &Farm) -> PathBuf {
    match catalog_of(farm) {
        CatalogPlace::Sqlite(path) => path,
        CatalogPlace::Postgres(_) => unreachable!("the tests here have a file"),
    }
}

#[tokio::test]
async fn a_catalog_whose_file_is_moved_away_is_not_used_until_it_is_back() {
    let mut farm = Farm::start().await;
    let job = farm.submit(&spec(2)).await.job_id;
    let path = file_of(&farm);
    let away = path.with_extension("away");
    std::fs::rename(&path, &away).unwrap();
    farm.until_ready(Some("deleted or replaced")).await;
    let why = refused(&mut farm, 0).await;
    assert!(why.contains("deleted or moved away"), "{why}");
    assert!(!path.exists(), "no new one is made in its place");
    std::fs::rename(&away, &path).unwrap();
    farm.until_ready(None).await;
    let mut worker = farm.worker().await;
    assert_eq!(worker.work(&mut farm, &job).await.state, JobState::Done);
}

#[tokio::test]
async fn a_catalog_whose_file_is_replaced_is_left_alone() {
    let mut farm = Farm::start().await;
    let job = farm.submit(&spec(2)).await.job_id;
    let path = file_of(&farm);
    let away = path.with_extension("away");
    std::fs::rename(&path, &away).unwrap();
    std::fs::copy(&away, &path).unwrap();
    let copy = std::fs::read(&path).unwrap();
    let why = refused(&mut farm, 0).await;
    assert!(why.contains("catalog"), "{why}");
    farm.until_ready(Some("another file has taken its place"))
        .await;
    let why = refused(&mut farm, 1).await;
    assert!(why.contains("another file"), "{why}");
    assert_eq!(
        std::fs::read(&path).unwrap(),
        copy,
        "nothing was written into it"
    );
    std::fs::rename(&away, &path).unwrap();
    farm.until_ready(None).await;
    assert_eq!(farm.status(&job).await.tasks.pending, 2);
}
