//! Azure Blob Storage: `az://container/prefix`, with location and credentials from the usual
//! `AZURE_…` variables.

use object_store::ClientConfigKey;
use object_store::azure::{AzureConfigKey, MicrosoftAzure, MicrosoftAzureBuilder};

use super::client::{CONNECT_TIMEOUT, Settings, TIMEOUT, choose_cryptography, retries};
use super::place::Place;
use crate::error::StorageError;

/// Returns a client of the container, without sending a request.
///
/// # Errors
/// [`StorageError::StoreSettings`] names the variable; values are not repeated.
pub(super) fn connect(place: &Place, settings: &Settings) -> Result<MicrosoftAzure, StorageError> {
    choose_cryptography();
    check(place, settings)?;
    let client = AzureConfigKey::Client;
    let mut builder = MicrosoftAzureBuilder::new()
        .with_config(client(ClientConfigKey::Timeout), TIMEOUT)
        .with_config(client(ClientConfigKey::ConnectTimeout), CONNECT_TIMEOUT);
    for (name, value) in settings.iter() {
        // Unknown variables belong to other programs.
        if let Ok(key) = name.to_ascii_lowercase().parse() {
            builder = builder.with_config(key, value);
        }
    }
    builder
        .with_container_name(&place.bucket)
        .with_retry(retries())
        .build()
        .map_err(|_| {
            place.settings_error(format!(
                "the variables {} do not go together; check each: the key is base64, a SAS token begins with sv=",
                settings.names()
            ))
        })
}

/// Checks for errors that would otherwise occur late, with messages that name no variable.
fn check(place: &Place, settings: &Settings) -> Result<(), StorageError> {
    let wrong = |what: &str| Err(place.settings_error(what));
    if let Some(name) = settings.first(&["AZURE_STORAGE_ENDPOINT", "AZURE_ENDPOINT"]) {
        settings.check_server(place, name, "https://account.blob.core.windows.net")?;
    }
    if settings.is("AZURE_STORAGE_USE_EMULATOR") {
        return Ok(());
    }
    if !settings.has("AZURE_STORAGE_ACCOUNT_NAME") {
        return wrong("AZURE_STORAGE_ACCOUNT_NAME is not set: a container belongs to an account");
    }
    let id = ["AZURE_CLIENT_ID", "AZURE_STORAGE_CLIENT_ID"];
    let secret = ["AZURE_CLIENT_SECRET", "AZURE_STORAGE_CLIENT_SECRET"];
    let tenant = ["AZURE_TENANT_ID", "AZURE_STORAGE_TENANT_ID"];
    if settings.first(&secret).is_some()
        && (settings.first(&id).is_none() || settings.first(&tenant).is_none())
    {
        return wrong(
            "AZURE_CLIENT_SECRET is set, but not both AZURE_CLIENT_ID and AZURE_TENANT_ID",
        );
    }
    // Without any of these, the credentials of Azure's own machines are requested on first use.
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    const ACCOUNT: (&str, &str) = ("AZURE_STORAGE_ACCOUNT_NAME", "lidar");

    fn connected(variables: &[(&str, &str)]) -> Result<MicrosoftAzure, StorageError> {
        let place = Place::parse("az://lab/sets").unwrap().unwrap();
        let variables = variables.iter().map(|(n, v)| ((*n).into(), (*v).into()));
        connect(&place, &Settings::of(&place, variables))
    }

    #[test]
    fn each_missing_or_wrong_variable_is_named_and_no_value_repeated() {
        let error = |variables: &[(&str, &str)]| {
            let text = connected(variables).unwrap_err().to_string();
            assert!(
                text.starts_with("az://lab: ") && !text.contains("s3cr3t"),
                "{text}"
            );
            text
        };
        assert!(error(&[]).contains("AZURE_STORAGE_ACCOUNT_NAME is not set"));
        let key = error(&[ACCOUNT, ("AZURE_STORAGE_ACCOUNT_KEY", "s3cr3t, no base64")]);
        assert!(key.contains("AZURE_STORAGE_ACCOUNT_KEY"), "{key}");
        let half = error(&[ACCOUNT, ("AZURE_CLIENT_SECRET", "s3cr3t")]);
        assert!(half.contains("AZURE_TENANT_ID"), "{half}");
        let http = error(&[ACCOUNT, ("AZURE_STORAGE_ENDPOINT", "http://10.0.0.1:10000")]);
        assert!(http.contains("AZURE_ALLOW_HTTP=true"), "{http}");
    }

    #[test]
    fn credentials_of_every_usual_kind_are_taken() {
        for kind in [
            &[("AZURE_STORAGE_ACCOUNT_KEY", "c2VjcmV0")][..],
            &[("AZURE_STORAGE_SAS_TOKEN", "sv=2024-01-01&sig=abc")],
            &[
                ("AZURE_CLIENT_ID", "me"),
                ("AZURE_CLIENT_SECRET", "s3cr3t"),
                ("AZURE_TENANT_ID", "us"),
            ],
            &[("AZURE_USE_AZURE_CLI", "true")],
            &[],
        ] {
            let store = connected(&[kind, &[ACCOUNT]].concat()).unwrap();
            assert!(store.to_string().contains("container: lab"), "{store}");
        }
    }
}
