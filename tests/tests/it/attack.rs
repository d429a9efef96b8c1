//! Malicious clients: limits the coordinator's memory, whatever clients send and whatever they
//! leave unread. `cargo nextest run -p picofarm-tests --test attack --run-ignored all --no-capture`
//! prints the maximum resident size by memory limit.

use std::{
    collections::HashMap,
    io::{Read, Write},
    net::TcpStream,
    time::{Duration, Instant},
};

use picofarm_proto::wire::{self, jobs_client::JobsClient};
use picofarm_tests::{
    Cli, Job, Process, Scratch,
    http::{get, sample},
    wait::until,
};
use serde_json::Value;

const PREFACE: &[u8] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n";
const DATA: u8 = 0;
const HEADERS: u8 = 1;
const RESET: u8 = 3;
const SETTINGS: u8 = 4;
const PING: u8 = 6;
const WINDOW: u8 = 8;
const END_STREAM: u8 = 1;
const END_HEADERS: u8 = 4;

/// A client that follows only HTTP/2's framing and accepts no answer that it need not accept.
struct Rude {
    stream: TcpStream,
    next: u32,
    /// Flow-control window of the connection for sending.
    window: i64,
    /// Flow-control windows of the open streams for sending.
    streams: HashMap<u32, i64>,
    buffer: Vec<u8>,
    settings: Vec<(u16, u32)>,
}

impl Rude {
    fn connect(address: &str) -> Option<Self> {
        let stream = TcpStream::connect(address).ok()?;
        let timeout = Some(Duration::from_millis(200));
        stream.set_read_timeout(timeout).ok()?;
        stream
            .set_write_timeout(Some(Duration::from_secs(5)))
            .ok()?;
        let mut rude = Self {
            stream,
            next: 1,
            window: 65_535,
            streams: HashMap::new(),
            buffer: Vec::new(),
            settings: Vec::new(),
        };
        rude.stream.write_all(PREFACE).ok()?;
        // The server may not send anything: SETTINGS_INITIAL_WINDOW_SIZE = 0.
        rude.frame(SETTINGS, 0, 0, &[0, 4, 0, 0, 0, 0])?;
        Some(rude)
    }

    fn frame(&mut self, kind: u8, flags: u8, stream: u32, payload: &[u8]) -> Option<()> {
        let mut frame = u32::try_from(payload.len()).ok()?.to_be_bytes()[1..].to_vec();
        frame.extend([kind, flags]);
        frame.extend(stream.to_be_bytes());
        frame.extend(payload);
        self.stream.write_all(&frame).ok()
    }

    /// Reads the available frames for window updates and settings.
    fn listen(&mut self) -> Option<()> {
        let mut some = [0; 16 << 10];
        match self.stream.read(&mut some) {
            Ok(0) => return None,
            Ok(n) => self.buffer.extend_from_slice(&some[..n]),
            Err(error) => {
                use std::io::ErrorKind::{TimedOut, WouldBlock};
                return matches!(error.kind(), TimedOut | WouldBlock).then_some(());
            }
        }
        while self.buffer.len() >= 9 {
            let head = &self.buffer[..9];
            let length =
                usize::from(head[0]) << 16 | usize::from(head[1]) << 8 | usize::from(head[2]);
            let (kind, flags) = (head[3], head[4]);
            let stream = u32::from_be_bytes([head[5] & 0x7f, head[6], head[7], head[8]]);
            if self.buffer.len() < 9 + length {
                break;
            }
            let payload: Vec<u8> = self.buffer.drain(..9 + length).skip(9).collect();
            match kind {
                SETTINGS if flags == 0 => {
                    let number = |b: &[u8]| b.iter().fold(0u32, |n, b| n << 8 | u32::from(*b));
                    let pair = |b: &[u8]| (number(&b[..2]) as u16, number(&b[2..]));
                    self.settings.extend(payload.chunks_exact(6).map(pair));
                    self.frame(SETTINGS, 1, 0, &[])?;
                }
                PING if flags == 0 => self.frame(PING, 1, 0, &payload)?,
                RESET => {
                    self.streams.remove(&stream);
                }
                WINDOW => {
                    let more: [u8; 4] = payload.try_into().ok()?;
                    let more = i64::from(u32::from_be_bytes(more));
                    match self.streams.get_mut(&stream) {
                        Some(window) => *window += more,
                        None if stream == 0 => self.window += more,
                        None => {}
                    }
                }
                _ => {}
            }
        }
        Some(())
    }

