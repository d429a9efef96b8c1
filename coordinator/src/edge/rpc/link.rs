//! What the services share: the way to the actor and to the catalog, and the forms of errors.

use std::sync::Arc;

use picofarm_catalog::{Catalog, CatalogError, JobQuery, Page, Specs};
use picofarm_proto::{
    convert::ConvertError,
    ids::JobId,
    messages::{JobState, JobStatus},
    spec::{SpecError, bounds},
    wire,
};
use tokio::sync::{mpsc, oneshot, watch};
use tokio_util::sync::CancellationToken;
use tonic::{Request, Status};

use super::examinations::Examinations;
use crate::{
    actor::{Command, Lanes, Refusal, Reply},
    auth::{Caller, Visibility},
    core::{Clock, recorded_status},
    memory::{Account, stored_cost},
    observe::audit::Audit,
    submission::Submissions,
};

/// State shared by the services.
#[derive(Clone)]
pub(crate) struct Link {
    pub commands: mpsc::Sender<Command>,
    pub revision: watch::Receiver<u64>,
    pub catalog: Arc<dyn Catalog>,
    pub stop: CancellationToken,
    /// Which jobs of others callers see.
    pub visibility: Visibility,
    pub audit: Audit,
    /// Name of this coordinator, for display.
    pub name: Arc<str>,
    pub clock: Clock,
    pub lease_ms: u32,
    pub heartbeat_ms: u32,
    pub lanes: Lanes,
    pub submissions: Submissions,
    /// Examinations of workers that wait for answers.
    pub examinations: Arc<Examinations>,
}

impl Link {
    /// Sends a request to the actor and waits for its answer.
    pub(crate) async fn ask<T>(
        &self,
        command: impl FnOnce(Reply<T>) -> Command,
    ) -> Result<T, Status> {
        let (reply, answer) = oneshot::channel();
        let gone = || {
            Status::unavailable("the coordinator is stopping or cannot use its catalog; try again")
        };
        self.commands
            .send(command(reply))
            .await
            .map_err(|_| gone())?;
        answer.await.map_err(|_| gone())?.map_err(refused)
    }

    /// Reads the catalog without the actor.
    pub(crate) async fn read<T, F>(
        &self,
        work: impl FnOnce(Arc<dyn Catalog>) -> F + Send + 'static,
    ) -> Result<T, Status>
    where
        T: Send + 'static,
        F: Future<Output = Result<T, CatalogError>>,
    {
        let catalog = Arc::clone(&self.catalog);
        let read = self.lanes.read(move || work(catalog)).await;
        read.map_err(broken)
    }

    /// Returns a page of the list of jobs, with forecasts.
    pub(crate) async fn page(&self, query: JobQuery) -> Result<Page, Status> {
        let read = self.read(move |catalog| async move { catalog.page(&query).await });
        let mut page = read.await?;
        if page.jobs.iter().any(|job| job.state == JobState::Active) {
            let left = self.ask(Command::Forecasts).await?;
            for job in &mut page.jobs {
                job.left_s = left.get(&job.id).copied();
            }
        }
        Ok(page)
    }

    /// Returns a job's status for display.
    pub(crate) async fn status(&self, account: &Account, id: JobId) -> Result<JobStatus, Status> {
        let bytes = self.catalog.spec_bytes(Specs::Job(id)).await;
        let bytes = bytes.map_err(broken)?;
        let what = "reading the job's spec";
        let charge = account.charge(what, stored_cost(bytes)).await?;
        let recorded = self.read(move |catalog| async move {
            // The charge lasts as long as the spec is in memory, even if nobody waits for it any
            // more.
            let _charge = charge;
            Ok(catalog.job(id).await?.map(recorded_status))
        });
        let mut status = recorded
            .await?
            .ok_or_else(|| refused(Refusal::NoSuchJob(id)))?;
        let mut overlay = self.ask(|reply| Command::Overlay(Some(id), reply)).await?;
        overlay.complete(&mut status);
        Ok(status)
    }

    /// A job as it was submitted.
    pub(super) async fn spec(&self, account: &Account, id: JobId) -> Result<wire::JobSpec, Status> {
        let bytes = self.catalog.spec_bytes(Specs::Job(id)).await;
        let bytes = bytes.map_err(broken)?;
        let what = "reading the job's spec";
        let charge = account.charge(what, stored_cost(bytes)).await?;
        let read = self.read(move |catalog| async move {
            // For as long as the spec is in memory, also where nobody waits for it any more.
            let _charge = charge;
            let record = catalog.job(id).await?;
            Ok(record.map(|record| wire::JobSpec::from((*record.job.spec).clone())))
        });
        read.await?.ok_or_else(|| refused(Refusal::NoSuchJob(id)))
    }

    /// Where a job stands.
    pub(crate) async fn state(&self, id: JobId) -> Result<JobState, Status> {
        let state = self.catalog.state(id).await;
        state
            .map_err(broken)?
            .ok_or_else(|| refused(Refusal::NoSuchJob(id)))
    }
}

/// Converts a refusal to the status that a caller receives.
pub(crate) fn refused(why: Refusal) -> Status {
    match why {
        Refusal::NoSuchJob(id) => no_such_job(id),
        Refusal::Denied(why) => Status::permission_denied(bounds::message(&why)),
        Refusal::Spec(why) => at_field(&why),
        Refusal::Content(why) => Status::invalid_argument(bounds::message(&format!(
            "the catalog cannot hold this: {why}"
        ))),
        Refusal::TooMany(why) => Status::resource_exhausted(why),
        Refusal::NotNow(why) => Status::failed_precondition(why),
        Refusal::Catalog(why) => Status::unavailable(why),
    }
}

/// The answer to a spec with a field that cannot be used, which it names apart from the words.
pub(super) fn at_field(why: &SpecError) -> Status {
    let mut status = Status::invalid_argument(bounds::message(&why.to_string()));
    // A name with characters that no header has is in the words alone.
    if let Ok(field) = why.field.parse() {
        status.metadata_mut().insert(SpecError::HEADER, field);
    }
    status
}

/// Why the catalog could not be read, as a caller hears it: what it refuses for its content is the
/// caller's error.
pub(super) fn broken(error: CatalogError) -> Status {
    match error {
        CatalogError::Refused { what, .. } => Status::invalid_argument(bounds::message(&what)),
        error => Status::unavailable(bounds::message(&error.to_string())),
    }
}

/// Returns the caller of a request.
pub(super) fn caller<T>(request: &Request<T>) -> Caller {
    let caller = request.extensions().get::<Caller>();
    caller
        .expect("the guard stands before every service")
        .clone()
}

/// Returns the account charged for a request.
pub(super) fn account<T>(request: &Request<T>) -> Account {
    let account = request.extensions().get::<Account>();
    account.expect("each request is charged").clone()
}

/// Converts an error to a status. The error may quote the request, and the message of a status is a
/// header, which must be short.
pub(super) fn invalid(error: ConvertError) -> Status {
    Status::invalid_argument(bounds::message(&error.to_string()))
}

/// Returns the answer for a job that does not exist or that the caller may not see.
pub(super) fn no_such_job(job: JobId) -> Status {
    Status::not_found(format!(
        "there is no job {job}; list the jobs to see their ids"
    ))
}
