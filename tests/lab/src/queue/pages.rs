//! `just lab pages`: measures the pages of `picofarm web` next to a coordinator with many jobs and
//! workers. Coordinator and web server are processes of their own.

use std::{
    io::{BufRead, BufReader, Read, Write},
    net::TcpStream,
    process::{Child, Command, Stdio},
    time::{Duration, Instant},
};

use picofarm_cli::{
    client::{Client, Listing},
    error::{CliError, Code, Result},
    output::{Output, table},
    signals::interrupted,
};
use picofarm_database::CatalogPlace;
use picofarm_proto::{ids::JobId, messages::JobState};
use serde::Serialize;
use tokio::{
    io::{AsyncReadExt, AsyncWriteExt},
    task::JoinSet,
};
use tokio_util::sync::CancellationToken;

use super::{
    Running,
    server::{Server, Usage, usage},
    spec,
    stats::{Latency, latency},
};
use crate::args::Pages;

/// Jobs that are submitted at a time.
const AT_ONCE: u64 = 16;
/// Jobs that wait behind the large one.
const WAITING: u64 = 200;
/// Workers that finish the first half at once.
const INSTANT: usize = 8;
/// Length of the tasks that run while the pages are asked for.
const TASK: Duration = Duration::from_secs(30);
/// Time for which the coordinator's CPU is measured.
const WATCH: Duration = Duration::from_secs(20);

/// Results of the benchmark.
#[derive(Debug, Serialize)]
struct Report {
    catalog: String,
    jobs: u64,
    tasks: u64,
    workers: usize,
    pages: Vec<PageTime>,
    viewers: Vec<Viewers>,
}

/// Time of a page, from the request to its last byte.
#[derive(Debug, Serialize)]
struct PageTime {
    page: String,
    /// Bytes on the wire, compressed by gzip.
    bytes: usize,
    /// Milliseconds of the first request.
    first_ms: f64,
    time: Latency,
}

/// CPU of the coordinator and of the web server, in shares of a core.
#[derive(Debug, Serialize)]
struct Viewers {
    what: String,
    viewers: usize,
    /// Of the coordinator, without its share for the workers.
    coordinator: f64,
    web: f64,
}

/// Runs the benchmark.
///
/// # Errors
/// Fails if a process does not start, or if a page is not answered.
pub async fn run(args: Pages, output: Output, stop: &CancellationToken) -> Result<()> {
    let scratch = tempfile::tempdir()
        .map_err(|e| CliError::new(Code::Resource, format!("a scratch folder: {e}")))?;
    let place = match &args.catalog {
        Some(place) => place.clone(),
        None => CatalogPlace::Sqlite(scratch.path().join("catalog.sqlite")),
    };
    let server = Server::start(&place, 60.0).await?;
    let mut client = server.client().await?;
    let (small, large) = match filled(&args, &mut client).await? {
        Some(found) => found,
        None => fill(&args, &server, &mut client, output, stop).await?,
    };
    let fleet = Running::start(&server, args.workers, TASK);
    fleet.connected(args.workers as u64, stop).await?;
    // Some tasks may be too few for all workers.
    let deadline = Instant::now() + 2 * TASK;
    while client.status(large).await?.tasks.leased < args.workers as u64
        && Instant::now() < deadline
    {
        wait(Duration::from_millis(500), stop).await?;
    }
    let web = Web::start(server.url())?;
    let mut report = Report {
        catalog: match place {
            CatalogPlace::Sqlite(_) => "SQLite".into(),
            CatalogPlace::Postgres(_) => "Postgres".into(),
        },
        jobs: args.jobs,
        tasks: args.tasks,
        workers: args.workers,
        pages: Vec::new(),
        viewers: Vec::new(),
    };
    let shown = [
        ("farm", "/".to_owned()),
        ("jobs", "/jobs".to_owned()),
        ("failed jobs", "/jobs?state=failed".to_owned()),
        ("jobs by name", "/jobs?find=bench".to_owned()),
        ("large job", format!("/jobs/{large}")),
        ("its log", format!("/jobs/{large}?view=log")),
        ("its file", format!("/jobs/{large}?view=file")),
        ("one of its tasks", format!("/jobs/{large}/tasks/0/17")),
        ("small job", format!("/jobs/{}", small[0])),
        ("workers", "/workers".to_owned()),
        ("events", "/events".to_owned()),
        ("audit", "/audit".to_owned()),
    ];
    for (name, path) in &shown {
        report.pages.push(web.time(name, path, args.asks)?);
        output.say(format!("{name}: {:?}", report.pages.last().map(|p| p.time)));
    }
    let same = |path: &str| vec![path.to_owned(); args.viewers];
    let mixed: Vec<String> = shown.iter().map(|(_, path)| path.clone()).collect();
    let mixed: Vec<String> = mixed.iter().cycle().take(args.viewers).cloned().collect();
    let distinct = small.iter().take(args.viewers);
    let distinct: Vec<String> = distinct.map(|job| format!("/jobs/{job}")).collect();
    let idle = watch(&server, &web, &[], stop).await?;
    for (what, paths) in [
        ("all follow the farm", same("/")),
        ("all follow the large job", same(&format!("/jobs/{large}"))),
        ("each of these pages has some", mixed),
        ("each follows a job of its own", distinct),
    ] {
        let [coordinator, web] = watch(&server, &web, &paths, stop).await?;
        report.viewers.push(Viewers {
            what: what.into(),
            viewers: paths.len(),
            coordinator: coordinator - idle[0],
            web,
        });
        output.say(format!(
            "{what}: {coordinator:.3} of a core, {:.3} idle",
            idle[0]
        ));
    }
    fleet.stop().await?;
    output.result(&report, || describe(&report));
    Ok(())
}

