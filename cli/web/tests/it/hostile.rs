//! What attackers try: each test is an attack that must not succeed.

use std::{
    io::{ErrorKind, Read, Write},
    net::{TcpListener, TcpStream},
};

use crate::{
    client::Web,
    farm::{EVIL, JOB},
};

fn encoded(text: &str) -> String {
    url::form_urlencoded::byte_serialize(text.as_bytes()).collect()
}

#[test]
fn markup_in_addresses_is_no_markup_in_answers() {
    let folder = tempfile::tempdir().unwrap();
    let web = Web::start(vec![folder.path().display().to_string()]);
    let evil = encoded(EVIL);
    for path in [
        format!("/{evil}"),
        format!("/jobs?find={evil}&user={evil}&state=done"),
        format!("/jobs?state={evil}"),
        format!("/jobs/{evil}"),
        format!("/jobs/{JOB}?view={evil}"),
        format!("/events?only={evil}"),
        format!("/workers?find={evil}"),
        format!("/audit?before={evil}"),
        format!("/data?set={evil}"),
        format!("/data?set=0%2F{evil}&sort={evil}"),
        format!("/data/scene?set={evil}&scene={evil}"),
        format!("/flight?set={evil}&scene=0"),
        format!("/models?store={evil}"),
        format!("/models/model?store=0&name={evil}"),
        format!("/models/sweep?store=0&name={evil}&id={evil}"),
        format!("/bytes/{evil}?set={evil}&scene=0"),
        format!("/assets/{evil}"),
    ] {
        let html = web.get(&path).text();
        assert!(!html.contains(EVIL) && !html.contains("<img"), "{path}");
    }
}

#[test]
fn a_log_line_is_text_in_pages_and_one_event_of_a_followed_page() {
    let web = Web::start(Vec::new());
    let html = web.get(&format!("/jobs/{JOB}?view=log")).text();
    assert!(html.contains("&lt;script&gt;") && !html.contains(EVIL));
    let to = encoded(&format!("/jobs/{JOB}?view=log"));
    let mut stream = web.connect();
    let cookie = [("Cookie", web.cookie())];
    let request = web.request("GET", &format!("/live?to={to}"), &cookie, "");
    stream.write_all(request.as_bytes()).unwrap();
    let (mut seen, mut part) = (String::new(), [0; 4096]);
    while !seen.contains("\n\n\r\n") && !seen.contains("</table>") {
        let n = stream.read(&mut part).unwrap();
        assert!(n > 0, "{seen}");
        seen += &String::from_utf8_lossy(&part[..n]);
    }
    let own = seen.lines().filter(|line| line.starts_with("event: "));
    assert_eq!(own.count(), 1, "{seen}");
    assert!(!seen.contains(EVIL));
}

#[test]
fn paths_that_climb_reach_no_file() {
    let folder = tempfile::tempdir().unwrap();
    let store = folder.path().join("store");
    std::fs::create_dir(&store).unwrap();
    std::fs::write(folder.path().join("secret"), "a secret text").unwrap();
    let web = Web::start(vec![store.display().to_string()]);
    for path in [
        "/assets/../../secret",
        "/assets/%2e%2e/secret",
        "/assets//etc/passwd",
        "/../secret",
        "/%2e%2e/secret",
        "/data?set=0%2F..%2Fsecret",
        "/bytes/card?set=0%2F..&scene=0",
        "/models/model?store=0&name=..%2Fsecret",
        "/models/model?store=0&name=..",
        "/models/model?store=..&name=a",
        "/models/report?store=0&name=..%2F..%2Fsecret",
        "/models/sweep?store=0&name=a&id=..%2F..%2Fsecret",
    ] {
        let reply = web.get(path);
        assert!(
            (400..500).contains(&reply.status),
            "{path}: {}",
            reply.status
        );
        assert!(!reply.text().contains("a secret text"), "{path}");
    }
}

#[test]
fn no_url_of_a_job_or_of_an_address_is_asked_for_anything() {
    let elsewhere = TcpListener::bind("127.0.0.1:0").unwrap();
    elsewhere.set_nonblocking(true).unwrap();
    let url = format!(
        "http://{}/latest/meta-data",
        elsewhere.local_addr().unwrap()
    );
    let folder = tempfile::tempdir().unwrap();
    let web = Web::start(vec![folder.path().display().to_string()]);
    *web.farm.store.lock().unwrap() = Some(url.clone());
    let page = web.get(&format!("/jobs/{JOB}"));
    assert_eq!(page.status, 200);
    assert!(
        !page.text().contains("/data?set="),
        "the store is not shown"
    );
    let there = encoded(&url);
    for path in [
        format!("/data?set={there}"),
        format!("/data/scene?set={there}&scene=0"),
        format!("/bytes/card?set={there}&scene=0"),
        format!("/bytes/card?set=0%2F{there}&scene=0"),
        format!("/flight?set={there}&scene=0"),
        format!("/models?store={there}"),
        format!("/models/model?store={there}&name=a"),
        format!("/live?to={there}"),
    ] {
        let mut stream = web.connect();
        let cookie = [("Cookie", web.cookie())];
        stream
            .write_all(web.request("GET", &path, &cookie, "").as_bytes())
            .unwrap();
        let mut head = [0; 12];
        stream.read_exact(&mut head).unwrap();
    }
    let asked = elsewhere.accept();
    assert_eq!(asked.unwrap_err().kind(), ErrorKind::WouldBlock);
}

