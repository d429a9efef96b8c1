//! Google Cloud Storage: `gs://bucket/prefix`, with credentials from the usual `GOOGLE_…`
//! variables, `gcloud`'s file or the machine.

use std::fs::File;

use object_store::ClientConfigKey;
use object_store::gcp::{GoogleCloudStorage, GoogleCloudStorageBuilder, GoogleConfigKey};

use super::client::{CONNECT_TIMEOUT, Settings, TIMEOUT, choose_cryptography, retries};
use super::place::Place;
use crate::error::StorageError;

/// Variables with the path of a credentials file.
const FILES: [&str; 3] = [
    "GOOGLE_APPLICATION_CREDENTIALS",
    "GOOGLE_SERVICE_ACCOUNT",
    "GOOGLE_SERVICE_ACCOUNT_PATH",
];

/// Returns a client of the bucket, without sending a request.
///
/// # Errors
/// [`StorageError::StoreSettings`] names the variable; values are not repeated.
pub(super) fn connect(
    place: &Place,
    settings: &Settings,
) -> Result<GoogleCloudStorage, StorageError> {
    choose_cryptography();
    let base = settings.first(&["GOOGLE_BASE_URL"]);
    if let Some(name) = base {
        settings.check_server(place, name, "https://storage.example.org")?;
    }
    for name in FILES {
        if !settings.has(name) {
            continue;
        }
        if let Err(error) = File::open(settings.get(name)) {
            return Err(place.settings_error(format!(
                "{name}: expected a file of credentials (JSON) that can be read: {error}"
            )));
        }
    }
    let client = GoogleConfigKey::Client;
    let mut builder = GoogleCloudStorageBuilder::new()
        .with_config(client(ClientConfigKey::Timeout), TIMEOUT)
        .with_config(client(ClientConfigKey::ConnectTimeout), CONNECT_TIMEOUT)
        .with_config(client(ClientConfigKey::AllowHttp), "false");
    for (name, value) in settings.iter() {
        // Unknown variables belong to other programs.
        if let Ok(key) = name.to_ascii_lowercase().parse() {
            builder = builder.with_config(key, value);
        }
    }
    builder
        .with_bucket_name(&place.bucket)
        .with_retry(retries())
        .build()
        .map_err(|_| {
            let of = match settings.names() {
                names if names.is_empty() => {
                    "~/.config/gcloud/application_default_credentials.json".into()
                }
                names => format!("the variables {names}, or what they name,"),
            };
            place.settings_error(format!(
                "{of} cannot be used; expected one of GOOGLE_APPLICATION_CREDENTIALS, GOOGLE_SERVICE_ACCOUNT (files) or \
                 GOOGLE_SERVICE_ACCOUNT_KEY (JSON), with valid content"
            ))
        })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn connected(variables: &[(&str, &str)]) -> Result<GoogleCloudStorage, StorageError> {
        let place = Place::parse("gs://lab/sets").unwrap().unwrap();
        let variables = variables.iter().map(|(n, v)| ((*n).into(), (*v).into()));
        connect(&place, &Settings::of(&place, variables))
    }

    #[test]
    fn each_wrong_variable_is_named_and_no_value_repeated() {
        let error = |variables: &[(&str, &str)]| {
            let text = connected(variables).unwrap_err().to_string();
            assert!(
                text.starts_with("gs://lab: ") && !text.contains("s3cr3t"),
                "{text}"
            );
            text
        };
        for name in FILES {
            let text = error(&[(name, "/nowhere/s3cr3t.json")]);
            assert!(
                text.contains(name) && text.contains("No such file"),
                "{text}"
            );
        }
        let key = error(&[(
            "GOOGLE_SERVICE_ACCOUNT_KEY",
            "{\"private_key\": \"s3cr3t\"}",
        )]);
        assert!(key.contains("GOOGLE_SERVICE_ACCOUNT_KEY"), "{key}");
        let http = error(&[("GOOGLE_BASE_URL", "http://10.0.0.1:4443")]);
        assert!(http.contains("GOOGLE_ALLOW_HTTP=true"), "{http}");
        let user = error(&[("GOOGLE_BASE_URL", "https://me:s3cr3t@host")]);
        assert!(user.contains("without user"), "{user}");
    }

    #[test]
    fn a_token_or_none_at_all_is_taken() {
        for variables in [
            &[("GOOGLE_BEARER_TOKEN", "s3cr3t")][..],
            &[("GOOGLE_SKIP_SIGNATURE", "true")],
            &[("AWS_ACCESS_KEY_ID", "of another service")],
        ] {
            let store = connected(variables).unwrap();
            assert_eq!(store.to_string(), "GoogleCloudStorage(lab)");
        }
    }
}
