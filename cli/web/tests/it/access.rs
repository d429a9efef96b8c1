//! Who gets an answer, and what its headers allow.

use std::{
    io::{Read, Write},
    sync::Arc,
};

use picofarm_web::{Server, Settings, StartError};

use crate::{
    actions::form,
    client::Web,
    farm::{EVIL, JOB, Memory},
};

fn pages() -> Vec<String> {
    let job = [
        format!("/jobs/{JOB}"),
        format!("/jobs/{JOB}?view=log"),
        format!("/jobs/{JOB}?view=file"),
        format!("/jobs/{JOB}/tasks/0/3"),
    ];
    let others = [
        "/", "/jobs", "/workers", "/events", "/audit", "/data", "/models", "/none",
    ];
    job.into_iter().chain(others.map(String::from)).collect()
}

#[test]
fn without_the_key_nothing_is_shown() {
    let web = Web::start(Vec::new());
    for path in pages() {
        for lines in [&[][..], &[("Cookie", "picofarm-00000000=guess")]] {
            let reply = web.raw(&web.request("GET", &path, lines, ""));
            assert_eq!(reply.status, 401, "{path}");
            assert!(!reply.text().contains(JOB), "{path}");
        }
    }
    let wrong = web.raw(&web.request("GET", "/?key=0123", &[], ""));
    assert_eq!((wrong.status, wrong.header("set-cookie")), (401, None));
    let posted = web.raw(&web.request("POST", &format!("/jobs/{JOB}/cancel"), &[], "form="));
    assert_eq!(posted.status, 401);
    assert!(web.farm.acts().is_empty());
}

#[test]
fn a_site_whose_name_resolves_to_this_machine_gets_no_answer() {
    let web = Web::start(Vec::new());
    for host in [
        "evil.example",
        "evil.example:7421",
        "127.0.0.1.evil.example",
    ] {
        let cookie = web.cookie();
        let reply = web.raw(&format!(
            "GET / HTTP/1.1\r\nHost: {host}\r\nCookie: {cookie}\r\nConnection: close\r\n\r\n"
        ));
        assert_eq!(reply.status, 421, "{host}");
        assert!(!reply.text().contains(JOB));
    }
}

#[test]
fn an_address_that_others_reach_needs_a_name_and_a_certificate() {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .unwrap();
    let bind = |hosts: &[&str], insecure| {
        let hosts = hosts.iter().map(|host| (*host).to_owned()).collect();
        let settings = Settings {
            listen: "0.0.0.0:0".parse().unwrap(),
            hosts,
            tls: None,
            allow_insecure: insecure,
            stores: Vec::new(),
            farm: true,
        };
        runtime.block_on(Server::bind(settings, Arc::new(Memory::default())))
    };
    assert!(matches!(bind(&[], true), Err(StartError::Open(_))));
    let clear = bind(&["farm.example"], false);
    assert!(matches!(clear, Err(StartError::Clear(_))));
    let named = bind(&["farm.example"], true).unwrap();
    assert!(named.link("/data?x=1").starts_with("http://farm.example:"));
    assert!(named.link("/data?x=1").contains("/data?x=1&key="));
}

#[test]
fn texts_of_others_are_shown_and_are_no_markup_on_any_page() {
    let web = Web::start(Vec::new());
    let mut shown = 0;
    for path in pages() {
        let reply = web.get(&path);
        let html = reply.text();
        shown += usize::from(html.contains("&lt;script&gt;alert(1)&lt;/script&gt;"));
        assert!(
            !html.contains(EVIL) && !html.contains("<img onerror"),
            "{path}"
        );
        // The policy forbids scripts and styles in the page, so there must be none of ours either.
        for (i, _) in html.match_indices("<script") {
            assert!(
                html[i..].starts_with("<script type=\"module\" src=\"/assets/"),
                "{path}"
            );
        }
        for inline in ["<style", " style=\"", " onclick=", "javascript:"] {
            assert!(!html.contains(inline), "{path}: {inline}");
        }
        let policy = reply.header("content-security-policy").expect("a policy");
        for part in [
            "default-src 'none'",
            "script-src 'self'",
            "frame-ancestors 'none'",
        ] {
            assert!(policy.contains(part), "{policy}");
        }
        assert!(!policy.contains("unsafe"), "{policy}");
        assert_eq!(reply.header("x-content-type-options"), Some("nosniff"));
        assert_eq!(reply.header("cache-control"), Some("no-store"));
    }
    assert!(shown >= 8, "the texts are on {shown} pages");
}

#[test]
fn a_refusal_of_the_coordinator_is_a_page_with_its_reason() {
    let web = Web::start(Vec::new());
    let reply = web.get("/audit");
    assert_eq!(reply.status, 403);
    assert!(reply.text().contains("role=\"alert\""));
    let missing = web.get("/jobs/no-such-job");
    assert_eq!(missing.status, 404);
    assert!(
        missing.text().contains("there is no job"),
        "{}",
        missing.text()
    );
    let wrong = web.get("/jobs?state=sleeping");
    assert_eq!(wrong.status, 400);
    assert!(wrong.text().contains("state: expected"), "{}", wrong.text());
}

