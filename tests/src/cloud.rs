//! A stand-in for Google's and Azure's object stores on a loopback port. It supports the requests
//! that data sets need: puts (also create-only), gets of objects and ranges, deletes, and paged
//! lists. It checks the caller's name but no signature.

use std::{
    collections::{BTreeMap, BTreeSet, HashMap},
    fmt::Write as _,
    io::{BufRead, BufReader, Write},
    net::{TcpListener, TcpStream},
    sync::{Arc, Mutex},
};

/// Objects by bucket and key, as in `/bucket/key`.
type Objects = Arc<Mutex<BTreeMap<String, Vec<u8>>>>;

/// Maximum number of objects and folders in an answer to a list. The real services return 1,000 or
/// 5,000.
const PAGE: usize = 100;

/// A running stand-in. It ends with the test's process.
pub struct Cloud {
    address: String,
    objects: Objects,
}

struct Request {
    method: String,
    target: String,
    headers: HashMap<String, String>,
    body: Vec<u8>,
}

impl Cloud {
    /// Starts a stand-in that accepts requests with an `Authorization` header that begins with one
    /// of these.
    ///
    /// # Panics
    /// If loopback has no free port.
    pub fn start(known: &'static [&'static str]) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").expect("loopback has free ports");
        let address = listener.local_addr().expect("it is bound").to_string();
        let objects = Objects::default();
        let shared = objects.clone();
        std::thread::spawn(move || {
            for stream in listener.incoming().flatten() {
                let objects = shared.clone();
                std::thread::spawn(move || {
                    // A client that disconnects ends its connection.
                    let _ = serve(stream, &objects, known);
                });
            }
        });
        Self { address, objects }
    }

    /// Returns its URL.
    pub fn url(&self) -> String {
        format!("http://{}", self.address)
    }

    /// Returns the number of its objects.
    ///
    /// # Panics
    /// If the thread of a connection panicked.
    pub fn count(&self) -> usize {
        self.objects.lock().expect("no thread panics").len()
    }
}

fn serve(stream: TcpStream, objects: &Objects, known: &[&str]) -> std::io::Result<()> {
    let mut writer = stream.try_clone()?;
    let mut reader = BufReader::new(stream);
    while let Some(request) = Request::read(&mut reader)? {
        let (status, headers, body) = request.answer(objects, known);
        write!(
            writer,
            "HTTP/1.1 {status} \r\nContent-Length: {}\r\nLast-Modified: Thu, 01 Jan 2026 00:00:00 GMT\r\nETag: \"e\"\r\n\
             x-goog-generation: 1\r\n{headers}\r\n",
            body.len()
        )?;
        if request.method != "HEAD" {
            writer.write_all(&body)?;
        }
        writer.flush()?;
    }
    Ok(())
}

impl Request {
    fn read(reader: &mut impl BufRead) -> std::io::Result<Option<Self>> {
        let mut line = String::new();
        if reader.read_line(&mut line)? == 0 {
            return Ok(None);
        }
        let mut words = line.split(' ').map(str::to_owned);
        let (method, target) = (words.next(), words.next());
        let mut headers = HashMap::new();
        loop {
            let mut line = String::new();
            reader.read_line(&mut line)?;
            let Some((name, value)) = line.trim_end().split_once(": ") else {
                break;
            };
            headers.insert(name.to_ascii_lowercase(), value.to_owned());
        }
        let length = headers.get("content-length").and_then(|n| n.parse().ok());
        let mut body = vec![0; length.unwrap_or(0)];
        reader.read_exact(&mut body)?;
        Ok(Some(Self {
            method: method.unwrap_or_default(),
            target: target.unwrap_or_default(),
            headers,
            body,
        }))
    }

    /// Returns status, additional headers and body.
    fn answer(&self, objects: &Objects, known: &[&str]) -> (u16, String, Vec<u8>) {
        let header = |name: &str| self.headers.get(name).map(String::as_str);
        let error = |status, code: &str| {
            let body = format!("<Error><Code>{code}</Code><Message>no</Message></Error>");
            (status, String::new(), body.into_bytes())
        };
        let who = header("authorization").unwrap_or_default();
        if !known.iter().any(|start| who.starts_with(start)) {
            return error(403, "AccessDenied");
        }
        let (key, query) = self.target.split_once('?').unwrap_or((&self.target, ""));
        let key = &decoded(key);
        let mut objects = objects.lock().expect("no thread panics");
        match &*self.method {
            "POST" if query.contains("comp=batch") => {
                // Azure batches deletes in a multipart body, with a single answer.
                let text = String::from_utf8_lossy(&self.body);
                let mut answer = String::new();
                for (i, line) in text
                    .lines()
                    .filter(|l| l.starts_with("DELETE "))
                    .enumerate()
                {
                    let key = line.split(' ').nth(1).unwrap_or_default();
                    objects.remove(&decoded(key));
                    write!(
                        answer,
                        "--x\r\nContent-Type: application/http\r\nContent-ID: {i}\r\n\r\nHTTP/1.1 202 Accepted\r\n\
                         x-ms-request-id: {i}\r\n\r\n\r\n"
                    )
                    .expect("a string takes everything");
                }
                let kind = "Content-Type: multipart/mixed; boundary=x\r\n".into();
                (202, kind, (answer + "--x--\r\n").into_bytes())
            }
            "PUT" => {
                let create = header("x-goog-if-generation-match") == Some("0")
                    || header("if-none-match") == Some("*");
                if create && objects.contains_key(key) {
                    return error(412, "ConditionNotMet");
                }
                objects.insert(key.to_owned(), self.body.clone());
                (201, String::new(), Vec::new())
            }
            "GET" if query.contains("list-type=2") || query.contains("comp=list") => {
                let azure = query.contains("comp=list");
                let body = List::new(query).page(key.trim_end_matches('/'), &objects, azure);
                (200, String::new(), body.into_bytes())
            }
            "GET" | "HEAD" => match (objects.get(key), header("range").or(header("x-ms-range"))) {
                (None, _) => error(404, "NoSuchKey"),
                (Some(body), None) => (200, String::new(), body.clone()),
                (Some(body), Some(range)) => match part(range, body.len()) {
                    None => error(416, "InvalidRange"),
                    Some(part) => {
                        let (first, last, of) = (part.start, part.end - 1, body.len());
                        let headers = format!("Content-Range: bytes {first}-{last}/{of}\r\n");
                        (206, headers, body[part].to_vec())
                    }
                },
            },
            "DELETE" => match objects.remove(key) {
                Some(_) => (204, String::new(), Vec::new()),
                None => error(404, "NoSuchKey"),
            },
            _ => error(400, "NotHere"),
        }
    }
}

