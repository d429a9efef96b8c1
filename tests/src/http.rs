//! A plain HTTP/1.1 GET, for what the coordinator serves to probes and Prometheus.

use std::{
    io::{Read, Write},
    net::TcpStream,
    time::Duration,
};

/// Status code and body of `url` (`http://ADDRESS/PATH`); `None` where nobody answers.
///
/// # Panics
/// When the answer is no HTTP.
pub fn get(url: &str) -> Option<(u16, String)> {
    let rest = url.strip_prefix("http://").expect("a plain URL");
    let (address, path) = rest.split_once('/').expect("a URL with a path");
    let mut stream = TcpStream::connect(address).ok()?;
    stream
        .set_read_timeout(Some(Duration::from_secs(30)))
        .expect("a timeout can be set");
    write!(stream, "GET /{path} HTTP/1.1\r\nHost: {address}\r\n\r\n").ok()?;
    let mut answer = String::new();
    stream.read_to_string(&mut answer).ok()?;
    let (head, body) = answer.split_once("\r\n\r\n").expect("an answer has a head");
    let code = head.split(' ').nth(1).expect("an answer has a status");
    Some((code.parse().expect("a status is a number"), body.to_owned()))
}

/// The value of a sample on a page of metrics, its labels as they are written there.
pub fn sample(page: &str, name: &str) -> Option<f64> {
    let line = page
        .lines()
        .find_map(|line| line.strip_prefix(name)?.strip_prefix(' '))?;
    line.parse().ok()
}
