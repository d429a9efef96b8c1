//! Answers: their bodies, headers and errors.

use std::{
    convert::Infallible,
    io::Write,
    pin::Pin,
    task::{Context, Poll},
};

use bytes::Bytes;
use flate2::{Compression, write::GzEncoder};
use http::{HeaderMap, HeaderName, HeaderValue, Response, StatusCode, header};
use http_body::{Frame, SizeHint};
use tokio::sync::mpsc;

/// Only what this server sends runs in its pages: no scripts or styles in the HTML, nothing from
/// elsewhere, no frames around it.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; \
    img-src 'self' blob: data:; connect-src 'self'; form-action 'self'; base-uri 'none'; \
    frame-ancestors 'none'";

/// The policy of a page that a store keeps: its styles and pictures are within it. The sandbox
/// takes scripts, forms and this server's origin from it.
const FOREIGN: &str = "sandbox; default-src 'none'; style-src 'unsafe-inline'; img-src data:; \
    base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

/// The body of an answer.
pub enum Body {
    /// Bytes.
    Whole(Option<Bytes>),
    /// Parts as they are made.
    Parts(mpsc::Receiver<Bytes>),
}

impl http_body::Body for Body {
    type Data = Bytes;
    type Error = Infallible;

    fn poll_frame(
        self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, Infallible>>> {
        match self.get_mut() {
            Self::Whole(bytes) => Poll::Ready(bytes.take().map(|b| Ok(Frame::data(b)))),
            Self::Parts(parts) => {
                let part = std::task::ready!(parts.poll_recv(context));
                Poll::Ready(part.map(|part| Ok(Frame::data(part))))
            }
        }
    }

    fn is_end_stream(&self) -> bool {
        matches!(self, Self::Whole(None))
    }

    fn size_hint(&self) -> SizeHint {
        match self {
            Self::Whole(bytes) => SizeHint::with_exact(bytes.as_ref().map_or(0, Bytes::len) as u64),
            Self::Parts(_) => SizeHint::default(),
        }
    }
}

/// An answer.
pub type Answer = Response<Body>;

/// How to find and to correct damage.
pub const DAMAGED: &str = "`picofarm dataset verify` lists all damage of the data set, and \
    `picofarm dataset repair` makes its broken scenes again";

/// Why a request has no other answer.
#[derive(Debug)]
pub struct Problem {
    /// The status.
    pub status: StatusCode,
    /// What happened.
    pub message: String,
    /// What the user can do.
    pub hint: Option<String>,
}

impl Problem {
    /// Returns a problem without a hint.
    pub fn new(status: StatusCode, message: impl Into<String>) -> Self {
        Self {
            status,
            message: message.into(),
            hint: None,
        }
    }

    /// The request has a wrong parameter.
    pub fn input(message: impl Into<String>) -> Self {
        Self::new(StatusCode::BAD_REQUEST, message)
    }

    /// Returns whether the coordinator cannot be reached, so that a later try may succeed.
    pub fn is_away(&self) -> bool {
        self.status == StatusCode::BAD_GATEWAY
    }

    /// Returns the reason in a few words.
    pub fn heading(&self) -> &'static str {
        match self.status {
            StatusCode::BAD_REQUEST => "This address has a mistake",
            StatusCode::FORBIDDEN => "Not allowed",
            StatusCode::NOT_FOUND => "Not found",
            StatusCode::CONFLICT => "Not possible in this state",
            StatusCode::BAD_GATEWAY => "The coordinator does not answer",
            StatusCode::SERVICE_UNAVAILABLE => "Not available now",
            StatusCode::INTERNAL_SERVER_ERROR => "This cannot be read",
            status => status.canonical_reason().unwrap_or("Error"),
        }
    }

    /// There is no such page or thing.
    pub fn missing(message: impl Into<String>) -> Self {
        Self::new(StatusCode::NOT_FOUND, message)
    }
}

impl From<String> for Problem {
    fn from(message: String) -> Self {
        Self::input(message)
    }
}

impl From<crate::Refusal> for Problem {
    fn from(refusal: crate::Refusal) -> Self {
        use crate::Refused as R;
        let status = match refusal.kind {
            R::Away => StatusCode::BAD_GATEWAY,
            R::Denied => StatusCode::FORBIDDEN,
            R::Missing => StatusCode::NOT_FOUND,
            R::NotNow => StatusCode::CONFLICT,
            R::Input => StatusCode::BAD_REQUEST,
            R::Failed => StatusCode::INTERNAL_SERVER_ERROR,
        };
        Self {
            status,
            message: refusal.message,
            hint: refusal.hint,
        }
    }
}

impl From<picofarm_store::StorageError> for Problem {
    fn from(error: picofarm_store::StorageError) -> Self {
        use picofarm_store::StorageError as E;
        let status = match &error {
            E::NoDataset { .. } | E::NotPublished { .. } | E::SceneOutOfRange { .. } => {
                StatusCode::NOT_FOUND
            }
            E::Invalid { .. } => StatusCode::BAD_REQUEST,
            E::Store { .. } => StatusCode::SERVICE_UNAVAILABLE,
            _ => StatusCode::INTERNAL_SERVER_ERROR,
        };
        let damaged = matches!(error, E::Damaged { .. });
        Self {
            hint: damaged.then(|| DAMAGED.to_owned()),
            ..Self::new(status, error.to_string())
        }
    }
}

