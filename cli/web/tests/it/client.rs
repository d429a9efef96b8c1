//! A server in this process, and requests to it as written.

use std::{
    io::{Read, Write},
    net::{SocketAddr, TcpStream},
    sync::Arc,
    time::Duration,
};

use picofarm_web::{Server, Settings};
use tokio_util::sync::CancellationToken;

use crate::farm::Memory;

/// A running server.
pub struct Web {
    pub farm: Arc<Memory>,
    pub address: SocketAddr,
    /// The link that the program prints.
    pub link: String,
    cookie: String,
    stop: CancellationToken,
    _runtime: tokio::runtime::Runtime,
}

/// An answer.
#[derive(Debug)]
pub struct Reply {
    pub status: u16,
    /// In lower case.
    pub head: String,
    /// Expanded.
    pub body: Vec<u8>,
    /// Bytes of the body on the wire.
    pub sent: usize,
}

impl Reply {
    pub fn text(&self) -> String {
        String::from_utf8(self.body.clone()).unwrap()
    }

    pub fn json(&self) -> serde_json::Value {
        assert_eq!(self.status, 200, "{}", self.text());
        serde_json::from_slice(&self.body).unwrap()
    }

    pub fn header(&self, name: &str) -> Option<&str> {
        let mut lines = self.head.lines();
        lines.find_map(|line| line.strip_prefix(name)?.strip_prefix(": "))
    }
}

impl Web {
    pub fn start(stores: Vec<String>) -> Self {
        Self::start_with(stores, true)
    }

    /// Starts a server, next to a coordinator that answers or not.
    pub fn start_with(stores: Vec<String>, answers: bool) -> Self {
        let runtime = tokio::runtime::Builder::new_multi_thread()
            .worker_threads(2)
            .enable_all()
            .build()
            .unwrap();
        let farm = Arc::new(Memory::default());
        *farm.away.lock().unwrap() = !answers;
        let settings = Settings {
            listen: "127.0.0.1:0".parse().unwrap(),
            hosts: Vec::new(),
            tls: None,
            allow_insecure: false,
            stores,
            farm: answers,
        };
        let bound = runtime.block_on(Server::bind(settings, farm.clone()));
        let server = bound.expect("a loopback port is free");
        let (address, link) = (server.address(), server.link("/"));
        let stop = CancellationToken::new();
        runtime.spawn(server.serve(stop.clone()));
        let mut web = Self {
            farm,
            address,
            link,
            cookie: String::new(),
            stop,
            _runtime: runtime,
        };
        let path = web
            .link
            .split_once(&address.to_string())
            .unwrap()
            .1
            .to_owned();
        let admitted = web.raw(&web.request("GET", &path, &[], ""));
        assert_eq!(admitted.status, 303, "{admitted:?}");
        assert_eq!(admitted.header("location"), Some("/"));
        let cookie = admitted.header("set-cookie").expect("a cookie");
        assert!(
            cookie.contains("httponly") && cookie.contains("samesite=lax"),
            "{cookie}"
        );
        web.cookie = cookie.split(';').next().unwrap().to_owned();
        web
    }

    /// A request with the usual Host.
    pub fn request(&self, method: &str, path: &str, lines: &[(&str, &str)], body: &str) -> String {
        let mut text = format!("{method} {path} HTTP/1.1\r\nHost: {}\r\n", self.address);
        for (name, value) in lines {
            text += &format!("{name}: {value}\r\n");
        }
        text + &format!(
            "Accept-Encoding: br, gzip\r\nConnection: close\r\nContent-Length: {}\r\n\r\n{body}",
            body.len()
        )
    }

    /// Sends bytes, and returns the whole answer.
    pub fn raw(&self, text: &str) -> Reply {
        let mut stream = self.connect();
        // The server may answer and close before it has read all.
        let _ = stream.write_all(text.as_bytes());
        let mut bytes = Vec::new();
        let _ = stream.read_to_end(&mut bytes);
        let end = bytes.windows(4).position(|w| w == b"\r\n\r\n");
        let end = end.unwrap_or_else(|| panic!("no answer to {text}: {bytes:?}"));
        let head = String::from_utf8(bytes[..end].to_vec()).unwrap();
        let status = head.split(' ').nth(1).unwrap().parse().unwrap();
        let sent = bytes[end + 4..].to_vec();
        let head = head.to_lowercase();
        let mut body = Vec::new();
        match head.contains("content-encoding: gzip") {
            true => {
                let mut reader = flate2::read::GzDecoder::new(&*sent);
                reader.read_to_end(&mut body).unwrap();
            }
            false => body = sent.clone(),
        }
        Reply {
            status,
            head,
            body,
            sent: sent.len(),
        }
    }

    pub fn connect(&self) -> TcpStream {
        let stream = TcpStream::connect(self.address).unwrap();
        let patience = Some(Duration::from_secs(60));
        stream.set_read_timeout(patience).unwrap();
        stream
    }

    /// Asks with the cookie.
    pub fn get(&self, path: &str) -> Reply {
        self.raw(&self.request("GET", path, &[("Cookie", &self.cookie)], ""))
    }

    pub fn post(&self, path: &str, lines: &[(&str, &str)], body: &str) -> Reply {
        let cookie = [("Cookie", &*self.cookie)];
        let lines = [&cookie, lines].concat();
        self.raw(&self.request("POST", path, &lines, body))
    }

    pub fn cookie(&self) -> &str {
        &self.cookie
    }
}

impl Drop for Web {
    fn drop(&mut self) {
        self.stop.cancel();
    }
}
