//! URLs of object stores: a service, a bucket (Azure: container) and a prefix in it.

use object_store::path::Path;

use super::service::Service;
use crate::error::StorageError;

/// A bucket, and a prefix in it.
#[derive(Debug, PartialEq)]
pub(super) struct Place {
    pub service: Service,
    pub bucket: String,
    pub prefix: Path,
}

impl Place {
    /// Parses a URL. Returns `None` if it does not name an object store.
    ///
    /// # Errors
    /// [`StorageError::UnsupportedStore`] if it does, but is invalid. Parts that may be secret are
    /// not repeated.
    pub(super) fn parse(url: &str) -> Result<Option<Self>, StorageError> {
        let Some((service, rest)) = Service::of(url) else {
            return Ok(None);
        };
        let scheme = service.scheme();
        let bucket_or = match service {
            Service::Azure => "container",
            _ => "bucket",
        };
        let (bucket, prefix) = rest.split_once('/').unwrap_or((rest, ""));
        let unsupported = |url: &str, what: String| StorageError::UnsupportedStore {
            url: url.into(),
            what,
        };
        if bucket.contains(['@', ':']) {
            let what = format!(
                "expected {scheme}://{bucket_or}/prefix without keys or host; they belong in {}",
                service.secrets()
            );
            return Err(unsupported(&format!("{scheme}://…"), what));
        }
        if let Some(at) = url.find(['?', '#']) {
            // A signed URL has its signature there.
            return Err(unsupported(
                &format!("{}…", &url[..=at]),
                format!(
                    "expected a prefix without '?' and '#'; keys and signatures belong in {}",
                    service.secrets()
                ),
            ));
        }
        let marks: &[u8] = match service {
            Service::Azure => b"-$",
            _ => b"-._",
        };
        let letters = |b: u8| b.is_ascii_lowercase() || b.is_ascii_digit() || marks.contains(&b);
        if !(3..=63).contains(&bucket.len()) || !bucket.bytes().all(letters) {
            let marks = match service {
                Service::Azure => "and '-'",
                _ => "'-' and '.'",
            };
            let what = format!(
                "expected {scheme}://{bucket_or}/prefix with a {bucket_or} name of 3 to 63 lower-case letters, digits, \
                 {marks}, found {bucket:?}"
            );
            return Err(unsupported(url, what));
        }
        let prefix = Path::parse(prefix.trim_end_matches('/'))
            .map_err(|e| unsupported(url, format!("cannot be the prefix of object keys: {e}")))?;
        Ok(Some(Self {
            service,
            bucket: bucket.into(),
            prefix,
        }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECRET: &str = "Very/Secret+Key";

    #[test]
    fn a_url_is_a_service_a_bucket_and_a_prefix() {
        for (url, service, bucket, prefix) in [
            ("s3://lab", Service::S3, "lab", ""),
            ("s3://lab/", Service::S3, "lab", ""),
            ("s3://my.lab-1/a/b c/", Service::S3, "my.lab-1", "a/b c"),
            ("gs://farm_2/sets", Service::Gcs, "farm_2", "sets"),
            ("az://lab/sets/deep", Service::Azure, "lab", "sets/deep"),
        ] {
            let place = Place::parse(url).unwrap().unwrap();
            assert_eq!(
                (place.service, &*place.bucket, place.prefix.as_ref()),
                (service, bucket, prefix)
            );
        }
        assert_eq!(Place::parse("/local/s3:/x").unwrap(), None);
        assert_eq!(Place::parse("file:///gs").unwrap(), None);
        for url in [
            "s3://",
            "s3:///x",
            "s3://Farm/x",
            "s3://ab/x",
            "s3://lab/../x",
            "gs://",
            "gs://Farm/x",
            "az://my.lab/x",
        ] {
            let text = Place::parse(url).unwrap_err().to_string();
            assert!(text.contains(url) && text.contains("prefix"), "{text}");
        }
    }

    #[test]
    fn keys_in_a_url_are_refused_and_not_repeated() {
        for (scheme, variable) in [
            ("s3", "AWS_SECRET_ACCESS_KEY"),
            ("gs", "GOOGLE_APPLICATION_CREDENTIALS"),
            ("az", "AZURE_STORAGE_ACCOUNT_KEY"),
        ] {
            for url in [
                format!("{scheme}://keyid:{SECRET}@lab/x"),
                format!("{scheme}://lab/x?keyid={SECRET}"),
                format!("{scheme}://lab?keyid={SECRET}"),
                format!("{scheme}://lab#keyid={SECRET}"),
            ] {
                let text = Place::parse(&url).unwrap_err().to_string();
                assert!(text.contains(variable), "{text}");
                assert!(
                    !text.contains("keyid") && !text.contains("Secret+Key"),
                    "{text}"
                );
            }
        }
    }
}
