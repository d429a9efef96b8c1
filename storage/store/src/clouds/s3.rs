//! S3 and compatible servers: `s3://bucket/prefix`, with location and credentials from the usual
//! `AWS_…` variables.

use object_store::ClientConfigKey;
use object_store::aws::{AmazonS3, AmazonS3Builder, AmazonS3ConfigKey, Checksum, S3ConditionalPut};

use super::client::{CONNECT_TIMEOUT, Settings, TIMEOUT, choose_cryptography, retries};
use super::place::Place;
use crate::error::StorageError;

/// Returns a client of the bucket, without sending a request.
///
/// # Errors
/// [`StorageError::StoreSettings`] names the variable; values are not repeated.
pub(super) fn connect(place: &Place, settings: &Settings) -> Result<AmazonS3, StorageError> {
    choose_cryptography();
    check(place, settings)?;
    let client = AmazonS3ConfigKey::Client;
    let mut builder = AmazonS3Builder::new()
        .with_config(client(ClientConfigKey::Timeout), TIMEOUT)
        .with_config(client(ClientConfigKey::ConnectTimeout), CONNECT_TIMEOUT)
        // With a checksum, the server refuses content corrupted in transit.
        .with_checksum_algorithm(Checksum::SHA256);
    for (name, value) in settings.iter() {
        // Unknown variables belong to other programs.
        if let Ok(key) = name.to_ascii_lowercase().parse() {
            builder = builder.with_config(key, value);
        }
    }
    builder
        .with_bucket_name(&place.bucket)
        .with_conditional_put(S3ConditionalPut::ETagMatch)
        // Objects are deleted one by one, because not every server supports bulk deletion.
        .with_disable_bulk_delete(true)
        .with_retry(retries())
        .build()
        .map_err(|_| {
            place.settings_error(format!(
                "the variables {} do not go together; check each against the documentation of S3",
                settings.names()
            ))
        })
}

