//! S3 and servers that speak it: `s3://bucket/prefix`, told where and who by the usual `AWS_…` variables.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use object_store::aws::{AmazonS3Builder, AmazonS3ConfigKey, S3ConditionalPut};
use object_store::limit::LimitStore;
use object_store::path::Path;
use object_store::{BackoffConfig, ClientConfigKey, ObjectStore, RetryConfig};

use crate::error::DatasetError;

/// Requests in flight for one opened store.
const CONCURRENCY: usize = 32;
/// A request's time limit. Long enough for a shard of some gigabytes over a fast line, or 20 MB over a slow one.
const TIMEOUT: &str = "120s";
/// Until a connection stands.
const CONNECT_TIMEOUT: &str = "5s";
/// Retries of one request; whoever asks decides what to do when they are used up.
const RETRIES: usize = 6;
/// No retry starts later than this after the first attempt.
const RETRY_TIMEOUT: Duration = Duration::from_secs(20);

/// A bucket and the prefix in it.
#[derive(Debug, PartialEq)]
pub(super) struct Place {
    pub bucket: String,
    pub prefix: Path,
}

impl Place {
    /// `None` where `url` is not of S3.
    ///
    /// # Errors
    /// [`DatasetError::UnsupportedStore`] where it is, but cannot be used; what could be a secret is not repeated.
    pub(super) fn parse(url: &str) -> Result<Option<Self>, DatasetError> {
        let Some(rest) = url.strip_prefix("s3://") else {
            return Ok(None);
        };
        let (bucket, prefix) = rest.split_once('/').unwrap_or((rest, ""));
        let unsupported = |url: &str, what: String| DatasetError::UnsupportedStore {
            url: url.into(),
            what,
        };
        if bucket.contains(['@', ':']) {
            return Err(unsupported(
                "s3://…",
                "expected s3://bucket/prefix without keys or host; they belong in AWS_ACCESS_KEY_ID, \
                 AWS_SECRET_ACCESS_KEY and AWS_ENDPOINT_URL"
                    .into(),
            ));
        }
        let letters = |b: u8| b.is_ascii_lowercase() || b.is_ascii_digit() || b"-._".contains(&b);
        if !(3..=63).contains(&bucket.len()) || !bucket.bytes().all(letters) {
            let what = format!(
                "expected s3://bucket/prefix with a bucket name of 3 to 63 lower-case letters, digits, '-' and '.', \
                 found {bucket:?}"
            );
            return Err(unsupported(url, what));
        }
        if prefix.contains(['?', '#']) {
            return Err(unsupported(
                url,
                "expected a prefix without '?' and '#'".into(),
            ));
        }
        let prefix = Path::parse(prefix.trim_end_matches('/'))
            .map_err(|e| unsupported(url, format!("cannot be the prefix of object keys: {e}")))?;
        Ok(Some(Self {
            bucket: bucket.into(),
            prefix,
        }))
    }
}

/// A client of the bucket, made from environment variables. Asks nothing of the server.
///
/// # Errors
/// [`DatasetError::StoreSettings`] names the variable; values are not repeated.
pub(super) fn connect(
    place: &Place,
    variables: impl Iterator<Item = (String, String)>,
) -> Result<Arc<dyn ObjectStore>, DatasetError> {
    let settings: BTreeMap<String, String> = variables
        .filter(|(name, value)| name.starts_with("AWS_") && !value.is_empty())
        .collect();
    check(place, &settings)?;
    let mut builder = AmazonS3Builder::new()
        .with_config(client(ClientConfigKey::Timeout), TIMEOUT)
        .with_config(client(ClientConfigKey::ConnectTimeout), CONNECT_TIMEOUT);
    for (name, value) in &settings {
        // Variables that it does not know are other programs'.
        if let Ok(key) = name.to_ascii_lowercase().parse() {
            builder = builder.with_config(key, value);
        }
    }
    let s3 = builder
        .with_bucket_name(&place.bucket)
        .with_conditional_put(S3ConditionalPut::ETagMatch)
        // Objects are deleted one by one, and not every server knows the request for many.
        .with_disable_bulk_delete(true)
        .with_retry(RetryConfig {
            backoff: BackoffConfig {
                init_backoff: Duration::from_millis(200),
                max_backoff: Duration::from_secs(5),
                base: 2.0,
            },
            max_retries: RETRIES,
            retry_timeout: RETRY_TIMEOUT,
        })
        .build()
        .map_err(|_| {
            settings_error(
                place,
                format!(
                    "the variables {} do not go together; check each against the documentation of S3",
                    settings.keys().map(String::as_str).collect::<Vec<_>>().join(", ")
                ),
            )
        })?;
    Ok(Arc::new(LimitStore::new(s3, CONCURRENCY)))
}

