//! A plain HTTP/1.1 GET, for the coordinator's probe and Prometheus endpoints.

use std::{
    io::{Read, Write},
    net::TcpStream,
    time::Duration,
};

/// Returns status code and body of `url` (`http://ADDRESS/PATH`); `None` if nobody answers.
///
/// # Panics
/// If the answer is not HTTP.
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

/// Returns the value of a sample on a page of metrics. `name` includes its labels as printed there.
pub fn sample(page: &str, name: &str) -> Option<f64> {
    let line = page
        .lines()
        .find_map(|line| line.strip_prefix(name)?.strip_prefix(' '))?;
    line.parse().ok()
}
