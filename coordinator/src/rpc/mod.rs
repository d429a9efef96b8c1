//! The gRPC services. Protobuf types stay in here; behind it is the checked model.

mod farm;
mod jobs;
mod look;

use std::sync::Arc;

use picofarm_catalog::Catalog;
use picofarm_proto::convert::ConvertError;
use tokio::sync::{mpsc, oneshot, watch};
use tokio_util::sync::CancellationToken;
use tonic::{Request, Status};

use crate::{
    actor::{Command, Refusal, Reply},
    auth::Caller,
    clock::Clock,
};

pub(crate) use farm::FarmService;
pub(crate) use jobs::JobsService;

/// What the services share.
#[derive(Clone)]
pub(crate) struct Link {
    pub commands: mpsc::Sender<Command>,
    pub revision: watch::Receiver<u64>,
    pub catalog: Arc<dyn Catalog>,
    pub stop: CancellationToken,
    /// Names this coordinator, for people.
    pub name: Arc<str>,
    pub clock: Clock,
    pub lease_ms: u32,
    pub heartbeat_ms: u32,
}

impl Link {
    /// Asks the actor and waits for its answer.
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
        match answer.await.map_err(|_| gone())? {
            Ok(answer) => Ok(answer),
            Err(Refusal::NoSuchJob(id)) => Err(Status::not_found(format!(
                "there is no job {id}; list the jobs to see their ids"
            ))),
            Err(Refusal::Spec(why)) => Err(Status::invalid_argument(why.to_string())),
            Err(Refusal::TooMany(why)) => Err(Status::resource_exhausted(why)),
            Err(Refusal::NotNow(why)) => Err(Status::failed_precondition(why)),
            Err(Refusal::Catalog(why)) => Err(Status::unavailable(why)),
        }
    }
}

/// Who called.
fn caller<T>(request: &Request<T>) -> Caller {
    let caller = request.extensions().get::<Caller>();
    caller
        .expect("the guard stands before every service")
        .clone()
}

fn invalid(error: ConvertError) -> Status {
    Status::invalid_argument(error.to_string())
}