/// Returns the bytes selected by `bytes=a-b`, `bytes=a-` or `bytes=-n`; `None` if there are none.
fn part(range: &str, length: usize) -> Option<std::ops::Range<usize>> {
    let (from, to) = range.strip_prefix("bytes=")?.split_once('-')?;
    let (start, end) = match (from.parse::<usize>(), to.parse::<usize>()) {
        (Ok(from), Ok(to)) => (from, length.min(to + 1)),
        (Ok(from), Err(_)) => (from, length),
        (Err(_), Ok(last)) => (length.saturating_sub(last), length),
        _ => return None,
    };
    (start < end).then_some(start..end)
}

/// Parameters of a list request.
struct List {
    prefix: String,
    /// Whether keys are cut at the first slash after the prefix.
    folders: bool,
    /// The last key of the previous page.
    after: String,
}

impl List {
    fn new(query: &str) -> Self {
        let values: HashMap<&str, String> = query
            .split('&')
            .filter_map(|pair| pair.split_once('='))
            .map(|(name, value)| (name, decoded(&value.replace('+', " "))))
            .collect();
        let value = |name: &str| values.get(name).cloned().unwrap_or_default();
        Self {
            prefix: value("prefix"),
            folders: !value("delimiter").is_empty(),
            after: value("continuation-token") + &value("marker"),
        }
    }

    fn page(&self, bucket: &str, objects: &BTreeMap<String, Vec<u8>>, azure: bool) -> String {
        let mut names = BTreeSet::new();
        for key in objects.keys() {
            let Some(key) = key.strip_prefix(&format!("{bucket}/")) else {
                continue;
            };
            let Some(rest) = key.strip_prefix(&*self.prefix) else {
                continue;
            };
            match rest.find('/').filter(|_| self.folders) {
                Some(slash) => names.insert(format!("{}{}", self.prefix, &rest[..=slash])),
                None => names.insert(key.to_owned()),
            };
        }
        let mut rest = names.into_iter().filter(|name| *name > self.after);
        let page: Vec<String> = rest.by_ref().take(PAGE).collect();
        let more = rest.next().is_some();
        let (mut files, mut folders) = (String::new(), String::new());
        for name in &page {
            let shown = escaped(name);
            if name.ends_with('/') {
                let tag = if azure {
                    "BlobPrefix"
                } else {
                    "CommonPrefixes"
                };
                let inner = if azure { "Name" } else { "Prefix" };
                folders += &format!("<{tag}><{inner}>{shown}</{inner}></{tag}>");
                continue;
            }
            let size = objects[&format!("{bucket}/{name}")].len();
            files += &match azure {
                true => format!(
                    "<Blob><Name>{shown}</Name><Properties><Last-Modified>Thu, 01 Jan 2026 00:00:00 GMT</Last-Modified>\
                     <Etag>e</Etag><Content-Length>{size}</Content-Length><Content-Type>x</Content-Type></Properties></Blob>"
                ),
                false => format!(
                    "<Contents><Key>{shown}</Key><Size>{size}</Size><LastModified>2026-01-01T00:00:00.000Z</LastModified>\
                     <ETag>e</ETag></Contents>"
                ),
            };
        }
        let last = page.last().filter(|_| more).map(|name| escaped(name));
        match azure {
            true => format!(
                "<EnumerationResults><Blobs>{files}{folders}</Blobs><NextMarker>{}</NextMarker></EnumerationResults>",
                last.unwrap_or_default()
            ),
            false => {
                let token =
                    last.map(|l| format!("<NextContinuationToken>{l}</NextContinuationToken>"));
                let token = token.unwrap_or_default();
                format!("<ListBucketResult>{files}{folders}{token}</ListBucketResult>")
            }
        }
    }
}

fn escaped(text: &str) -> String {
    text.replace('&', "&amp;")
        .replace('<', "&lt;")
        .replace('>', "&gt;")
}

/// Decodes the text of a URL: `%20` becomes a space.
fn decoded(text: &str) -> String {
    let mut bytes = Vec::with_capacity(text.len());
    let mut rest = text.as_bytes();
    while let Some((first, after)) = rest.split_first() {
        let code = after.get(..2).and_then(|hex| std::str::from_utf8(hex).ok());
        let code = code.and_then(|hex| u8::from_str_radix(hex, 16).ok());
        match code.filter(|_| *first == b'%') {
            Some(code) => {
                bytes.push(code);
                rest = &after[2..];
            }
            None => {
                bytes.push(*first);
                rest = after;
            }
        }
    }
    String::from_utf8_lossy(&bytes).into_owned()
}
