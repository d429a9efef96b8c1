//! Worker and coordinator together in one process, with a real catalog, real scenes and a real data
//! set.

use crate::common;

use std::{fs, net::SocketAddr, path::Path, time::Duration};

use common::{Gate, Worker, config, output, soon, spec, until};
use picofarm_coordinator::{CoordinatorConfig, Running, serve};
use picofarm_database::CatalogPlace;
use picofarm_dataset::Dataset;
use picofarm_proto::{
    messages::{JobState, JobStatus},
    spec::{JobSpec, RenderTask},
    wire::{self, jobs_client::JobsClient},
};
use picofarm_store::{VerifyMode, open_store};
use picofarm_tests::ports::lasting;
use tokio_util::sync::CancellationToken;

/// A coordinator with its catalog in `dir`.
struct Farm {
    running: Running,
    stop: CancellationToken,
}

impl Farm {
    async fn start(dir: &Path, listen: SocketAddr) -> Self {
        let stop = CancellationToken::new();
        let config = CoordinatorConfig {
            // No lease expires in this test, even if a busy disk delays a transaction.
            lease_ms: 60_000,
            heartbeat_ms: 100,
            ..CoordinatorConfig::new(CatalogPlace::from(dir.join("catalog.sqlite")), listen)
        };
        let running = serve(config, stop.clone()).await.unwrap();
        Self { running, stop }
    }

    fn address(&self) -> SocketAddr {
        self.running.address
    }

    async fn stop(self) -> SocketAddr {
        let address = self.address();
        self.stop.cancel();
        soon("the coordinator's end", self.running.wait())
            .await
            .unwrap();
        address
    }

    async fn client(&self) -> JobsClient<tonic::transport::Channel> {
        JobsClient::connect(format!("http://{}", self.address()))
            .await
            .unwrap()
    }

    async fn submit(&self, spec: &RenderTask) -> String {
        let request = wire::SubmitJobRequest {
            spec: Some(JobSpec::render("test", spec.clone()).into()),
            again: false,
        };
        self.client()
            .await
            .submit_job(request)
            .await
            .unwrap()
            .into_inner()
            .job_id
    }

    async fn job(&self, id: &str) -> JobStatus {
        let request = wire::GetJobRequest { job_id: id.into() };
        let job = self
            .client()
            .await
            .get_job(request)
            .await
            .unwrap()
            .into_inner()
            .job;
        job.unwrap().try_into().unwrap()
    }

    /// Returns the job's status once it has ended.
    async fn ended(&self, id: &str) -> JobStatus {
        soon("the job's end", async {
            loop {
                let job = self.job(id).await;
                if job.state != JobState::Active {
                    return job;
                }
                tokio::time::sleep(Duration::from_millis(50)).await;
            }
        })
        .await
    }
}

fn anywhere() -> SocketAddr {
    ([127, 0, 0, 1], lasting()).into()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_job_is_rendered_to_its_end_and_a_farm_that_forgot_it_adopts_everything() {
    let dir = tempfile::tempdir().unwrap();
    let mut spec = spec(dir.path().join("store").to_str().unwrap());
    spec.scenes.count = 4;
    for adopted in [0, 4] {
        let catalog = tempfile::tempdir().unwrap();
        let farm = Farm::start(catalog.path(), anywhere()).await;
        let shutdown = CancellationToken::new();
        let life = tokio::spawn(picofarm_tasks::run(
            config(farm.address()),
            shutdown.clone(),
        ));
        let id = farm.submit(&spec).await;
        let job = farm.ended(&id).await;
        assert_eq!((job.state, job.tasks.done), (JobState::Done, 4));
        shutdown.cancel();
        let summary = soon("the worker's end", life).await.unwrap().unwrap();
        assert_eq!((summary.adopted, summary.computed), (adopted, 4 - adopted));
        assert_eq!(summary.unacknowledged, 0);
        farm.stop().await;
    }
    let (store, prefix) = open_store(&spec.output.store).unwrap();
    let dataset = Dataset::open(store, prefix.join("tiny")).await.unwrap();
    assert_eq!(dataset.scenes_present().await.unwrap(), [0, 1, 2, 3]);
    assert!(dataset.verify(VerifyMode::Full).await.unwrap().is_sound());
    assert_eq!(
        fs::read_dir(dir.path().join("store/tiny/manifests"))
            .unwrap()
            .count(),
        4
    );
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_restarted_coordinator_gets_what_was_finished_while_it_was_away_and_nothing_runs_twice() {
    let catalog = tempfile::tempdir().unwrap();
    let mut spec = spec("/nowhere");
    spec.scenes.count = 3;
    spec.render.renderer = "fake-1".into();
    let farm = Farm::start(catalog.path(), anywhere()).await;
    let gate = Gate::new();
    let held = gate.clone();
    let mut worker = Worker::start(farm.address(), move |task, control| {
        held.pass(control)?;
        Ok(output(task))
    });
    let id = farm.submit(&spec).await;
    assert_eq!(worker.starts().await, 0);
    let address = farm.stop().await;
    gate.open();
    tokio::time::sleep(Duration::from_millis(300)).await;
    let farm = Farm::start(catalog.path(), address).await;
    let job = farm.ended(&id).await;
    assert_eq!((job.state, job.tasks.done), (JobState::Done, 3));
    assert_eq!([worker.starts().await, worker.starts().await], [1, 2]);
    assert!(worker.started.try_recv().is_err(), "no task ran twice");
    worker.shutdown.cancel();
    assert_eq!(worker.end().await.unwrap().computed, 3);
    farm.stop().await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_cancelled_job_stops_its_running_task_and_a_leaving_worker_gives_its_task_back() {
    let catalog = tempfile::tempdir().unwrap();
    let mut spec = spec("/nowhere");
    spec.render.renderer = "fake-1".into();
    let farm = Farm::start(catalog.path(), anywhere()).await;
    let stopped = std::sync::Arc::new(std::sync::atomic::AtomicU32::new(0));
    let count = stopped.clone();
    let gate = Gate::new();
    let mut worker = Worker::start(farm.address(), move |task, control| {
        gate.pass(control).inspect_err(|_| {
            count.fetch_add(1, std::sync::atomic::Ordering::SeqCst);
        })?;
        Ok(output(task))
    });
    let id = farm.submit(&spec).await;
    worker.starts().await;
    let request = wire::CancelJobRequest { job_id: id };
    farm.client().await.cancel_job(request).await.unwrap();
    until("the task to stop", || {
        stopped.load(std::sync::atomic::Ordering::SeqCst) == 1
    })
    .await;

    spec.scenes.seed += 1;
    let id = farm.submit(&spec).await;
    worker.starts().await;
    worker.shutdown.cancel();
    worker.end().await.unwrap();
    let job = farm.job(&id).await;
    assert_eq!(
        (job.tasks.leased, job.tasks.pending),
        (0, 100),
        "given back, not left to run out"
    );
    farm.stop().await;
}