fn client(key: ClientConfigKey) -> AmazonS3ConfigKey {
    AmazonS3ConfigKey::Client(key)
}

fn settings_error(place: &Place, what: String) -> DatasetError {
    DatasetError::StoreSettings {
        url: format!("s3://{}", place.bucket),
        what,
    }
}

/// What would otherwise fail late and with words that name no variable.
fn check(place: &Place, settings: &BTreeMap<String, String>) -> Result<(), DatasetError> {
    let wrong = |what: &str| Err(settings_error(place, what.into()));
    let has = |name: &str| settings.contains_key(name);
    let is = |name: &str| {
        let value = settings.get(name).map(|v| v.to_ascii_lowercase());
        matches!(value.as_deref(), Some("true" | "1" | "yes" | "y" | "on"))
    };
    let endpoint = ["AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT_URL", "AWS_ENDPOINT"]
        .into_iter()
        .find(|name| has(name));
    if let Some(name) = endpoint {
        let url = &settings[name];
        let (scheme, rest) = url.split_once("://").unwrap_or_default();
        if !matches!(scheme, "http" | "https") || rest.is_empty() || rest.starts_with(['/', ':']) {
            return wrong(&format!(
                "{name}: expected the server's URL, e.g. https://s3.example.org:8333"
            ));
        }
        if rest.contains(['@', '?', '#']) {
            return wrong(&format!(
                "{name}: expected a URL without user, password or query; keys belong in AWS_ACCESS_KEY_ID and \
                 AWS_SECRET_ACCESS_KEY"
            ));
        }
        if scheme == "http" && !is("AWS_ALLOW_HTTP") {
            return wrong(&format!(
                "{name} is an http:// URL: use https://, or set AWS_ALLOW_HTTP=true if the network between is trusted"
            ));
        }
    }
    if is("AWS_SKIP_SIGNATURE") {
        return Ok(());
    }
    match (has("AWS_ACCESS_KEY_ID"), has("AWS_SECRET_ACCESS_KEY")) {
        (true, true) => return Ok(()),
        (true, false) => {
            return wrong("AWS_ACCESS_KEY_ID is set, but AWS_SECRET_ACCESS_KEY is not");
        }
        (false, true) => {
            return wrong("AWS_SECRET_ACCESS_KEY is set, but AWS_ACCESS_KEY_ID is not");
        }
        (false, false) => {}
    }
    let role = has("AWS_WEB_IDENTITY_TOKEN_FILE") && has("AWS_ROLE_ARN")
        || has("AWS_CONTAINER_CREDENTIALS_RELATIVE_URI")
        || has("AWS_CONTAINER_CREDENTIALS_FULL_URI")
        || has("AWS_METADATA_ENDPOINT");
    // Amazon's own machines have roles that no variable tells of; they are asked when a request is made.
    if role || endpoint.is_none() {
        return Ok(());
    }
    wrong(
        "no credentials: set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY (profiles in ~/.aws are not read), or \
         AWS_SKIP_SIGNATURE=true for a server that asks for none",
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECRET: &str = "Very/Secret+Key";

    fn place() -> Place {
        Place::parse("s3://farm/sets").unwrap().unwrap()
    }

    fn error(variables: &[(&str, &str)]) -> String {
        let variables = variables.iter().map(|(n, v)| ((*n).into(), (*v).into()));
        let text = connect(&place(), variables).unwrap_err().to_string();
        assert!(!text.contains(SECRET) && !text.contains("keyid"), "{text}");
        text
    }

    #[test]
    fn a_url_is_a_bucket_and_a_prefix() {
        for (url, bucket, prefix) in [
            ("s3://farm", "farm", ""),
            ("s3://farm/", "farm", ""),
            ("s3://my.farm-1/a/b c/", "my.farm-1", "a/b c"),
        ] {
            let place = Place::parse(url).unwrap().unwrap();
            assert_eq!((&*place.bucket, place.prefix.as_ref()), (bucket, prefix));
        }
        assert_eq!(Place::parse("/local/s3:/x").unwrap(), None);
        for url in [
            "s3://",
            "s3:///x",
            "s3://Farm/x",
            "s3://ab/x",
            "s3://farm/../x",
            "s3://farm/x?y",
        ] {
            let text = Place::parse(url).unwrap_err().to_string();
            assert!(text.contains(url) && text.contains("prefix"), "{text}");
        }
    }

    #[test]
    fn keys_in_a_url_are_refused_and_not_repeated() {
        let url = format!("s3://keyid:{SECRET}@farm/x");
        let text = Place::parse(&url).unwrap_err().to_string();
        assert!(text.contains("AWS_SECRET_ACCESS_KEY"), "{text}");
        assert!(
            !text.contains("keyid") && !text.contains("Secret+Key"),
            "{text}"
        );
    }

    #[test]
    fn each_missing_or_wrong_variable_is_named_and_no_value_repeated() {
        let endpoint = ("AWS_ENDPOINT_URL", "https://127.0.0.1:1");
        let (id, key) = (
            ("AWS_ACCESS_KEY_ID", "keyid"),
            ("AWS_SECRET_ACCESS_KEY", SECRET),
        );
        let with_keys = |name: &str, url: &str| error(&[(name, url), id, key]);
        assert!(error(&[endpoint]).contains("set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY"));
        assert!(error(&[endpoint, id]).contains("AWS_SECRET_ACCESS_KEY is not"));
        assert!(error(&[key]).contains("AWS_ACCESS_KEY_ID is not"));
        assert!(error(&[endpoint, id, ("AWS_SECRET_ACCESS_KEY", "")]).contains("is not"));
        let http = with_keys("AWS_ENDPOINT_URL", "http://10.0.0.1:8333");
        assert!(http.contains("set AWS_ALLOW_HTTP=true"), "{http}");
        let user = format!("https://keyid:{SECRET}@host");
        let user = with_keys("AWS_ENDPOINT_URL", &user);
        assert!(user.contains("without user"), "{user}");
        let url = with_keys("AWS_ENDPOINT", "host:8333");
        assert!(
            url.starts_with("s3://farm: AWS_ENDPOINT: expected the server's URL"),
            "{url}"
        );
        let timeout = error(&[endpoint, id, key, ("AWS_TIMEOUT", "soon")]);
        assert!(timeout.contains("AWS_TIMEOUT"), "{timeout}");
    }

    #[test]
    fn credentials_of_every_usual_kind_are_taken() {
        let endpoint = ("AWS_ENDPOINT_URL", "http://127.0.0.1:1");
        let kinds: [&[(&str, &str)]; 5] = [
            &[
                ("AWS_ACCESS_KEY_ID", "keyid"),
                ("AWS_SECRET_ACCESS_KEY", SECRET),
            ],
            &[("AWS_SKIP_SIGNATURE", "true")],
            &[
                ("AWS_WEB_IDENTITY_TOKEN_FILE", "/t"),
                ("AWS_ROLE_ARN", "arn:aws:iam::1:role/r"),
            ],
            &[("AWS_CONTAINER_CREDENTIALS_RELATIVE_URI", "/x")],
            &[("AWS_METADATA_ENDPOINT", "http://127.0.0.1:2")],
        ];
        for kind in kinds {
            let all = kind.iter().chain([&endpoint, &("AWS_ALLOW_HTTP", "true")]);
            let store = connect(&place(), all.map(|(n, v)| ((*n).into(), (*v).into()))).unwrap();
            let shown = format!("{store} {store:?}");
            assert!(shown.contains("AmazonS3(farm)"), "{shown}");
            assert!(!format!("{store}").contains(SECRET));
        }
        assert!(
            connect(&place(), std::iter::empty()).is_ok(),
            "an instance's role is not told by variables"
        );
    }
}