/// Checks for errors that would otherwise occur late, with messages that name no variable.
fn check(place: &Place, settings: &Settings) -> Result<(), StorageError> {
    let wrong = |what: &str| Err(place.settings_error(what));
    let endpoint = settings.first(&["AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT_URL", "AWS_ENDPOINT"]);
    if let Some(name) = endpoint {
        settings.check_server(place, name, "https://s3.example.org:8333")?;
    }
    if settings.is("AWS_SKIP_SIGNATURE") {
        return Ok(());
    }
    match (
        settings.has("AWS_ACCESS_KEY_ID"),
        settings.has("AWS_SECRET_ACCESS_KEY"),
    ) {
        (true, true) => return Ok(()),
        (true, false) => {
            return wrong("AWS_ACCESS_KEY_ID is set, but AWS_SECRET_ACCESS_KEY is not");
        }
        (false, true) => {
            return wrong("AWS_SECRET_ACCESS_KEY is set, but AWS_ACCESS_KEY_ID is not");
        }
        (false, false) => {}
    }
    let role = settings.has("AWS_WEB_IDENTITY_TOKEN_FILE") && settings.has("AWS_ROLE_ARN")
        || settings.has("AWS_CONTAINER_CREDENTIALS_RELATIVE_URI")
        || settings.has("AWS_CONTAINER_CREDENTIALS_FULL_URI")
        || settings.has("AWS_METADATA_ENDPOINT");
    // Amazon's own machines may have roles without any variable; their credentials are requested on
    // first use.
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
    use std::collections::HashMap;
    use std::io::{BufRead, BufReader, Read, Write};
    use std::net::TcpListener;
    use std::sync::{Arc, Mutex};

    use object_store::path::Path;
    use object_store::{ObjectStore, ObjectStoreExt, PutMode, PutOptions};

    use super::*;
    use crate::steady::Steady;

    const SECRET: &str = "Very/Secret+Key";

    fn place() -> Place {
        Place::parse("s3://lab/sets").unwrap().unwrap()
    }

    fn connected(variables: &[(&str, &str)]) -> Result<AmazonS3, StorageError> {
        let variables = variables.iter().map(|(n, v)| ((*n).into(), (*v).into()));
        connect(&place(), &Settings::of(&place(), variables))
    }

    fn error(variables: &[(&str, &str)]) -> String {
        let text = connected(variables).unwrap_err().to_string();
        assert!(!text.contains(SECRET) && !text.contains("keyid"), "{text}");
        text
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
            url.starts_with("s3://lab: AWS_ENDPOINT: expected the server's URL"),
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
            let all = [kind, &[endpoint, ("AWS_ALLOW_HTTP", "true")]].concat();
            let store = connected(&all).unwrap();
            assert_eq!(store.to_string(), "AmazonS3(lab)");
        }
        assert!(
            connected(&[]).is_ok(),
            "an instance's role is not told by variables"
        );
    }

    /// Starts a minimal server that drops the first of three requests, refuses the second and
    /// executes the third.
    fn stumbling() -> (String, Arc<Mutex<Vec<String>>>) {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let url = format!("http://{}", listener.local_addr().unwrap());
        let heads: Arc<Mutex<Vec<String>>> = Arc::default();
        let seen = heads.clone();
        std::thread::spawn(move || {
            let mut objects: HashMap<String, Vec<u8>> = HashMap::new();
            for (n, stream) in listener.incoming().enumerate() {
                let mut stream = BufReader::new(stream.unwrap());
                let mut head = String::new();
                while !head.ends_with("\r\n\r\n") && stream.read_line(&mut head).unwrap() > 0 {}
                let head = head.to_ascii_lowercase();
                let length = head.split("content-length: ").nth(1);
                let length = length.map_or(0, |l| l.lines().next().unwrap().parse().unwrap());
                let mut body = vec![0; length];
                stream.read_exact(&mut body).unwrap();
                let path = head.split(' ').nth(1).unwrap().to_owned();
                seen.lock().unwrap().push(head.clone());
                let (status, answer) = match (n % 3, head.starts_with("put")) {
                    (0, _) => continue,
                    (1, _) => ("403 Forbidden", Vec::new()),
                    (_, true) if objects.contains_key(&path) => {
                        ("412 Precondition Failed", Vec::new())
                    }
                    (_, true) => {
                        objects.insert(path.clone(), body);
                        ("200 OK", Vec::new())
                    }
                    (_, false) => ("200 OK", objects[&path].clone()),
                };
                let tag = objects.get(&path).map_or(String::new(), |o| {
                    hex::encode(<md5::Md5 as md5::Digest>::digest(o))
                });
                let head = format!(
                    "HTTP/1.1 {status}\r\nETag: \"{tag}\"\r\nContent-Length: {}\r\nConnection: close\r\n\r\n",
                    answer.len()
                );
                let stream = stream.get_mut();
                stream.write_all(head.as_bytes()).unwrap();
                stream.write_all(&answer).unwrap();
            }
        });
        (url, heads)
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn a_server_that_breaks_off_and_refuses_is_asked_again_and_gets_a_checksum() {
        let (url, heads) = stumbling();
        let variables = [
            ("AWS_ENDPOINT_URL", &*url),
            ("AWS_ALLOW_HTTP", "true"),
            ("AWS_ACCESS_KEY_ID", "keyid"),
            ("AWS_SECRET_ACCESS_KEY", SECRET),
        ];
        let store = Steady::new(connected(&variables).unwrap());
        for k in 0..2 {
            let (path, body) = (Path::from(format!("a/{k}")), format!("body {k}"));
            let create = PutOptions::from(PutMode::Create);
            store
                .put_opts(&path, body.clone().into(), create.clone())
                .await
                .unwrap();
            let read = store.get(&path).await.unwrap().bytes().await.unwrap();
            assert_eq!(read, body);
            let second = store.put_opts(&path, "another".into(), create).await;
            assert!(matches!(
                second,
                Err(object_store::Error::AlreadyExists { .. })
            ));
        }
        let heads = heads.lock().unwrap();
        let mut puts = heads.iter().filter(|head| head.starts_with("put"));
        assert!(puts.all(|head| head.contains("x-amz-checksum-sha256: ")));
    }
}