#[test]
fn the_key_is_in_no_page_and_scripts_cannot_read_the_cookie() {
    let web = Web::start(Vec::new());
    let (_, key) = web.link.split_once("key=").unwrap();
    for path in ["/", "/jobs", &format!("/jobs/{JOB}"), "/data", "/none"] {
        assert!(!web.get(path).text().contains(key), "{path}");
    }
    let admitted = web.raw(&web.request("GET", &format!("/?key={key}"), &[], ""));
    let cookie = admitted.header("set-cookie").unwrap();
    for flag in ["httponly", "samesite=lax", "path=/"] {
        assert!(cookie.contains(flag), "{cookie}");
    }
    assert_eq!(admitted.header("referrer-policy"), Some("same-origin"));
}

#[test]
fn the_form_takes_the_key_and_only_from_a_page_of_this_server() {
    let web = Web::start(Vec::new());
    let (_, key) = web.link.split_once("key=").unwrap();
    let form = format!("key={key}");
    let send =
        |lines: &[(&str, &str)], form: &str| web.raw(&web.request("POST", "/key", lines, form));
    assert!(
        web.raw(&web.request("GET", "/", &[], ""))
            .text()
            .contains("action=\"/key\"")
    );
    let wrong = send(&[], "key=guess");
    assert_eq!((wrong.status, wrong.header("set-cookie")), (401, None));
    assert!(wrong.text().contains("This is not the key"));
    let foreign = send(&[("Origin", "http://evil.example")], &form);
    assert_eq!((foreign.status, foreign.header("set-cookie")), (403, None));
    let right = send(&[], &form);
    assert_eq!((right.status, right.header("location")), (303, Some("/")));
    let cookie = right.header("set-cookie").unwrap();
    assert_eq!(
        cookie.split(';').next(),
        Some(&*web.cookie().to_lowercase())
    );
}

#[test]
fn a_form_without_the_key_is_refused_before_it_arrives() {
    let web = Web::start(Vec::new());
    let mut stream = web.connect();
    let head = format!(
        "POST /jobs/{JOB}/cancel HTTP/1.1\r\nHost: {}\r\nContent-Length: 4000000000\r\n\r\n",
        web.address
    );
    stream.write_all(head.as_bytes()).unwrap();
    let mut answer = [0; 12];
    stream.read_exact(&mut answer).unwrap();
    assert_eq!(&answer, b"HTTP/1.1 401");
    assert!(web.farm.acts().is_empty());
}

#[test]
fn a_form_that_never_ends_is_refused_at_its_limit() {
    let web = Web::start(Vec::new());
    let mut stream = web.connect();
    let head = format!(
        "POST /key HTTP/1.1\r\nHost: {}\r\nTransfer-Encoding: chunked\r\n\r\n",
        web.address
    );
    stream.write_all(head.as_bytes()).unwrap();
    let chunk = format!("400\r\n{}\r\n", "x".repeat(0x400));
    for _ in 0..5 {
        stream.write_all(chunk.as_bytes()).unwrap();
    }
    let mut answer = [0; 12];
    stream.read_exact(&mut answer).unwrap();
    assert_eq!(&answer, b"HTTP/1.1 413");
}

/// Opens connections that begin a request and never end it.
fn slow(web: &Web, count: usize, begin: &str) -> Vec<TcpStream> {
    let connect = |_| {
        let mut stream = web.connect();
        // The server may have closed it to make place for a later one.
        let _ = stream.write_all(begin.as_bytes());
        stream
    };
    (0..count).map(connect).collect()
}

#[test]
fn three_hundred_slow_connections_keep_nobody_out() {
    let web = Web::start(Vec::new());
    let host = web.address;
    let mut held = Vec::new();
    for begin in [
        String::new(),
        format!("GET / HTTP/1.1\r\nHost: {host}\r\nX: "),
        format!("POST /key HTTP/1.1\r\nHost: {host}\r\nContent-Length: 99\r\n\r\nkey="),
    ] {
        held.extend(slow(&web, 300, &begin));
        assert_eq!(web.get("/jobs").status, 200);
        // Neither are those without the key kept from the page that asks for it.
        let locked = web.raw(&web.request("GET", "/", &[], ""));
        assert_eq!(locked.status, 401);
    }
    // A connection with the key stays open while strangers come.
    let mut known = web.connect();
    let cookie = [("Cookie", web.cookie())];
    let request = web.request("GET", "/live?to=%2Fjobs", &cookie, "");
    known.write_all(request.as_bytes()).unwrap();
    let mut seen = [0; 15];
    known.read_exact(&mut seen).unwrap();
    assert_eq!(&seen, b"HTTP/1.1 200 OK");
    held.extend(slow(&web, 300, ""));
    web.farm.acts.lock().unwrap().push("pause".into());
    let mut text = String::new();
    let mut part = [0; 4096];
    while !text.contains("paused") {
        let n = known.read(&mut part).unwrap();
        assert!(n > 0, "the connection was closed: {text}");
        text += &String::from_utf8_lossy(&part[..n]);
    }
}
