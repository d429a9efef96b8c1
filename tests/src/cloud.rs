//! A stand-in for Google's and Azure's object stores on a loopback port: puts (also create-only), gets and deletes of whole
//! objects, as far as the probe of a store goes. It checks no signature, only who asks.

use std::{
    collections::HashMap,
    fmt::Write as _,
    io::{BufRead, BufReader, Write},
    net::{TcpListener, TcpStream},
    sync::{Arc, Mutex},
};

type Objects = Arc<Mutex<HashMap<String, Vec<u8>>>>;

/// A running stand-in; it ends with the test's process.
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
    /// Starts one that lets those in whose `Authorization` begins with one of these.
    ///
    /// # Panics
    /// When loopback has no free port.
    pub fn start(known: &'static [&'static str]) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").expect("loopback has free ports");
        let address = listener.local_addr().expect("it is bound").to_string();
        let objects = Objects::default();
        let shared = objects.clone();
        std::thread::spawn(move || {
            for stream in listener.incoming().flatten() {
                let objects = shared.clone();
                std::thread::spawn(move || {
                    // A client that goes away ends its connection.
                    let _ = serve(stream, &objects, known);
                });
            }
        });
        Self { address, objects }
    }

    /// Its URL.
    pub fn url(&self) -> String {
        format!("http://{}", self.address)
    }

    /// Objects that it holds.
    ///
    /// # Panics
    /// When a connection's thread did.
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

    /// Status, further headers and body.
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
        let mut objects = objects.lock().expect("no thread panics");
        match &*self.method {
            "POST" if query.contains("comp=batch") => {
                // Azure's: deletes in a multipart body, answered in one.
                let text = String::from_utf8_lossy(&self.body);
                let mut answer = String::new();
                for (i, line) in text
                    .lines()
                    .filter(|l| l.starts_with("DELETE "))
                    .enumerate()
                {
                    let key = line.split(' ').nth(1).unwrap_or_default();
                    objects.remove(key);
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
            "GET" | "HEAD" => match objects.get(key) {
                Some(body) => (200, String::new(), body.clone()),
                None => error(404, "NoSuchKey"),
            },
            "DELETE" => match objects.remove(key) {
                Some(_) => (204, String::new(), Vec::new()),
                None => error(404, "NoSuchKey"),
            },
            _ => error(400, "NotHere"),
        }
    }
}
