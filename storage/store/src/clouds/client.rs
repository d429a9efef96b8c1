//! Settings common to all object stores: their variables, timeouts, retries, and the number of
//! concurrent requests.

use std::collections::BTreeMap;
use std::time::Duration;

use object_store::{BackoffConfig, RetryConfig};

use super::place::Place;
use crate::error::StorageError;

/// Number of concurrent requests of one opened store.
pub(super) const CONCURRENCY: usize = 32;
/// A request's timeout. It suffices for a shard of some gigabytes over a fast line, or 20 MB over a
/// slow one.
pub(super) const TIMEOUT: &str = "120s";
/// Timeout for establishing a connection.
pub(super) const CONNECT_TIMEOUT: &str = "5s";
/// Number of retries of one request. When they are used up, the caller decides.
const RETRIES: usize = 6;
/// No retry starts later than this after the first attempt.
const RETRY_TIMEOUT: Duration = Duration::from_secs(20);

/// Installs a cryptography provider. It must be called before a client is created, because the
/// client uses the provider that the process has chosen, and panics if there is none. A provider
/// that the program has already installed is kept.
pub(super) fn choose_cryptography() {
    let _ = rustls::crypto::ring::default_provider().install_default();
}

pub(super) fn retries() -> RetryConfig {
    RetryConfig {
        backoff: BackoffConfig {
            init_backoff: Duration::from_millis(200),
            max_backoff: Duration::from_secs(5),
            base: 2.0,
        },
        max_retries: RETRIES,
        retry_timeout: RETRY_TIMEOUT,
    }
}

/// The environment variables of a store. Empty ones count as unset.
pub(super) struct Settings(BTreeMap<String, String>);

impl Settings {
    pub(super) fn of(place: &Place, variables: impl Iterator<Item = (String, String)>) -> Self {
        let start = place.service.variables();
        Self(
            variables
                .filter(|(name, value)| name.starts_with(start) && !value.is_empty())
                .collect(),
        )
    }

    pub(super) fn iter(&self) -> impl Iterator<Item = (&String, &String)> {
        self.0.iter()
    }

    /// Returns their names for messages.
    pub(super) fn names(&self) -> String {
        let names: Vec<&str> = self.0.keys().map(String::as_str).collect();
        names.join(", ")
    }

    pub(super) fn has(&self, name: &str) -> bool {
        self.0.contains_key(name)
    }

    /// Returns the first name with a value.
    pub(super) fn first<'a>(&self, names: &[&'a str]) -> Option<&'a str> {
        names.iter().copied().find(|name| self.has(name))
    }

    pub(super) fn get(&self, name: &str) -> &str {
        self.0.get(name).map_or("", String::as_str)
    }

    pub(super) fn is(&self, name: &str) -> bool {
        let value = self.get(name).to_ascii_lowercase();
        matches!(&*value, "true" | "1" | "yes" | "y" | "on")
    }

    /// Checks that a server's URL is usable.
    ///
    /// # Errors
    /// [`StorageError::StoreSettings`] names the variable, `name`, or the one that allows plain
    /// HTTP.
    pub(super) fn check_server(
        &self,
        place: &Place,
        name: &str,
        example: &str,
    ) -> Result<(), StorageError> {
        let start = place.service.variables();
        let wrong = |what: String| Err(place.settings_error(what));
        let (scheme, rest) = self.get(name).split_once("://").unwrap_or_default();
        if !matches!(scheme, "http" | "https") || rest.is_empty() || rest.starts_with(['/', ':']) {
            return wrong(format!("{name}: expected the server's URL, e.g. {example}"));
        }
        if rest.contains(['@', '?', '#']) {
            return wrong(format!(
                "{name}: expected a URL without user, password or query; credentials belong in variables of their own"
            ));
        }
        if scheme == "http" && !self.is(&format!("{start}ALLOW_HTTP")) {
            return wrong(format!(
                "{name} is an http:// URL: use https://, or set {start}ALLOW_HTTP=true if the network between is trusted"
            ));
        }
        Ok(())
    }
}