    /// Opens a request with `extra` bytes of meaningless headers.
    fn request(&mut self, method: &str, extra: usize, end: bool) -> Option<u32> {
        let path = format!("/picofarm.v1.Jobs/{method}");
        let filler = "x".repeat(extra);
        let mut block = Vec::new();
        for (name, value) in [
            (":method", "POST"),
            (":scheme", "http"),
            (":authority", "localhost"),
            (":path", &path),
            ("te", "trailers"),
            ("content-type", "application/grpc"),
            ("x-filler", &filler),
        ] {
            literal(&mut block, name, value);
        }
        let id = self.next;
        self.next += 2;
        self.streams.insert(id, 65_535);
        let flags = END_HEADERS | if end { END_STREAM } else { 0 };
        self.frame(HEADERS, flags, id, &block)?;
        Some(id)
    }

    /// Sends a message on a stream until it is refused, as far as the windows allow within some
    /// seconds.
    fn message(&mut self, stream: u32, message: &[u8]) -> Option<()> {
        let mut data = vec![0];
        data.extend(u32::try_from(message.len()).ok()?.to_be_bytes());
        data.extend(message);
        let until = Instant::now() + Duration::from_secs(5);
        let mut left = &data[..];
        while !left.is_empty() && Instant::now() < until {
            let Some(window) = self.streams.get_mut(&stream) else {
                return Some(());
            };
            let some = left.len().min(16_000);
            if self.window.min(*window) < some as i64 {
                self.listen()?;
                continue;
            }
            self.window -= some as i64;
            *window -= some as i64;
            self.frame(DATA, 0, stream, &left[..some])?;
            left = &left[some..];
        }
        Some(())
    }
}

/// Appends a header without indexing or compression.
fn literal(block: &mut Vec<u8>, name: &str, value: &str) {
    block.push(0);
    for text in [name, value] {
        let mut length = text.len();
        if length < 127 {
            block.push(length as u8);
        } else {
            block.push(127);
            length -= 127;
            while length >= 128 {
                block.push((length % 128) as u8 | 128);
                length /= 128;
            }
            block.push(length as u8);
        }
        block.extend(text.bytes());
    }
}

struct Target {
    process: Process,
    address: String,
    http: String,
}

impl Target {
    fn start(cli: &Cli, mib: u64) -> Self {
        let mib = mib.to_string();
        let mut args = vec![
            "coordinator",
            "--allow-insecure",
            "--json",
            "--memory-mib",
            &mib,
        ];
        args.extend(["--listen", "127.0.0.1:0", "--http", "127.0.0.1:0"]);
        let mut process = cli.start("coordinator", &args);
        let line: Value = serde_json::from_str(&process.first_line()).expect("a line of JSON");
        let address = |name: &str| line[name].as_str().expect("an address").to_owned();
        let (url, http) = (address("coordinator"), address("http"));
        until("the coordinator to be ready", || {
            get(&format!("{http}/readyz")).filter(|(code, _)| *code == 200)
        });
        Self {
            process,
            address: url.trim_start_matches("http://").to_owned(),
            http,
        }
    }

    /// Returns the resident size in MiB: current, and maximum so far.
    fn resident(&self) -> (u64, u64) {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.process.id()));
        let status = status.expect("it runs");
        let kib = |name: &str| {
            let line = status.lines().find_map(|line| line.strip_prefix(name));
            let kib = line.and_then(|kib| kib.trim().strip_suffix("kB")?.trim().parse().ok());
            kib.unwrap_or(0u64)
        };
        (kib("VmRSS:") / 1024, kib("VmHWM:") / 1024)
    }

    fn metric(&self, name: &str) -> f64 {
        let (_, page) = get(&format!("{}/metrics", self.http)).expect("a page");
        sample(&page, &format!("picofarm_{name}")).unwrap_or_else(|| panic!("no {name}"))
    }
}

/// Returns a message with a spec of many short strings. After parsing, each string takes ten times
/// its length.
fn dense(bytes: usize) -> Vec<u8> {
    let json = format!("[{}\"a\"]", "\"a\",".repeat(bytes / 4));
    nested(1, &nested(1, json.as_bytes()))
}

fn nested(field: u8, content: &[u8]) -> Vec<u8> {
    let mut message = vec![field << 3 | 2];
    let mut length = content.len();
    while length >= 128 {
        message.push((length % 128) as u8 | 128);
        length /= 128;
    }
    message.push(length as u8);
    message.extend(content);
    message
}

/// Sends requests with long headers and does not read the answers.
fn headers(address: &str, connections: usize, requests: usize) {
    std::thread::scope(|scope| {
        for _ in 0..connections {
            scope.spawn(|| {
                let mut rude = Rude::connect(address)?;
                for _ in 0..requests {
                    rude.request("GetServerInfo", 12_000, false)?;
                }
                rude.listen()
            });
        }
    });
}

