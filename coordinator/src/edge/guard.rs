//! The layer that authenticates the calls of every service.

use std::{
    sync::Arc,
    task::{Context, Poll},
};

use futures::future::{Either, Ready, ready};
use picofarm_credentials::Described;
use picofarm_proto::messages::Outcome;
use tonic::{Status, body::Body, metadata::MetadataValue};
use tower::{Layer, Service};

use super::connections::Peer;
use crate::{
    auth::{ACCEPTED, BY_CERTIFICATE, BY_DIGEST, Caller, Gate, Needs, Throttle, act, needs},
    observe::audit::Audit,
};

/// Admits authorized calls, and adds a [`Caller`] to the request's extensions.
#[derive(Clone)]
pub(crate) struct Guard {
    gate: Gate,
    audit: Audit,
    refused: Arc<Throttle>,
}

impl Guard {
    pub(crate) fn new(gate: Gate, audit: Audit) -> Self {
        Self {
            gate,
            audit,
            refused: Arc::default(),
        }
    }

    /// Returns the answer if the request asks whether credentials are accepted. The header
    /// `authorization` then contains the SHA-256 of a token, or the name in a client certificate.
    /// Anyone may ask, because neither is a credential: it admits nobody, and only the header is
    /// read.
    fn asked(&self, headers: &http::HeaderMap) -> Option<Status> {
        let text = headers.get(http::header::AUTHORIZATION)?.to_str().ok()?;
        let (scheme, proof) = text.split_once(' ')?;
        let (accepted, reason) = if scheme.eq_ignore_ascii_case(BY_DIGEST) {
            let digest = hex::decode(proof).ok().filter(|d| d.len() == 32)?;
            self.gate.accepts_digest(&digest)
        } else if scheme.eq_ignore_ascii_case(BY_CERTIFICATE) {
            self.gate.accepts_certificate(proof)
        } else {
            return None;
        };
        let mut status = Status::unauthenticated(reason);
        let accepted = if accepted { "yes" } else { "no" };
        let accepted = MetadataValue::from_static(accepted);
        status.metadata_mut().insert(ACCEPTED, accepted);
        Some(status)
    }

    fn check<B>(&self, request: &http::Request<B>) -> Result<Caller, Status> {
        let token = token(request.headers())?;
        let peer = request.extensions().get::<Peer>();
        let authorities = peer.map_or(0, |peer| peer.authorities);
        let certificate = certificate(request);
        let caller = self.gate.admit(token, certificate.as_ref(), authorities)?;
        let path = request.uri().path();
        match needs(path) {
            needed if caller.roles.allow(needed) => Ok(caller),
            Needs::Role(role) => {
                let why = format!(
                    "{:?} may not call {}: it needs the role {role}, and has {}",
                    caller.name,
                    path.rsplit('/').next().unwrap_or(path),
                    caller.roles
                );
                if let Some(act) = act(path) {
                    self.audit.note(&caller.name, act, Outcome::Refused, &why);
                }
                Err(Status::permission_denied(why))
            }
            Needs::Nothing => Ok(caller),
        }
    }
}

/// Returns the bearer token, if any.
fn token(headers: &http::HeaderMap) -> Result<Option<&str>, Status> {
    let Some(value) = headers.get(http::header::AUTHORIZATION) else {
        return Ok(None);
    };
    let bearer = value.to_str().ok().and_then(|text| {
        let (scheme, token) = text.split_once(' ')?;
        scheme.eq_ignore_ascii_case("bearer").then(|| token.trim())
    });
    // The value is not repeated, because it may be a secret in the wrong place.
    bearer
        .map(Some)
        .ok_or_else(|| Status::unauthenticated("the header authorization must be: Bearer TOKEN"))
}

/// Returns the caller's own certificate, which the TLS handshake has verified.
fn certificate<B>(request: &http::Request<B>) -> Option<Described> {
    let chain = request.extensions().get::<Peer>()?.certificates.as_ref()?;
    Described::of(chain.first()?).ok()
}

fn peer<B>(request: &http::Request<B>) -> String {
    let peer = request.extensions().get::<Peer>();
    peer.map_or_else(
        || "an unknown address".to_owned(),
        |p| p.address.to_string(),
    )
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

/// Whether a request comes from the coordinator's own machine.
#[derive(Debug, Clone, Copy)]
pub(crate) struct SameMachine(pub bool);

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
        if let Some(status) = self.guard.asked(request.headers()) {
            return Either::Right(ready(Ok(status.into_http())));
        }
        match self.guard.check(&request) {
            Ok(caller) => {
                let here = request.extensions().get::<Peer>();
                let here = here.is_some_and(|peer| peer.address.ip().to_canonical().is_loopback());
                request.extensions_mut().insert(caller);
                request.extensions_mut().insert(SameMachine(here));
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
