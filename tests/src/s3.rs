//! An S3 server for the tests: SeaweedFS on loopback ports in a scratch folder, one per test.
//!
//! `tests/run` installs the program and names it in `PICOFARM_WEED`, so that no test is skipped
//! there.

use std::{
    collections::BTreeMap,
    io::{Read, Write},
    net::TcpStream,
    path::PathBuf,
    process::Command,
    sync::{
        Arc,
        atomic::{AtomicU32, Ordering},
    },
};

use futures::TryStreamExt;
use object_store::{
    ObjectStore, ObjectStoreExt, RetryConfig,
    aws::{AmazonS3, AmazonS3Builder},
    path::Path,
};
use sha2::{Digest, Sha256};

use crate::{cli::Cli, ports::lasting, process::Process, scratch::Scratch, wait::until};

/// Access key with read and write permission.
pub const KEY: &str = "farmkey0";
/// Its secret, which must not appear in any log.
pub const SECRET: &str = "far+msecret/0123456789";
/// Access key and secret with read permission only.
pub const READER: (&str, &str) = ("readkey0", "readsecret0123456789");

/// Names of the server's parts that need ports, S3 last.
const PARTS: [&str; 4] = ["master", "volume", "filer", "s3"];

/// A running server, with a new bucket for each test.
pub struct Server {
    process: Option<Process>,
    ports: [(u16, u16); 4],
    program: PathBuf,
    /// Its folder.
    pub scratch: Scratch,
}

impl Server {
    /// Starts a server. Prints a message and returns `None` if none is installed.
    ///
    /// # Panics
    /// If it does not start.
    pub fn start(name: &str) -> Option<Self> {
        let Some(program) = std::env::var_os("PICOFARM_WEED") else {
            eprintln!(
                "SKIPPED {name}: no S3 server; tests/run installs SeaweedFS, PICOFARM_WEED names it"
            );
            return None;
        };
        let scratch = Scratch::new(name);
        std::fs::create_dir(scratch.join("data")).expect("the test's folder is writable");
        let identity = |name: &str, (key, secret): (&str, &str), actions: &[&str]| {
            serde_json::json!({
                "name": name, "actions": actions, "credentials": [{"accessKey": key, "secretKey": secret}],
            })
        };
        // Not an administrator, because the administrator's puts would create missing buckets.
        let who = serde_json::json!({"identities": [
            identity("farm", (KEY, SECRET), &["Read", "Write", "List"]),
            identity("reader", READER, &["Read", "List"]),
        ]});
        std::fs::write(scratch.join("s3.json"), who.to_string())
            .expect("the test's folder is writable");
        let mut server = Self {
            process: None,
            ports: free_ports(),
            program: program.into(),
            scratch,
        };
        server.up();
        Some(server)
    }

    /// Starts the server, for the first time or again with its existing objects, and waits until it
    /// answers.
    ///
    /// # Panics
    /// If it is running already, or does not start.
    pub fn up(&mut self) {
        assert!(self.process.is_none(), "the server runs");
        let mut command = Command::new(&self.program);
        let dir = |name: &str| self.scratch.join(name).display().to_string();
        command
            .arg("server")
            .args(["-ip=127.0.0.1", "-ip.bind=127.0.0.1", "-filer", "-s3"]);
        command.args([
            "-master.telemetry=false",
            "-master.electionTimeout=1s",
            "-s3.iam=false",
        ]);
        command.args([
            "-master.volumeSizeLimitMB=64",
            "-volume.max=60",
            "-volume.minFreeSpace=1MiB",
        ]);
        command.args(["-s3.port.lance=0", "-s3.port.iceberg=0"]);
        command.args([
            format!("-dir={}", dir("data")),
            format!("-s3.config={}", dir("s3.json")),
            format!("-s3.localSocket={}", dir("s3.sock")),
            format!("-filer.localSocket={}", dir("filer.sock")),
        ]);
        for (part, (http, grpc)) in PARTS.iter().zip(self.ports) {
            command.arg(format!("-{part}.port={http}"));
            command.arg(format!("-{part}.port.grpc={grpc}"));
        }
        // The server writes a pid file and reads settings in its working folder.
        command.current_dir(self.scratch.path());
        let mut process = Process::start("weed", command, self.scratch.path());
        let bucket = self.store("probe");
        let runtime = runtime();
        until("the S3 server to answer", || {
            assert!(process.runs(), "weed ended: {}", process.stderr());
            self.create_bucket("probe");
            let key = Path::from("ready");
            let put = bucket.put(&key, "yes".into());
            runtime.block_on(put).ok()
        });
        self.process = Some(process);
    }

