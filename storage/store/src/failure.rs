//! Short descriptions of store errors without secrets, with hints.

use std::io;

use object_store::Error;

use super::account::Failure;
use super::identity::Mismatch;
use super::service::Service;

impl Failure {
    /// Describes an error of any store. `service` is given for object stores.
    pub(crate) fn of(error: &Error, service: Option<Service>) -> Self {
        let chain = chain(error);
        if let Some(mismatch) = Mismatch::among(&chain) {
            return Self {
                account: mismatch.to_string(),
                hint: None,
            };
        }
        #[cfg(feature = "clouds")]
        if let Some(failure) =
            super::clouds::failure::failure(&chain, service.unwrap_or(Service::S3))
        {
            return failure;
        }
        #[cfg(feature = "clouds")]
        if let Some(broken) = chain
            .iter()
            .find_map(|e| e.downcast_ref::<super::steady::Broken>())
        {
            return Self {
                account: broken.to_string(),
                hint: Some("check the network and the proxies before the store"),
            };
        }
        #[cfg(not(feature = "clouds"))]
        let _ = service;
        let io = chain.last().and_then(|e| e.downcast_ref::<io::Error>());
        Self {
            account: error.to_string(),
            hint: io.and_then(io_hint),
        }
    }
}

/// Returns whether the whole bucket is missing, and not only the object.
pub(crate) fn no_bucket(error: &Error) -> bool {
    #[cfg(feature = "clouds")]
    return super::clouds::failure::no_bucket(&chain(error));
    #[cfg(not(feature = "clouds"))]
    {
        let _ = error;
        false
    }
}

/// Returns whether a request or its answer was interrupted, or was corrupted in transit.
#[cfg(feature = "clouds")]
pub(super) fn breaks_off(error: &Error) -> bool {
    let chain = chain(error);
    chain.iter().any(|e| e.is::<super::steady::Broken>())
        || super::clouds::failure::breaks_off(&chain)
}

fn chain(error: &Error) -> Vec<&(dyn std::error::Error + 'static)> {
    let first: &(dyn std::error::Error + 'static) = error;
    std::iter::successors(Some(first), |&e| e.source()).collect()
}

/// Returns the hint for a file system error.
pub fn io_hint(error: &io::Error) -> Option<&'static str> {
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
        let hint = |kind| Failure::of(&nested(kind), None).hint.unwrap();
        assert!(hint(io::ErrorKind::StorageFull).starts_with("the disk is full: free some space"));
        assert!(hint(io::ErrorKind::ReadOnlyFilesystem).contains("mounted read-only"));
    }
}