async fn wait(time: Duration, stop: &CancellationToken) -> Result<()> {
    tokio::select! {
        () = tokio::time::sleep(time) => Ok(()),
        () = stop.cancelled() => Err(interrupted("nothing is kept of a bench")),
    }
}

/// Returns small jobs and the large one of a catalog that an earlier run filled; `None` if it has
/// too few jobs.
async fn filled(args: &Pages, client: &mut Client) -> Result<Option<(Vec<JobId>, JobId)>> {
    let (mut jobs, mut page) = (Vec::new(), None);
    loop {
        let listing = Listing {
            limit: 1000,
            page: page.as_deref(),
            state: None,
            user: None,
            find: None,
        };
        let (some, next) = client.list(&listing).await?;
        jobs.extend(some);
        match next {
            Some(next) => page = Some(next),
            None => break,
        }
    }
    if (jobs.len() as u64) < args.jobs {
        return Ok(None);
    }
    let active = jobs.iter().filter(|job| job.state == JobState::Active);
    let large = active.max_by_key(|job| job.tasks.total).map(|job| job.id);
    let small = jobs.iter().filter(|job| job.state == JobState::Done);
    let small = small.map(|job| job.id).collect();
    Ok(large.map(|large| (small, large)))
}

/// Makes the jobs: half of the tasks belong to one job, of which half is done, and the rest to many
/// small ones. Returns small jobs, and the large one.
async fn fill(
    args: &Pages,
    server: &Server,
    client: &mut Client,
    output: Output,
    stop: &CancellationToken,
) -> Result<(Vec<JobId>, JobId)> {
    let small = args.jobs.saturating_sub(WAITING + 1).max(1);
    let each = (args.tasks / 2 / args.jobs.max(1)).max(1);
    let instant = Running::start(server, INSTANT, Duration::ZERO);
    instant.connected(INSTANT as u64, stop).await?;
    let start = Instant::now();
    let mut jobs = Vec::new();
    for from in (0..small).step_by(AT_ONCE as usize) {
        let batch = AT_ONCE.min(small - from);
        let submits = (0..batch).map(|_| {
            let mut client = client.clone();
            async move { client.submit(spec(each), false).await }
        });
        for submitted in futures::future::join_all(submits).await {
            jobs.push(submitted?.job);
        }
        if stop.is_cancelled() {
            return Err(interrupted("nothing is kept of a bench"));
        }
    }
    output.say(format!(
        "{small} jobs in {:.1} s",
        start.elapsed().as_secs_f64()
    ));
    let large = client.submit(spec(args.tasks / 2), false).await?.job;
    loop {
        let status = client.status(large).await?;
        if status.tasks.done >= args.tasks / 4 || status.state != JobState::Active {
            break;
        }
        wait(Duration::from_millis(50), stop).await?;
    }
    instant.stop().await?;
    for _ in 0..args.jobs - small - 1 {
        client.submit(spec(each), false).await?;
    }
    jobs.reverse();
    Ok((jobs, large))
}

/// Returns the shares of a core that coordinator and web server take while pages are followed.
async fn watch(
    server: &Server,
    web: &Web,
    paths: &[String],
    stop: &CancellationToken,
) -> Result<[f64; 2]> {
    let mut viewers = JoinSet::new();
    for path in paths {
        let to: String = path.bytes().map(|byte| format!("%{byte:02x}")).collect();
        let request = web.request(&format!("/live?to={to}"), "keep-alive");
        let address = web.address.clone();
        viewers.spawn(async move {
            let mut stream = tokio::net::TcpStream::connect(address).await?;
            stream.write_all(request.as_bytes()).await?;
            let mut part = vec![0; 1 << 16];
            let head = stream.read(&mut part).await?;
            if !part[..head].starts_with(b"HTTP/1.1 200") {
                let head = String::from_utf8_lossy(&part[..head]).into_owned();
                return Err(std::io::Error::other(head));
            }
            while stream.read(&mut part).await? > 0 {}
            Ok(())
        });
    }
    // The first second opens the connections and reads what later requests share.
    wait(Duration::from_secs(3), stop).await?;
    if let Some(ended) = viewers.try_join_next() {
        let what = format!("a followed page ended: {ended:?}");
        return Err(CliError::new(Code::Failed, what));
    }
    let (start, before) = (Instant::now(), [server.usage()?, web.usage()?]);
    wait(WATCH, stop).await?;
    let (seconds, after) = (start.elapsed(), [server.usage()?, web.usage()?]);
    let share = |i: usize| (after[i].cpu_s - before[i].cpu_s) / seconds.as_secs_f64();
    Ok([share(0), share(1)])
}

