//! Reads and checks the requests of clients.

use picofarm_catalog::{JobQuery, Sight};
use picofarm_proto::{
    ids::JobId,
    spec::{JobSpec, StageSpec, bounds},
    wire,
};
use tonic::Status;

use super::link::invalid;
use crate::{
    auth::{Caller, OwnCode, Quotas},
    memory::{Account, Charge},
    submission::Draft,
};

/// Default number of jobs in one answer; the constant below is the largest.
const JOBS: u32 = 100;
const MOST_JOBS: u32 = 1_000;

fn wrong(field: &str, what: &str) -> Status {
    Status::invalid_argument(format!("{field}: {what}"))
}

/// Reads the text by which a list is filtered; empty means no filter.
pub(super) fn filter(text: String, field: &str) -> Result<Option<String>, Status> {
    if text.is_empty() {
        return Ok(None);
    }
    let checked = bounds::name(&text, bounds::NAME_BYTES);
    checked.map_err(|what| wrong(field, &what))?;
    Ok(Some(text))
}

/// The name by which callers find their own latest job.
const LAST: &str = "last";

/// Reads the query of a list.
pub(super) fn listing(
    mut request: wire::ListJobsRequest,
    by: &Caller,
    sight: Sight,
) -> Result<JobQuery, Status> {
    if request.find == LAST {
        request.find.clear();
        request.user = by.name.to_string();
        request.page_size = 1;
    }
    let state = match wire::JobState::try_from(request.state) {
        Ok(wire::JobState::Unspecified) => None,
        Ok(state) => Some(state.try_into().map_err(invalid)?),
        Err(_) => return Err(wrong("state", "is no state of a job")),
    };
    let before = match request.page_token.as_str() {
        "" => None,
        token => Some(token.parse().map_err(|_| {
            wrong(
                "page_token",
                "expected next_page_token of an earlier answer",
            )
        })?),
    };
    Ok(JobQuery {
        sight,
        before,
        limit: match request.page_size {
            0 => JOBS,
            n => n.min(MOST_JOBS),
        },
        state,
        user: filter(request.user, "user")?,
        find: filter(request.find, "find")?,
    })
}

/// Reads and checks a spec.
pub(super) fn draft(
    wire: wire::JobSpec,
    bytes: usize,
    (quotas, own_code): (&Quotas, &OwnCode),
    by: &Caller,
    charged: (Account, Charge),
) -> Result<Draft, Status> {
    let spec = JobSpec::try_from(wire).map_err(invalid)?;
    spec.check_submitted().map_err(|e| invalid(e.into()))?;
    by.may_submit(&spec, quotas.max_priority)
        .map_err(|e| invalid(e.into()))?;
    own_code.check(&spec).map_err(|e| invalid(e.into()))?;
    let most = quotas.tasks_per_job;
    let tasks: u64 = spec.stages.iter().map(StageSpec::tasks).sum();
    if tasks > most {
        return Err(Status::resource_exhausted(format!(
            "the job's {tasks} tasks are more than the {most} that --max-tasks-per-job allows; split the job"
        )));
    }
    Ok(Draft::new(spec, bytes).charged(charged))
}

/// Reads the id of a job.
pub(super) fn job_id(text: &str) -> Result<JobId, Status> {
    text.parse()
        .map_err(|e| Status::invalid_argument(bounds::message(&format!("job_id: {e}"))))
}