/// Returns an answer of a type of media. Nothing is kept by caches, because pages show a state and
/// belong to a user.
pub fn answer(status: StatusCode, media: &'static str, body: impl Into<Bytes>) -> Answer {
    let mut answer = Response::new(Body::Whole(Some(body.into())));
    *answer.status_mut() = status;
    protect(&mut answer, media);
    answer
}

/// The level of compression of a body, from 1 to 9.
#[derive(Clone, Copy)]
struct Level(u32);

/// Like [`answer`] with status 200, for bodies that are worth to be compressed.
pub fn compressed(media: &'static str, body: impl Into<Bytes>, level: u32) -> Answer {
    let mut answer = answer(StatusCode::OK, media, body);
    answer.extensions_mut().insert(Level(level));
    answer
}

/// Compresses the body where that is worth it and the client accepts it: by zstd, which takes a
/// tenth of gzip's time, or by gzip, which every browser accepts.
pub fn encode(headers: &HeaderMap, mut answer: Answer) -> Answer {
    let Some(Level(level)) = answer.extensions_mut().remove() else {
        return answer;
    };
    let accepted = headers.get(header::ACCEPT_ENCODING);
    let accepted = accepted.and_then(|accepted| accepted.to_str().ok());
    let accepts = |coding: &str| {
        let mut codings = accepted.unwrap_or_default().split(',');
        codings.any(|accepted| accepted.trim() == coding)
    };
    let Body::Whole(Some(body)) = answer.body_mut() else {
        return answer;
    };
    let (coding, written) = if accepts("zstd") {
        ("zstd", zstd::encode_all(&**body, level as i32))
    } else if accepts("gzip") {
        let mut encoder = GzEncoder::new(Vec::new(), Compression::new(level));
        let written = encoder.write_all(body).and_then(|()| encoder.finish());
        ("gzip", written)
    } else {
        return answer;
    };
    *body = written.expect("memory takes all bytes").into();
    let coding = HeaderValue::from_static(coding);
    answer
        .headers_mut()
        .insert(header::CONTENT_ENCODING, coding);
    answer
}

/// Returns a page of a store, which others may have written.
pub fn foreign(page: Bytes) -> Answer {
    let mut answer = compressed("text/html; charset=utf-8", page, 5);
    let policy = HeaderValue::from_static(FOREIGN);
    let headers = answer.headers_mut();
    headers.insert(header::CONTENT_SECURITY_POLICY, policy);
    answer
}

/// Returns an answer whose parts are sent as they are made.
pub fn stream(media: &'static str, parts: mpsc::Receiver<Bytes>) -> Answer {
    let mut answer = Response::new(Body::Parts(parts));
    protect(&mut answer, media);
    answer
}

/// Sends the browser to a path of this server.
pub fn see_other(path: &str) -> Answer {
    let mut answer = answer(StatusCode::SEE_OTHER, "text/plain; charset=utf-8", "");
    let location = HeaderValue::from_str(path).unwrap_or(HeaderValue::from_static("/"));
    answer.headers_mut().insert(header::LOCATION, location);
    answer
}

fn protect(answer: &mut Answer, media: &'static str) {
    let lines: [(HeaderName, &'static str); 6] = [
        (header::CONTENT_TYPE, media),
        (header::CONTENT_SECURITY_POLICY, POLICY),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        // With `no-referrer`, browsers would send no origin with the forms of this server either.
        (header::REFERRER_POLICY, "same-origin"),
        (header::CACHE_CONTROL, "no-store"),
        (
            HeaderName::from_static("cross-origin-resource-policy"),
            "same-origin",
        ),
    ];
    for (name, value) in lines {
        let value = HeaderValue::from_static(value);
        answer.headers_mut().insert(name, value);
    }
}

#[cfg(test)]
mod tests {
    use std::io::Read;

    use super::*;

    #[test]
    fn bodies_are_compressed_as_the_client_accepts_it() {
        let text = "light ".repeat(1000);
        let sent = |accepted: &'static str| {
            let mut headers = HeaderMap::new();
            let accepted = HeaderValue::from_static(accepted);
            headers.insert(header::ACCEPT_ENCODING, accepted);
            let answer = encode(&headers, compressed("text/plain", text.clone(), 3));
            let coding = answer.headers().get(header::CONTENT_ENCODING);
            let coding = coding
                .map_or("", |coding| coding.to_str().unwrap())
                .to_owned();
            let Body::Whole(Some(body)) = answer.into_body() else {
                panic!("a body");
            };
            (coding, body)
        };
        let (coding, body) = sent("gzip, deflate, br, zstd");
        assert_eq!((&*coding, body.len() < 100), ("zstd", true));
        assert_eq!(zstd::decode_all(&*body).unwrap(), text.as_bytes());
        let (coding, body) = sent("br, gzip");
        let mut expanded = String::new();
        let mut reader = flate2::read::GzDecoder::new(&*body);
        reader.read_to_string(&mut expanded).unwrap();
        assert_eq!((&*coding, expanded), ("gzip", text.clone()));
        for accepted in ["", "br", "gzipped"] {
            assert_eq!(sent(accepted), (String::new(), text.clone().into()));
        }
    }
}
