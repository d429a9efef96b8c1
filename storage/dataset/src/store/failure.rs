//! What a store's error means: a short account of it, free of secrets, and the hint that goes with it.

use std::io;

use object_store::Error;
use object_store::client::{HttpError, HttpErrorKind};

/// An error of a store in words.
pub(crate) struct Failure {
    /// What happened.
    pub account: String,
    /// How to mend it, where known.
    pub hint: Option<&'static str>,
}

impl Failure {
    /// The account of an error of any store.
    pub(crate) fn of(error: &Error) -> Self {
        let chain = chain(error);
        let Some(request) = chain.iter().find_map(|e| Request::parse(&e.to_string())) else {
            let io = chain.last().and_then(|e| e.downcast_ref::<io::Error>());
            return Self {
                account: error.to_string(),
                hint: io.and_then(io_hint),
            };
        };
        let http = chain.iter().find_map(|e| e.downcast_ref::<HttpError>());
        match http {
            Some(http) => {
                let cause = chain.last().expect("it holds at least the error");
                request.unanswered(http.kind(), &cause.to_string())
            }
            None => request.refused(),
        }
    }
}

/// Whether an error says that the whole bucket, not only the object, is missing.
pub(crate) fn no_bucket(error: &Error) -> bool {
    let requests = chain(error).into_iter();
    let mut requests = requests.filter_map(|e| Request::parse(&e.to_string()));
    requests.any(|r| r.code.as_deref() == Some("NoSuchBucket"))
}

