//! The layer before every service.

use std::{
    sync::Arc,
    task::{Context, Poll},
};

use futures::future::{Either, Ready, ready};
use picofarm_proto::credentials::Described;
use tonic::{
    Status,
    body::Body,
    transport::server::{TcpConnectInfo, TlsConnectInfo},
};
use tower::{Layer, Service};

use super::{Caller, Gate, Needs, Throttle, needs};

/// Lets in those who may call what they call, with a [`Caller`] among the request's extensions.
#[derive(Clone)]
pub(crate) struct Guard {
    gate: Gate,
    refused: Arc<Throttle>,
}

impl Guard {
    pub(crate) fn new(gate: Gate) -> Self {
        Self {
            gate,
            refused: Arc::default(),
        }
    }

    fn check<B>(&self, request: &http::Request<B>) -> Result<Caller, Status> {
        let token = token(request.headers())?;
        let caller = self.gate.admit(token, certificate(request).as_ref())?;
        let path = request.uri().path();
        match needs(path) {
            needed if caller.roles.allow(needed) => Ok(caller),
            Needs::Role(role) => Err(Status::permission_denied(format!(
                "{:?} may not call {}: it needs the role {role}, and has {}",
                caller.name,
                path.rsplit('/').next().unwrap_or(path),
                caller.roles
            ))),
            Needs::Nothing => Ok(caller),
        }
    }
}

/// The bearer token, where there is one.
fn token(headers: &http::HeaderMap) -> Result<Option<&str>, Status> {
    let Some(value) = headers.get(http::header::AUTHORIZATION) else {
        return Ok(None);
    };
    let bearer = value.to_str().ok().and_then(|text| {
        let (scheme, token) = text.split_once(' ')?;
        scheme.eq_ignore_ascii_case("bearer").then(|| token.trim())
    });
    // Its value is not repeated: it may be a secret in the wrong place.
    bearer
        .map(Some)
        .ok_or_else(|| Status::unauthenticated("the header authorization must be: Bearer TOKEN"))
}

/// The caller's own certificate, which the TLS handshake has verified.
fn certificate<B>(request: &http::Request<B>) -> Option<Described> {
    let info = request
        .extensions()
        .get::<TlsConnectInfo<TcpConnectInfo>>()?;
    let chain = info.peer_certs()?;
    Described::of(chain.first()?).ok()
}

fn peer<B>(request: &http::Request<B>) -> String {
    let extensions = request.extensions();
    let tcp = extensions.get::<TcpConnectInfo>().or_else(|| {
        let tls = extensions.get::<TlsConnectInfo<TcpConnectInfo>>()?;
        Some(tls.get_ref())
    });
    let address = tcp.and_then(TcpConnectInfo::remote_addr);
    address.map_or_else(|| "an unknown address".to_owned(), |a| a.to_string())
}

impl<S> Layer<S> for Guard {
    type Service = Guarded<S>;

    fn layer(&self, inner: S) -> Guarded<S> {
        Guarded {
            inner,
            guard: self.clone(),
        }
    }
}

/// A service behind a [`Guard`].
#[derive(Clone)]
pub(crate) struct Guarded<S> {
    inner: S,
    guard: Guard,
}

impl<S, B> Service<http::Request<B>> for Guarded<S>
where
    S: Service<http::Request<B>, Response = http::Response<Body>>,
{
    type Response = S::Response;
    type Error = S::Error;
    type Future = Either<S::Future, Ready<Result<Self::Response, Self::Error>>>;

    fn poll_ready(&mut self, context: &mut Context<'_>) -> Poll<Result<(), Self::Error>> {
        self.inner.poll_ready(context)
    }

    fn call(&mut self, mut request: http::Request<B>) -> Self::Future {
        match self.guard.check(&request) {
            Ok(caller) => {
                request.extensions_mut().insert(caller);
                Either::Left(self.inner.call(request))
            }
            Err(status) => {
                if let Some(unsaid) = self.guard.refused.allows() {
                    tracing::warn!(
                        peer = peer(&request),
                        unsaid,
                        "refused: {}",
                        status.message()
                    );
                }
                Either::Right(ready(Ok(status.into_http())))
            }
        }
    }
}