/// The web server under test: this program, in a process of its own, killed on drop.
struct Web {
    child: Child,
    address: String,
    cookie: String,
}

fn failed(error: std::io::Error) -> CliError {
    CliError::new(Code::Resource, format!("asking the web server: {error}"))
}

impl Web {
    fn start(coordinator: &str) -> Result<Self> {
        let program = std::env::current_exe().map_err(failed)?;
        let mut child = Command::new(program)
            .args(["web", "--json", "--listen", "127.0.0.1:0"])
            .args(["--coordinator", coordinator])
            .stdout(Stdio::piped())
            .spawn()
            .map_err(failed)?;
        let mut line = String::new();
        let out = child.stdout.take().expect("stdout is piped");
        BufReader::new(out).read_line(&mut line).map_err(failed)?;
        let said: serde_json::Value = serde_json::from_str(&line).unwrap_or_default();
        let link = said["web"].as_str().unwrap_or_default();
        let parts = link.strip_prefix("http://").and_then(|l| l.split_once('/'));
        let Some((address, path)) = parts else {
            let _ = child.kill();
            return Err(CliError::new(
                Code::Resource,
                "the web server did not start",
            ));
        };
        let mut web = Self {
            address: address.to_owned(),
            cookie: String::new(),
            child,
        };
        let admitted = web.ask(&format!("/{path}"))?;
        let head = String::from_utf8_lossy(&admitted).into_owned();
        let cookie = head.lines().find_map(|l| l.strip_prefix("set-cookie: "));
        web.cookie = cookie
            .and_then(|c| c.split(';').next())
            .unwrap_or_default()
            .to_owned();
        Ok(web)
    }

    fn request(&self, path: &str, connection: &str) -> String {
        format!(
            "GET {path} HTTP/1.1\r\nHost: {}\r\nCookie: {}\r\nAccept-Encoding: gzip\r\nConnection: {connection}\r\n\r\n",
            self.address, self.cookie
        )
    }

    /// Returns the whole answer.
    fn ask(&self, path: &str) -> Result<Vec<u8>> {
        let mut stream = TcpStream::connect(&self.address).map_err(failed)?;
        let request = self.request(path, "close");
        stream.write_all(request.as_bytes()).map_err(failed)?;
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).map_err(failed)?;
        Ok(answer)
    }

    fn time(&self, page: &str, path: &str, asks: usize) -> Result<PageTime> {
        let mut seconds = Vec::new();
        let mut bytes = 0;
        for _ in 0..asks {
            let start = Instant::now();
            let answer = self.ask(path)?;
            seconds.push(start.elapsed().as_secs_f64());
            if !answer.starts_with(b"HTTP/1.1 200") {
                let head = String::from_utf8_lossy(&answer[..answer.len().min(300)]).into_owned();
                return Err(CliError::new(Code::Failed, format!("{path}: {head}")));
            }
            bytes = answer.len();
        }
        Ok(PageTime {
            page: page.to_owned(),
            bytes,
            first_ms: 1e3 * seconds.first().copied().unwrap_or_default(),
            time: latency(seconds),
        })
    }

    fn usage(&self) -> Result<Usage> {
        usage(self.child.id())
    }
}

impl Drop for Web {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn describe(report: &Report) -> String {
    let head = ["page", "kB", "first ms", "p50 ms", "p99 ms", "most ms"];
    let mut rows = vec![head.map(String::from).to_vec()];
    for p in &report.pages {
        let ms = |ms: f64| format!("{ms:.1}");
        rows.push(vec![
            p.page.clone(),
            format!("{:.1}", p.bytes as f64 / 1e3),
            ms(p.first_ms),
            ms(p.time.p50_ms),
            ms(p.time.p99_ms),
            ms(p.time.most_ms),
        ]);
    }
    let head = [
        "viewers",
        "",
        "coordinator, % of a core",
        "web, % of a core",
    ];
    let mut viewers = vec![head.map(String::from).to_vec()];
    for v in &report.viewers {
        viewers.push(vec![
            v.viewers.to_string(),
            v.what.clone(),
            format!("{:.1}", 100.0 * v.coordinator),
            format!("{:.1}", 100.0 * v.web),
        ]);
    }
    format!(
        "{}: {} jobs, {} tasks, {} workers\n\n{}\n{}",
        report.catalog,
        report.jobs,
        report.tasks,
        report.workers,
        table(&rows),
        table(&viewers)
    )
}