fn chain(error: &Error) -> Vec<&(dyn std::error::Error + 'static)> {
    let first: &(dyn std::error::Error + 'static) = error;
    std::iter::successors(Some(first), |&e| e.source()).collect()
}

/// A request that failed, from the words of `object_store`, whose type for it is not public. Of a server's answer only
/// its code and message are kept: some servers repeat tokens and signatures in the rest.
struct Request {
    /// Scheme, host and port.
    server: String,
    /// Of the address, after the server.
    path: String,
    status: Option<u16>,
    code: Option<String>,
    message: Option<String>,
}

impl Request {
    fn parse(text: &str) -> Option<Self> {
        let rest = text.strip_prefix("Error performing ")?;
        let (_, rest) = rest.split_once(' ')?;
        let (url, _) = rest.split_once(' ')?;
        let (scheme, host) = url.split_once("://").unwrap_or_default();
        let (host, path) = host.split_once('/').unwrap_or((host, ""));
        let status = rest.split_once("status code: ").map(|(_, s)| s);
        let status = status.and_then(|s| s.get(..3)?.parse().ok());
        Some(Self {
            server: format!("{scheme}://{host}"),
            path: path.into(),
            status,
            code: element(text, "Code"),
            message: element(text, "Message"),
        })
    }

    /// The server could not be asked.
    fn unanswered(&self, kind: HttpErrorKind, cause: &str) -> Failure {
        let (what, hint) = match kind {
            HttpErrorKind::Timeout => (
                "did not answer in time",
                "check that the server is well; AWS_TIMEOUT, e.g. 600s, gives slow lines more time",
            ),
            HttpErrorKind::Connect => (
                "cannot be reached",
                "check that the server runs, AWS_ENDPOINT_URL, and the network between",
            ),
            _ => (
                "broke off",
                "check that the server is well, then run it again",
            ),
        };
        let role = self.path.starts_with("latest/");
        Failure {
            account: format!("{} {what}: {cause}", self.server),
            hint: Some(if role { NO_CREDENTIALS } else { hint }),
        }
    }

    /// The server said no.
    fn refused(&self) -> Failure {
        let hint = match (self.code.as_deref(), self.status) {
            (Some("NoSuchBucket"), _) => {
                "the bucket does not exist: create it, or correct the store's URL"
            }
            (Some("InvalidAccessKeyId"), _) => {
                "the server does not know this key: check AWS_ACCESS_KEY_ID"
            }
            (Some("SignatureDoesNotMatch"), _) => "check AWS_SECRET_ACCESS_KEY and AWS_REGION",
            (Some("ExpiredToken" | "InvalidToken" | "TokenRefreshRequired"), _) => {
                "renew AWS_SESSION_TOKEN and the keys that belong to it"
            }
            (Some("RequestTimeTooSkewed"), _) => "set this machine's clock",
            (
                Some(
                    "AuthorizationHeaderMalformed"
                    | "PermanentRedirect"
                    | "IllegalLocationConstraintException",
                ),
                _,
            ) => "check AWS_REGION",
            (Some("QuotaExceeded" | "QuotaExceededException"), _) | (_, Some(507)) => {
                "the server is full: free some space, then run it again"
            }
            (_, Some(401)) => "check AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY",
            // Some servers say so too of a bucket that does not exist.
            (_, Some(403)) => {
                "no permission: AWS_ACCESS_KEY_ID needs leave to read, write, list and delete in this bucket; does the \
                 bucket exist?"
            }
            (_, Some(429 | 500..=599)) => "the server is in trouble: try again later",
            (None, _) => "this is not how S3 answers: check AWS_ENDPOINT_URL and AWS_REGION",
            (Some(_), _) => "check AWS_ENDPOINT_URL, AWS_REGION and the store's URL",
        };
        let status = self.status.map_or("an error".into(), |s| s.to_string());
        let words = match (&self.code, &self.message) {
            (Some(code), Some(message)) => format!(" {code}: {message}"),
            (Some(code), None) => format!(" {code}"),
            _ => String::new(),
        };
        Failure {
            account: format!("{} answered {status}{words}", self.server),
            hint: Some(hint),
        }
    }
}

const NO_CREDENTIALS: &str = "no credentials found: set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY; profiles in ~/.aws are not read";

/// The text of the first XML element of this name, cut to a line.
fn element(text: &str, name: &str) -> Option<String> {
    let (_, rest) = text.split_once(&format!("<{name}>"))?;
    let (content, _) = rest.split_once(&format!("</{name}>"))?;
    let line: String = content
        .chars()
        .filter(|c| !c.is_control())
        .take(200)
        .collect();
    Some(line)
}

/// The hint for an error of a file system.
pub(crate) fn io_hint(error: &io::Error) -> Option<&'static str> {
    match error.kind() {
        io::ErrorKind::PermissionDenied => {
            Some("no permission: check the owner and mode of the folder")
        }
        io::ErrorKind::ReadOnlyFilesystem => {
            Some("the file system is mounted read-only: choose another location")
        }
        io::ErrorKind::StorageFull => Some("the disk is full: free some space, then run it again"),
        io::ErrorKind::QuotaExceeded => {
            Some("the disk quota is used up: free some space, then run it again")
        }
        io::ErrorKind::NotADirectory => Some("a part of the path is a file, not a folder"),
        io::ErrorKind::Unsupported => {
            Some("the file system has no hard links, which create-only writes need")
        }
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_full_disk_is_told_with_a_hint() {
        let nested = |kind| Error::Generic {
            store: "LocalFileSystem",
            source: Box::new(Error::Generic {
                store: "inner",
                source: Box::new(io::Error::from(kind)),
            }),
        };
        let hint = |kind| Failure::of(&nested(kind)).hint.unwrap();
        assert!(hint(io::ErrorKind::StorageFull).starts_with("the disk is full: free some space"));
        assert!(hint(io::ErrorKind::ReadOnlyFilesystem).contains("mounted read-only"));
    }

    #[test]
    fn of_an_answer_only_code_and_message_are_told() {
        let body = "<Error><Code>InvalidToken</Code><Message>The token is malformed.</Message>\
                    <Token-0>s3cr3t</Token-0><StringToSign>s3cr3t</StringToSign></Error>";
        let words = format!(
            "Error performing PUT http://127.0.0.1:9/farm/a/b in 3.1ms - Server returned non-2xx status code: \
             400 Bad Request: {body}"
        );
        let error = Error::Generic {
            store: "S3",
            source: words.into(),
        };
        let failure = Failure::of(&error);
        assert_eq!(
            failure.account,
            "http://127.0.0.1:9 answered 400 InvalidToken: The token is malformed."
        );
        assert!(failure.hint.unwrap().contains("AWS_SESSION_TOKEN"));
        assert!(!no_bucket(&error));
    }
}
