//! The coordinator under test: this program, in a process of its own.

use std::{
    io::{BufRead, BufReader, Read, Write},
    net::TcpStream,
    process::{Child, Command, Stdio},
};

use picofarm_database::CatalogPlace;

use picofarm_cli::{
    client::Client,
    error::{CliError, Code, Result},
};

/// A coordinator's process, killed on drop.
pub struct Server {
    child: Child,
    url: String,
    /// Address of its metrics, `host:port`.
    http: String,
    place: CatalogPlace,
    lease_s: f64,
}

/// Resources used by a process.
#[derive(Debug, Clone, Copy)]
pub struct Usage {
    pub cpu_s: f64,
    pub peak_bytes: u64,
}

impl Server {
    pub async fn start(place: &CatalogPlace, lease_s: f64) -> Result<Self> {
        let place = place.clone();
        let started = tokio::task::spawn_blocking(move || {
            let (child, url, http) = spawn(&place, "127.0.0.1:0", lease_s)?;
            Ok(Self {
                child,
                url,
                http,
                place,
                lease_s,
            })
        });
        started
            .await
            .map_err(|e| CliError::new(Code::Failed, format!("starting a coordinator: {e}")))?
    }

    pub fn url(&self) -> &str {
        &self.url
    }

    pub async fn client(&self) -> Result<Client> {
        Client::connect(&self.url, &picofarm_tasks::Access::default()).await
    }

    /// Kills the process and starts another on the same catalog. Returns the resources used by the
    /// first.
    pub async fn kill_and_restart(&mut self) -> Result<Usage> {
        let usage = self.usage()?;
        self.end();
        let address = self.url.trim_start_matches("http://");
        let (child, _, http) = spawn(&self.place, address, self.lease_s)?;
        self.child = child;
        self.http = http;
        Ok(usage)
    }

    /// Returns the number of commits to the catalog so far.
    pub fn commits(&self) -> Result<u64> {
        let failed =
            |e: std::io::Error| CliError::new(Code::Resource, format!("reading metrics: {e}"));
        let mut stream = TcpStream::connect(&self.http).map_err(failed)?;
        let request = format!(
            "GET /metrics HTTP/1.1\r\nHost: {}\r\nConnection: close\r\n\r\n",
            self.http
        );
        stream.write_all(request.as_bytes()).map_err(failed)?;
        let mut page = String::new();
        stream.read_to_string(&mut page).map_err(failed)?;
        let count = page
            .lines()
            .filter_map(|line| line.split_once("catalog_commit_seconds_count "))
            .find_map(|(_, count)| count.trim().parse::<f64>().ok());
        count
            .map(|count| count as u64)
            .ok_or_else(|| CliError::new(Code::Failed, "the coordinator's metrics lack commits"))
    }

    /// Returns CPU time and peak memory so far.
    pub fn usage(&self) -> Result<Usage> {
        usage(self.child.id())
    }

    fn end(&mut self) {
        // It may have ended by itself.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.end();
    }
}

/// Returns CPU time and peak memory of a process so far.
///
/// # Errors
/// Fails if it has ended, and on systems other than Linux.
pub fn usage(id: u32) -> Result<Usage> {
    let read = |file: &str| {
        std::fs::read_to_string(format!("/proc/{id}/{file}")).map_err(|e| {
            CliError::new(
                Code::Resource,
                format!("/proc/{id}/{file}: {e}; this bench needs Linux"),
            )
        })
    };
    let stat = read("stat")?;
    // After the name in parentheses: utime and stime are fields 14 and 15 of the whole.
    let fields: Vec<&str> = stat
        .rsplit_once(')')
        .map_or("", |(_, rest)| rest)
        .split_whitespace()
        .collect();
    let ticks = |at: usize| {
        fields
            .get(at)
            .and_then(|t| t.parse::<f64>().ok())
            .unwrap_or(0.0)
    };
    let status = read("status")?;
    let peak = status
        .lines()
        .find_map(|line| line.strip_prefix("VmHWM:"))
        .and_then(|kib| kib.trim().strip_suffix("kB"))
        .and_then(|kib| kib.trim().parse::<u64>().ok());
    Ok(Usage {
        cpu_s: (ticks(11) + ticks(12)) / rustix::param::clock_ticks_per_second() as f64,
        peak_bytes: peak.unwrap_or(0) * 1024,
    })
}

fn spawn(place: &CatalogPlace, listen: &str, lease_s: f64) -> Result<(Child, String, String)> {
    let failed =
        |e: std::io::Error| CliError::new(Code::Resource, format!("starting a coordinator: {e}"));
    let program = std::env::current_exe().map_err(failed)?;
    let url = match place {
        CatalogPlace::Sqlite(path) => path.display().to_string(),
        CatalogPlace::Postgres(url) => url.clone(),
    };
    let mut child = Command::new(program)
        .args([
            "coordinator",
            "--json",
            "--allow-insecure",
            "--listen",
            listen,
            "--http",
            "127.0.0.1:0",
        ])
        .args(["--lease-s", &lease_s.to_string(), "--log", "warn"])
        // Simulated workers store nothing.
        .args(["--check-stores", "none"])
        // A lost session counts until it is noticed.
        .args(["--max-sessions", "100000"])
        .args(["--max-jobs-per-user", "100000"])
        // Not as an argument, because it may contain a password.
        .env("PICOFARM_CATALOG", url)
        .stdout(Stdio::piped())
        .spawn()
        .map_err(failed)?;
    let mut line = String::new();
    let out = child.stdout.take().expect("stdout is piped");
    BufReader::new(out).read_line(&mut line).map_err(failed)?;
    let said: serde_json::Value = serde_json::from_str(&line).unwrap_or_default();
    match (said["coordinator"].as_str(), said["http"].as_str()) {
        (Some(url), Some(http)) => {
            let http = http.trim_start_matches("http://").to_owned();
            Ok((child, url.to_owned(), http))
        }
        _ => {
            let _ = child.kill();
            let _ = child.wait();
            Err(CliError::new(
                Code::Resource,
                "the coordinator did not start; its own words stand above",
            ))
        }
    }
}
