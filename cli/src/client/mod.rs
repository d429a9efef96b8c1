//! The commands' client for a coordinator: converts between model types and the wire, and adds
//! hints to errors.

mod calls;
mod connection;
mod demand;
pub mod follow;
pub mod jobfile;
pub mod stores;

use std::time::Duration;

use picofarm_proto::{convert::ConvertError, spec::SpecError, wire::jobs_client::JobsClient};
use picofarm_tasks::{Access, Bearer, lost_connection};
use tonic::{
    Code as Grpc, Response, Status, service::interceptor::InterceptedService, transport::Channel,
};

use crate::error::{CliError, Code, Result};

use self::connection::{
    CONNECT, NoAnswer, answer, connect_to, first_that_answers, list, none_answers,
};
pub use self::{
    calls::{Examination, Explained, Listing, Page, Submitted, Watch, Workers},
    connection::{Standing, standing},
    demand::{Demand, PoolWorker, StageDemand},
};

use self::calls::ANSWER;

type Jobs = JobsClient<InterceptedService<Channel, Bearer>>;

/// A connection to a coordinator's job service.
#[derive(Clone)]
pub struct Client {
    jobs: Jobs,
    /// URL of the coordinator in use, and URLs of all coordinators.
    url: String,
    urls: String,
    access: Access,
}

fn refused(status: &Status) -> CliError {
    let code = match status.code() {
        Grpc::InvalidArgument | Grpc::NotFound | Grpc::OutOfRange => Code::Input,
        Grpc::ResourceExhausted => Code::Resource,
        Grpc::Unavailable
        | Grpc::FailedPrecondition
        | Grpc::Unimplemented
        | Grpc::Unauthenticated
        | Grpc::PermissionDenied => Code::Coordinator,
        // A broken stream has another code, but its cause is a lost connection.
        _ if lost_connection(status) => Code::Coordinator,
        _ => Code::Failed,
    };
    let field = status.metadata().get(SpecError::HEADER);
    CliError {
        denied: matches!(
            status.code(),
            Grpc::Unauthenticated | Grpc::PermissionDenied
        ),
        status: Some(status.code()),
        field: field.and_then(|field| Some(field.to_str().ok()?.to_owned())),
        ..CliError::new(code, status.message())
    }
}

fn unreadable(e: ConvertError) -> CliError {
    CliError::new(
        Code::Coordinator,
        format!("the coordinator's answer cannot be read: {e}"),
    )
    .hint("is it of another version? compare `picofarm --version` on both sides")
}

fn required<T>(value: Option<T>, field: &'static str) -> Result<T> {
    value.ok_or_else(|| unreadable(ConvertError::Missing { field }))
}

impl Client {
    /// Connects to the first coordinator that answers. `urls` is a comma-separated list.
    pub async fn connect(urls: &str, access: &Access) -> Result<Self> {
        let all: Vec<_> = urls.split(',').map(str::trim).collect();
        let (client, url) = first_that_answers(&all, access).await?;
        Ok(Self {
            jobs: client,
            url: url.to_owned(),
            urls: urls.to_owned(),
            access: access.clone(),
        })
    }

    /// Connects again.
    pub async fn reconnect(&self) -> Result<Self> {
        Self::connect(&self.urls, &self.access).await
    }

    /// Returns the answer to a call within a time. If the coordinator is silent and there are
    /// others, the first of them that answers is used from then on. This is safe because every call
    /// is idempotent.
    async fn ask<T, F>(&mut self, within: Duration, call: impl Fn(Jobs) -> F) -> Result<T>
    where
        F: Future<Output = std::result::Result<Response<T>, Status>>,
    {
        let others = self.urls.split(',').map(str::trim);
        let others: Vec<_> = others.filter(|url| *url != self.url).collect();
        let mut silent = match answer(within, call(self.jobs.clone())).await {
            Ok(reply) => return Ok(reply),
            Err(NoAnswer::Unavailable(error)) if others.is_empty() => return Err(error),
            Err(error) => vec![(self.url.as_str(), error.silence()?)],
        };
        for url in others {
            let jobs = match connect_to(url, &self.access, CONNECT).await {
                Ok(jobs) => jobs,
                Err(error) => {
                    silent.push((url, error.silence()?));
                    continue;
                }
            };
            match answer(within, call(jobs.clone())).await {
                Ok(reply) => {
                    tracing::warn!("{} is asked from now on: {}", url, list(&silent));
                    (self.jobs, self.url) = (jobs, url.to_owned());
                    return Ok(reply);
                }
                Err(error) => silent.push((url, error.silence()?)),
            }
        }
        Err(none_answers(&silent))
    }

    pub fn url(&self) -> &str {
        &self.url
    }
}
