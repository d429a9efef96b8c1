//! Connecting to coordinators: the first of several that answers, and why the others do not.

use std::time::Duration;

use picofarm_coordinator::auth::ACCEPTED;
use picofarm_proto::wire::{self, jobs_client::JobsClient};
use picofarm_tasks::{Access, Bearer, ConnectionFailure, Target, lost_connection};
use tonic::{Code as Grpc, Response, Status, transport::Endpoint};

use super::{Jobs, refused};
use crate::error::{CliError, Code, Result};

/// Timeout of a connection attempt, and of the coordinator's first answer if there is another
/// coordinator to try.
pub(super) const CONNECT: Duration = Duration::from_secs(5);
/// Timeout of the first answer of the last coordinator in a list.
const LAST: Duration = Duration::from_secs(15);
/// Interval between pings on a connection, and timeout of their answer.
const PING: Duration = Duration::from_secs(10);

/// The reason why a coordinator gave no usable answer.
pub(super) enum NoAnswer {
    /// It refused; another coordinator would do the same.
    Refused(CliError),
    /// It, or the connection to it, reported that it cannot answer; another coordinator may.
    Unavailable(CliError),
    /// It was silent or unreachable; another coordinator may answer.
    Silent(CliError),
}

impl NoAnswer {
    fn silent(did: impl std::fmt::Display, hint: &str) -> Self {
        Self::Silent(CliError::new(Code::Coordinator, did).hint(hint))
    }

    /// Returns the error of a silent coordinator.
    ///
    /// # Errors
    /// Fails with the refusal if the coordinator refused.
    pub(super) fn silence(self) -> Result<CliError> {
        match self {
            Self::Refused(error) => Err(error),
            Self::Unavailable(error) | Self::Silent(error) => Ok(error),
        }
    }
}

/// Returns the answer within a time.
pub(super) async fn answer<T>(
    within: Duration,
    call: impl Future<Output = std::result::Result<Response<T>, Status>>,
) -> Result<T, NoAnswer> {
    match tokio::time::timeout(within, call).await {
        Ok(Ok(reply)) => Ok(reply.into_inner()),
        Ok(Err(status)) if lost_connection(&status) || status.code() == Grpc::Unavailable => {
            Err(NoAnswer::Unavailable(refused(&status)))
        }
        Ok(Err(status)) => Err(NoAnswer::Refused(refused(&status))),
        Err(_) => Err(NoAnswer::silent(
            format!("it did not answer within {} s", within.as_secs()),
            "it may be frozen or overloaded: see its log and /healthz, then run the same command again",
        )),
    }
}

/// Formats each coordinator as "URL (error)".
pub(super) fn list(silent: &[(&str, CliError)]) -> String {
    let each = silent
        .iter()
        .map(|(url, error)| format!("{url} ({})", error.message));
    each.collect::<Vec<_>>().join(", ")
}

/// Returns the error for the case that no coordinator answers.
pub(super) fn none_answers(silent: &[(&str, CliError)]) -> CliError {
    let error = CliError::new(
        Code::Coordinator,
        format!("no coordinator answers at {}", list(silent)),
    );
    CliError {
        hint: silent.first().and_then(|(_, error)| error.hint.clone()),
        ..error
    }
}

/// Connects to the first of these coordinators that answers.
///
/// # Errors
/// Fails if the settings are unusable for one of them, or if none answers. The error describes each
/// coordinator.
pub(super) async fn first_that_answers<'a>(
    urls: &[&'a str],
    access: &Access,
) -> Result<(Jobs, &'a str)> {
    let (mut silent, mut wrong) = (Vec::new(), None);
    for (i, url) in urls.iter().enumerate() {
        // The last coordinator has a longer timeout, because there is no other to try.
        let within = match i + 1 == urls.len() {
            true => LAST,
            false => CONNECT,
        };
        match connect_to(url, access, within).await {
            Ok(jobs) => return Ok((jobs, *url)),
            Err(no) => match no.silence() {
                Ok(error) => silent.push((*url, error)),
                // A wrong setting for one coordinator does not prevent another from answering.
                Err(error) => {
                    wrong.get_or_insert(error);
                }
            },
        }
    }
    let Some(wrong) = wrong else {
        return Err(none_answers(&silent));
    };
    let message = match silent.is_empty() {
        true => wrong.message,
        false => format!(
            "{}; no coordinator answers at {}",
            wrong.message,
            list(&silent)
        ),
    };
    Err(CliError { message, ..wrong })
}