    /// Ends the server as `kill -9` does. Its objects remain.
    ///
    /// # Panics
    /// If it is not running.
    pub fn kill(&mut self) {
        self.process.take().expect("the server runs").kill();
    }

    /// Returns its S3 endpoint.
    pub fn endpoint(&self) -> String {
        format!("http://127.0.0.1:{}", self.ports[3].0)
    }

    /// Creates a bucket and returns its name.
    pub fn bucket(&self) -> String {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let name = format!("farm-{}", COUNT.fetch_add(1, Ordering::Relaxed));
        assert!(self.create_bucket(&name), "a bucket can be created");
        name
    }

    /// Configures commands with the server and its keys.
    pub fn with(&self, cli: Cli) -> Cli {
        self.as_user(cli, (KEY, SECRET))
    }

    /// Configures commands with the server and these keys.
    pub fn as_user(&self, cli: Cli, (key, secret): (&str, &str)) -> Cli {
        cli.with("AWS_ENDPOINT_URL", &self.endpoint())
            .with("AWS_ALLOW_HTTP", "true")
            .with("AWS_REGION", "us-east-1")
            .with("AWS_ACCESS_KEY_ID", key)
            .with("AWS_SECRET_ACCESS_KEY", secret)
    }

    /// Returns the SHA-256 of every object below a prefix, by its key there.
    ///
    /// # Panics
    /// If an object cannot be read.
    pub fn hashes(&self, bucket: &str, prefix: &str) -> BTreeMap<String, String> {
        let store = self.store(bucket);
        let below = Path::from(prefix);
        let read = async {
            let mut hashes = BTreeMap::new();
            for meta in store.list(Some(&below)).try_collect::<Vec<_>>().await? {
                let bytes = store.get(&meta.location).await?.bytes().await?;
                let key = meta.location.as_ref()[prefix.len()..].trim_start_matches('/');
                hashes.insert(key.to_owned(), hex::encode(Sha256::digest(&bytes)));
            }
            Ok::<_, object_store::Error>(hashes)
        };
        runtime().block_on(read).expect("the objects can be read")
    }

    /// Returns the bytes of an object.
    ///
    /// # Panics
    /// If there is none.
    pub fn get(&self, bucket: &str, key: &str) -> Vec<u8> {
        let key = Path::from(key);
        let store = self.store(bucket);
        let bytes = runtime().block_on(async { store.get(&key).await?.bytes().await });
        bytes.expect("the object is there").to_vec()
    }

    /// Puts an object, replacing any existing one.
    ///
    /// # Panics
    /// If the server refuses.
    pub fn put(&self, bucket: &str, key: &str, bytes: Vec<u8>) {
        let (store, key) = (self.store(bucket), Path::from(key));
        let put = runtime().block_on(async { store.put(&key, bytes.into()).await });
        put.expect("the object can be written");
    }

    /// Deletes an object without the program's knowledge.
    ///
    /// # Panics
    /// If it cannot be deleted.
    pub fn delete(&self, bucket: &str, key: &str) {
        let (store, key) = (self.store(bucket), Path::from(key));
        runtime()
            .block_on(async { store.delete(&key).await })
            .expect("the object can be deleted");
    }

    fn store(&self, bucket: &str) -> Arc<AmazonS3> {
        // The client uses the process's cryptography provider, which the first call installs.
        let _ = rustls::crypto::ring::default_provider().install_default();
        let store = AmazonS3Builder::new()
            .with_endpoint(self.endpoint())
            .with_allow_http(true)
            .with_region("us-east-1")
            .with_access_key_id(KEY)
            .with_secret_access_key(SECRET)
            .with_bucket_name(bucket)
            .with_disable_bulk_delete(true)
            .with_retry(RetryConfig {
                max_retries: 0,
                ..RetryConfig::default()
            })
            .build();
        Arc::new(store.expect("the settings go together"))
    }

    /// Buckets are folders of the filer, which requires no keys.
    fn create_bucket(&self, name: &str) -> bool {
        let request = || {
            let mut filer = TcpStream::connect(("127.0.0.1", self.ports[2].0)).ok()?;
            write!(
                filer,
                "POST /buckets/{name}/ HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"
            )
            .ok()?;
            let mut answer = String::new();
            filer.read_to_string(&mut answer).ok()?;
            Some(answer.starts_with("HTTP/1.1 2") || answer.starts_with("HTTP/1.1 409"))
        };
        request().unwrap_or(false)
    }
}

fn runtime() -> tokio::runtime::Runtime {
    tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .expect("a runtime can be made")
}

/// Returns free ports, because the server cannot choose them itself.
fn free_ports() -> [(u16, u16); 4] {
    PARTS.map(|_| (lasting(), lasting()))
}
