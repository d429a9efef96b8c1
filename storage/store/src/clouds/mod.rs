//! Network object stores: S3, Google's and Azure's.

mod azure;
mod client;
pub(super) mod failure;
mod gcs;
mod limited;
mod s3;

use std::sync::Arc;

use object_store::ObjectStore;
use object_store::limit::LimitStore;

use super::place::{self, Place};
use super::service::Service;
use super::steady::Steady;
use crate::error::StorageError;

use client::{CONCURRENCY, Settings};
use limited::Limited;

/// Returns a client of the bucket, with location and credentials from the environment, without
/// sending a request.
///
/// # Errors
/// [`StorageError::StoreSettings`] names a missing or unusable variable.
pub(super) fn connect(place: &Place) -> Result<Arc<dyn ObjectStore>, StorageError> {
    let variables = std::env::vars_os()
        .filter_map(|(name, value)| Some((name.into_string().ok()?, value.into_string().ok()?)));
    let settings = Settings::of(place, variables);
    Ok(match place.service {
        Service::S3 => shared(s3::connect(place, &settings)?),
        Service::Gcs => shared(gcs::connect(place, &settings)?),
        Service::Azure => shared(azure::connect(place, &settings)?),
    })
}

/// Wraps a network store with the common limits and repetitions.
fn shared(store: impl ObjectStore) -> Arc<dyn ObjectStore> {
    let store = LimitStore::new(store, CONCURRENCY);
    match limited::limits() {
        limits if limits.any() => Arc::new(Steady::new(Limited::new(store, limits))),
        _ => Arc::new(Steady::new(store)),
    }
}

impl Service {
    /// Returns the prefix of its environment variables.
    pub(super) fn variables(self) -> &'static str {
        match self {
            Self::S3 => "AWS_",
            Self::Gcs => "GOOGLE_",
            Self::Azure => "AZURE_",
        }
    }
}

impl Place {
    /// Returns an error for missing or wrong variables.
    pub(super) fn settings_error(&self, what: impl Into<String>) -> StorageError {
        StorageError::StoreSettings {
            url: format!("{}://{}", self.service.scheme(), self.bucket),
            what: what.into(),
        }
    }
}