#[test]
fn unknown_jobs_and_tasks_are_not_found_and_actions_on_ended_jobs_conflict() {
    let web = Web::start(Vec::new());
    let other = JOB.replace("0001", "0002");
    for path in [
        format!("/jobs/{other}"),
        format!("/jobs/{other}/tasks/0/0"),
        format!("/jobs/{JOB}/tasks/0/99"),
        format!("/jobs/{JOB}/tasks/7/0"),
        format!("/jobs/{JOB}/tasks/0/x"),
    ] {
        let reply = web.get(&path);
        assert_eq!(reply.status, 404, "{path}");
        assert!(reply.text().contains("<h1>Not found</h1>"), "{path}");
    }
    let form = form(&web);
    *web.farm.ended.lock().unwrap() = true;
    let reply = web.post(&format!("/jobs/{JOB}/pause"), &[], &form);
    assert_eq!(reply.status, 409);
    assert!(reply.text().contains("the job has ended"));
    assert!(!reply.text().contains("Bad Gateway"));
}

#[test]
fn pages_wait_for_a_coordinator_that_is_away_and_actions_do_not() {
    let web = Web::start(Vec::new());
    let form = form(&web);
    *web.farm.away.lock().unwrap() = true;
    for path in ["/jobs", "/workers", &format!("/jobs/{JOB}")] {
        let reply = web.get(path);
        assert_eq!(reply.status, 502, "{path}");
        let html = reply.text();
        assert!(
            html.contains("<h1>The coordinator does not answer</h1>"),
            "{html}"
        );
        assert!(html.contains("no coordinator answers"), "{html}");
        assert!(html.contains("/assets/live.js"), "{path}: {html}");
    }
    let missing = web.get("/none").text();
    assert!(!missing.contains("/assets/live.js"), "{missing}");
    let posted = web.post(&format!("/jobs/{JOB}/cancel"), &[], &form);
    assert_eq!(posted.status, 502);
    assert!(!posted.text().contains("/assets/live.js"));
}

#[test]
fn pages_of_data_sets_lead_to_a_farm_only_if_one_answered_at_the_start() {
    for answers in [true, false] {
        let web = Web::start_with(Vec::new(), answers);
        let html = web.get("/data").text();
        for path in ["/", "/jobs", "/workers", "/events", "/audit"] {
            let link = format!("href=\"{path}\"");
            assert_eq!(html.contains(&link), answers, "{path}: {html}");
        }
        assert!(html.contains("href=\"/data\" aria-current"), "{html}");
    }
}

#[test]
fn long_heads_and_long_forms_are_refused() {
    let web = Web::start(Vec::new());
    let long = "x".repeat(64 << 10);
    let head = web.raw(&web.request("GET", "/", &[("X-Long", &long)], ""));
    assert_eq!(head.status, 431);
    let form = web.post(&format!("/jobs/{JOB}/cancel"), &[], &long);
    assert_eq!(form.status, 413);
    assert!(web.farm.acts().is_empty());
}

#[test]
fn an_open_page_gets_its_content_again_when_it_changes() {
    let web = Web::start(Vec::new());
    let path = format!("/live?to=%2Fjobs%2F{JOB}");
    let mut stream = web.connect();
    let request = web.request("GET", &path, &[("Cookie", web.cookie())], "");
    stream.write_all(request.as_bytes()).unwrap();
    let (mut seen, mut from) = (String::new(), 0);
    let mut until = |words: &str| {
        let mut part = [0; 4096];
        while !seen[from..].contains(words) {
            let n = stream.read(&mut part).unwrap();
            assert!(n > 0, "the events ended: {seen}");
            seen += &String::from_utf8_lossy(&part[..n]);
        }
        from += seen[from..].find(words).unwrap() + words.len();
    };
    until("act-pause");
    web.farm.acts.lock().unwrap().push("pause".into());
    until("act-resume");
    // While the coordinator is away, no content is sent, which would replace the last.
    *web.farm.away.lock().unwrap() = true;
    until("event: away\ndata: no coordinator answers\n\n");
    *web.farm.away.lock().unwrap() = false;
    web.farm.acts.lock().unwrap().clear();
    until("act-pause");
    assert!(!seen.contains("id=\"problem\""), "{seen}");
    assert!(
        seen.to_lowercase()
            .contains("content-type: text/event-stream")
    );
}

#[test]
fn only_so_many_pages_are_followed_at_a_time() {
    let web = Web::start(Vec::new());
    let request = web.request("GET", "/live?to=%2F", &[("Cookie", web.cookie())], "");
    let mut followed = Vec::new();
    let refused = (0..250).any(|_| {
        let mut stream = web.connect();
        stream.write_all(request.as_bytes()).unwrap();
        let mut head = [0; 12];
        stream.read_exact(&mut head).unwrap();
        followed.push(stream);
        &head == b"HTTP/1.1 503"
    });
    let reason = web.get("/live?to=%2F");
    assert_eq!(reason.status, 503);
    assert!(reason.text().contains("160 pages are followed already"));
    assert!(refused && followed.len() > 100, "{}", followed.len());
    assert_eq!(web.get("/").status, 200, "other pages are still served");
}

#[test]
fn the_first_view_of_each_page_is_below_300_kilobytes() {
    let web = Web::start(Vec::new());
    let assets = [
        "style.css",
        "icon.svg",
        "live.js",
        "grid.js",
        "scene.js",
        "flight.js",
        "volume.js",
        "histogram.js",
    ];
    let assets = assets.map(|name| {
        let reply = web.get(&format!("/assets/{name}"));
        assert_eq!(reply.status, 200, "{name}");
        reply.sent
    });
    for path in pages() {
        let page = web.get(&path).sent;
        let all = page + assets.iter().sum::<usize>();
        assert!(all < 300_000, "{path}: {all}");
    }
}