/// Connects to one coordinator and waits for its first answer, each with a timeout.
pub(super) async fn connect_to(
    url: &str,
    access: &Access,
    within: Duration,
) -> Result<Jobs, NoAnswer> {
    let target = access
        .target(url)
        .map_err(|e| NoAnswer::Refused(CliError::input(format!("coordinator: {e}"))))?;
    let endpoint = lively(target.endpoint.clone()).connect_timeout(CONNECT);
    let channel = match tokio::time::timeout(CONNECT, endpoint.connect()).await {
        Ok(Ok(channel)) => channel,
        Ok(Err(e)) => return Err(no_connection(&target, &e).await),
        Err(_) => return Err(mute("it did not complete the connection", CONNECT)),
    };
    let mut jobs = JobsClient::with_interceptor(channel, target.bearer.clone())
        .max_decoding_message_size(64 << 20);
    // A client certificate is refused only after the handshake, and a TLS port refuses plain HTTP
    // only on the first request. The first call reveals both.
    let first = jobs.get_server_info(wire::GetServerInfoRequest {});
    match tokio::time::timeout(within, first).await {
        Ok(Err(status)) if lost_connection(&status) => Err(no_connection(&target, &status).await),
        Ok(_) => Ok(jobs),
        Err(_) => Err(mute("it took the connection and did not answer", within)),
    }
}

/// Enables pings, so that a connection to a frozen or vanished coordinator ends.
fn lively(endpoint: Endpoint) -> Endpoint {
    endpoint
        .tcp_nodelay(true)
        .http2_keep_alive_interval(PING)
        .keep_alive_timeout(PING)
        .keep_alive_while_idle(true)
}

fn down(did: impl std::fmt::Display) -> NoAnswer {
    NoAnswer::silent(
        did,
        "start one with `picofarm up`, or name another with --coordinator or PICOFARM_COORDINATOR",
    )
}

fn mute(did: &str, within: Duration) -> NoAnswer {
    down(format!("{did} within {} s", within.as_secs()))
}

/// Returns the reason why there is no connection.
async fn no_connection(
    target: &Target,
    error: &(dyn std::error::Error + Send + Sync + 'static),
) -> NoAnswer {
    match tokio::time::timeout(CONNECT, target.diagnose(error)).await {
        Ok(ConnectionFailure::Mismatch(what)) => {
            NoAnswer::Refused(CliError::new(Code::Coordinator, what))
        }
        Ok(ConnectionFailure::Down(why)) => down(why),
        Err(_) => mute("it did not complete the connection", CONNECT),
    }
}

/// A coordinator's answer about a proof.
pub enum Standing {
    /// It accepts callers with this proof, for this reason.
    Accepted(String),
    /// It refuses callers with this proof.
    Refused(String),
    /// It cannot be asked.
    Unknown(String),
}

/// Asks the coordinator at `url` whether a proof is accepted. `proof` is the SHA-256 of a token, or
/// the name in a client certificate, with the scheme as prefix.
pub async fn standing(url: &str, access: &Access, proof: &str) -> Standing {
    let words = |no: NoAnswer| no.silence().unwrap_or_else(|refused| refused).message;
    // The request is not about the caller, so the caller's own token is not sent.
    let asker = Access {
        token: None,
        ..access.clone()
    };
    let ask = async {
        let target = asker.target(url).map_err(|e| e.to_string())?;
        let bearer = Bearer::plain(proof).map_err(|e| e.to_string())?;
        let endpoint = lively(target.endpoint.clone()).connect_timeout(CONNECT);
        let channel = match endpoint.connect().await {
            Ok(channel) => channel,
            Err(e) => return Err(words(no_connection(&target, &e).await)),
        };
        let mut jobs = JobsClient::with_interceptor(channel, bearer);
        match jobs.get_server_info(wire::GetServerInfoRequest {}).await {
            Ok(_) => Ok(Standing::Accepted("it asks nobody for a token".into())),
            Err(status) => match status.metadata().get(ACCEPTED).map(|v| v.as_bytes()) {
                Some(b"yes") => Ok(Standing::Accepted(status.message().to_owned())),
                Some(b"no") => Ok(Standing::Refused(status.message().to_owned())),
                _ if lost_connection(&status) => Err(words(no_connection(&target, &status).await)),
                _ => Err(format!(
                    "it is of a version that does not answer this question ({})",
                    status.message()
                )),
            },
        }
    };
    match tokio::time::timeout(2 * CONNECT, ask).await {
        Ok(Ok(standing)) => standing,
        Ok(Err(why)) => Standing::Unknown(why),
        Err(_) => Standing::Unknown(format!(
            "it did not answer within {} s",
            (2 * CONNECT).as_secs()
        )),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_coordinator_that_takes_connections_and_never_answers_is_left() {
        let mute = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let mute = format!("http://{}", mute.local_addr().unwrap());
        let soon = Duration::from_millis(100);
        let Err(no) = connect_to(&mute, &Access::default(), soon).await else {
            panic!("nobody answers");
        };
        let said = no.silence().map(|error| error.message).unwrap();
        assert!(
            said.contains("took the connection and did not answer"),
            "{said}"
        );
        let never = std::future::pending::<std::result::Result<Response<()>, Status>>();
        let Err(no) = answer(soon, never).await else {
            panic!("nobody answers");
        };
        let silent = [
            ("http://a", no.silence().unwrap()),
            ("http://b", CliError::input("x")),
        ];
        let error = none_answers(&silent);
        assert_eq!(error.code, Code::Coordinator);
        let said =
            "no coordinator answers at http://a (it did not answer within 0 s), http://b (x)";
        assert_eq!(error.message, said);
    }
}