/// Sends large specs, many at a time.
fn specs(address: &str, connections: usize, requests: usize, bytes: usize) {
    let message = dense(bytes);
    std::thread::scope(|scope| {
        for _ in 0..connections {
            scope.spawn(|| {
                let mut rude = Rude::connect(address)?;
                rude.listen()?;
                for _ in 0..requests {
                    let stream = rude.request("PlanJob", 0, false)?;
                    rude.message(stream, &message)?;
                }
                rude.listen()
            });
        }
    });
}

/// Requests lists and does not read them.
fn unread(address: &str, connections: usize, requests: usize) {
    std::thread::scope(|scope| {
        for _ in 0..connections {
            scope.spawn(|| {
                let mut rude = Rude::connect(address)?;
                for _ in 0..requests {
                    let stream = rude.request("ListEvents", 0, false)?;
                    rude.message(stream, &[])?;
                }
                std::thread::sleep(Duration::from_secs(2));
                rude.listen()
            });
        }
    });
}

/// Opens connections that stop in the middle of their first request.
fn halves(address: &str, connections: usize) {
    let mut open = Vec::new();
    for _ in 0..connections {
        let Some(mut rude) = Rude::connect(address) else {
            break;
        };
        let mut block = Vec::new();
        literal(&mut block, "x-filler", &"x".repeat(14_000));
        // Without END_HEADERS: more should follow, and does not.
        let _ = rude.frame(HEADERS, 0, 1, &block);
        open.push(rude);
    }
    std::thread::sleep(Duration::from_secs(1));
}

/// Creates a long history by pausing and resuming a job again and again.
fn history(scratch: &Scratch, target: &Target, lines: usize) {
    let url = format!("http://{}", target.address);
    let cli = Cli::new(scratch.path()).with("PICOFARM_COORDINATOR", &url);
    let file = scratch.join("job.toml");
    Job::quick(&scratch.join("store"), 4).write(&file);
    let answer = cli.json(&["job", "submit", &file.display().to_string()]);
    let id = answer["job"].as_str().expect("a job").to_owned();
    let runtime = tokio::runtime::Runtime::new().expect("a runtime");
    runtime.block_on(async {
        let mut jobs = JobsClient::connect(url).await.expect("it listens");
        for _ in 0..lines / 2 {
            let job_id = id.clone();
            let held = jobs.pause_job(wire::PauseJobRequest { job_id }).await;
            held.expect("it is active");
            let job_id = id.clone();
            let goes_on = jobs.resume_job(wire::ResumeJobRequest { job_id }).await;
            goes_on.expect("it is held");
        }
    });
}

/// Runs all attacks with this number of connections. Returns the maximum resident size in MiB after
/// each.
fn attack(target: &Target, connections: usize) -> Vec<(&'static str, u64)> {
    let address = &*target.address;
    let mut worst = Vec::new();
    let mut note = |what| worst.push((what, target.resident().1));
    note("idle");
    headers(address, connections, 2_000);
    note("headers");
    specs(address, connections, 8, 4 << 20);
    note("specs");
    unread(address, connections, 400);
    note("unread lists");
    halves(address, 40 * connections);
    note("half requests");
    worst
}

#[test]
fn a_caller_without_a_token_does_not_exhaust_a_small_coordinator() {
    let scratch = Scratch::new("attack");
    let cli = Cli::new(scratch.path());
    let mib = 256;
    let target = Target::start(&cli, mib);
    let mut rude = Rude::connect(&target.address).expect("it listens");
    until("its settings", || {
        rude.listen().expect("it is open");
        (!rude.settings.is_empty()).then_some(())
    });
    let streams = rude.settings.iter().find(|(name, _)| *name == 3);
    assert_eq!(streams, Some(&(3, 100)), "MAX_CONCURRENT_STREAMS");
    history(&scratch, &target, 400);
    let worst = attack(&target, 4);
    let (_, most) = target.resident();
    assert!(most < mib, "{most} MiB of {mib}: {worst:?}");
    let (charged, limit) = (
        target.metric("request_memory_most_bytes"),
        target.metric("request_memory_limit_bytes"),
    );
    assert!(charged <= (mib << 20) as f64 * 0.75, "{charged} of {limit}");
    assert!(target.metric("requests_refused_total") > 0.0);
    let url = format!("http://{}", target.address);
    cli.with("PICOFARM_COORDINATOR", &url)
        .run(&["job", "list"])
        .ok();
}

#[test]
#[ignore = "a measurement: minutes"]
fn worst_resident_size_by_memory() {
    for mib in [256, 512, 2048] {
        let scratch = Scratch::new("attack");
        let cli = Cli::new(scratch.path());
        let target = Target::start(&cli, mib);
        history(&scratch, &target, 1_000);
        let worst = attack(&target, 24);
        println!("{mib} MiB: worst resident size in MiB after each attack: {worst:?}");
        assert!(target.resident().1 < mib);
    }
}
