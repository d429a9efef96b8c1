//! Descriptions of object store errors.

use object_store::client::{HttpError, HttpErrorKind};

use crate::account::Failure;
use crate::service::Service;

/// Describes an object store's error from its chain of causes; `None` for an error of another kind.
pub(crate) fn failure(
    chain: &[&(dyn std::error::Error + 'static)],
    service: Service,
) -> Option<Failure> {
    let request = chain.iter().find_map(|e| Request::parse(&e.to_string()))?;
    let http = chain.iter().find_map(|e| e.downcast_ref::<HttpError>());
    Some(match http {
        Some(http) => {
            let cause = chain.last().expect("it holds at least the error");
            request.unanswered(service, http.kind(), &cause.to_string())
        }
        None => request.refused(service),
    })
}

/// Returns whether the whole bucket is missing, and not only the object.
pub(crate) fn no_bucket(chain: &[&(dyn std::error::Error + 'static)]) -> bool {
    let mut requests = chain.iter().filter_map(|e| Request::parse(&e.to_string()));
    requests.any(|r| {
        matches!(
            r.code.as_deref(),
            Some("NoSuchBucket" | "ContainerNotFound")
        )
    })
}

/// Returns whether a request or its answer was interrupted, or the server found it corrupted.
pub(crate) fn breaks_off(chain: &[&(dyn std::error::Error + 'static)]) -> bool {
    if chain.iter().any(|e| e.is::<HttpError>()) {
        return true;
    }
    let mut requests = chain.iter().filter_map(|e| Request::parse(&e.to_string()));
    requests.any(|r| {
        r.status == Some(400)
            && r.code
                .is_some_and(|code| code.contains("Digest") || code.contains("SHA256"))
    })
}

/// A failed request, parsed from the message of `object_store`, because the error type is not
/// public. Only the code and message of a server's answer are retained, because some servers repeat
/// tokens and signatures in the rest.
struct Request {
    /// Scheme, host and port.
    server: String,
    /// The rest of the URL after the server.
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

    /// Describes a request that the server did not answer.
    fn unanswered(&self, service: Service, kind: HttpErrorKind, cause: &str) -> Failure {
        let hints = hints(service);
        let (what, hint) = match kind {
            HttpErrorKind::Timeout => ("did not answer in time", hints.slow),
            HttpErrorKind::Connect => ("cannot be reached", hints.away),
            _ => (
                "broke off",
                "check that the server is well, then run it again",
            ),
        };
        Failure {
            account: format!("{} {what}: {cause}", self.server),
            hint: Some(match self.asks_who() {
                true => hints.anonymous,
                false => hint,
            }),
        }
    }

    /// Returns whether it was a request for credentials to a service's metadata server. This is
    /// only sent if no credentials are configured.
    fn asks_who(&self) -> bool {
        ["latest/", "computeMetadata/", "metadata/identity/"]
            .iter()
            .any(|start| self.path.starts_with(start))
    }

    /// Describes a refusal by the server.
    fn refused(&self, service: Service) -> Failure {
        let hint = match (self.code.as_deref(), self.status) {
            _ if self.asks_who() => hints(service).anonymous,
            (Some("NoSuchBucket"), _) => {
                "the bucket does not exist: create it, or correct the store's URL"
            }
            (Some("ContainerNotFound"), _) => {
                "the container does not exist: create it, or correct the store's URL"
            }
            (_, Some(401 | 403)) if service != Service::S3 => hints(service).refused,
            (_, Some(429 | 500..=599)) if service != Service::S3 => TROUBLE,
            _ if service != Service::S3 => hints(service).strange,
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
            (_, Some(401)) => hints(service).refused,
            // Some servers return the same for a bucket that does not exist.
            (_, Some(403)) => {
                "no permission: AWS_ACCESS_KEY_ID needs leave to read, write, list and delete in this bucket; does the \
                 bucket exist?"
            }
            (_, Some(429 | 500..=599)) => TROUBLE,
            (None, _) => "this is not how S3 answers: check AWS_ENDPOINT_URL and AWS_REGION",
            (Some(_), _) => hints(service).strange,
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

const TROUBLE: &str = "the server is in trouble: try again later";

/// Hints that name a service's variables.
struct Hints {
    slow: &'static str,
    away: &'static str,
    anonymous: &'static str,
    refused: &'static str,
    strange: &'static str,
}

fn hints(service: Service) -> Hints {
    match service {
        Service::S3 => Hints {
            slow: "check that the server is well; AWS_TIMEOUT, e.g. 600s, gives slow lines more time",
            away: "check that the server runs, AWS_ENDPOINT_URL, and the network between",
            anonymous: "no credentials found: set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY; profiles in ~/.aws are not read",
            refused: "check AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY",
            strange: "check AWS_ENDPOINT_URL, AWS_REGION and the store's URL",
        },
        Service::Gcs => Hints {
            slow: "check the line; GOOGLE_TIMEOUT, e.g. 600s, gives slow ones more time",
            away: "check the network, and GOOGLE_BASE_URL if it is set",
            anonymous: "no credentials found: set GOOGLE_APPLICATION_CREDENTIALS or GOOGLE_SERVICE_ACCOUNT to a file, or run \
                        gcloud auth application-default login",
            refused: "no permission: the account of GOOGLE_APPLICATION_CREDENTIALS or GOOGLE_SERVICE_ACCOUNT needs the role \
                      Storage Object User in this bucket; does the bucket exist?",
            strange: "check the store's URL, and GOOGLE_BASE_URL if it is set",
        },
        Service::Azure => Hints {
            slow: "check the line; AZURE_TIMEOUT, e.g. 600s, gives slow ones more time",
            away: "check the network, AZURE_STORAGE_ACCOUNT_NAME, and AZURE_STORAGE_ENDPOINT if it is set",
            anonymous: "no credentials found: set AZURE_STORAGE_ACCOUNT_KEY, AZURE_STORAGE_SAS_TOKEN, or AZURE_CLIENT_ID, \
                        AZURE_CLIENT_SECRET and AZURE_TENANT_ID",
            refused: "no permission: check AZURE_STORAGE_ACCOUNT_KEY or AZURE_STORAGE_SAS_TOKEN; an identity needs the role \
                      Storage Blob Data Contributor for this container",
            strange: "check AZURE_STORAGE_ACCOUNT_NAME, the store's URL, and AZURE_STORAGE_ENDPOINT if it is set",
        },
    }
}

/// Returns the text of the first XML element with this name, cut to one line.
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

#[cfg(test)]
mod tests {
    use object_store::Error;

    use super::*;

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
        let failure = Failure::of(&error, Some(Service::S3));
        assert_eq!(
            failure.account,
            "http://127.0.0.1:9 answered 400 InvalidToken: The token is malformed."
        );
        assert!(failure.hint.unwrap().contains("AWS_SESSION_TOKEN"));
        assert!(!crate::failure::no_bucket(&error));
    }
}
