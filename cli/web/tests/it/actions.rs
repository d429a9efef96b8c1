//! What changes a job, and what does not.

use std::io::{Read, Write};

use crate::{client::Web, farm::JOB};

pub fn form(web: &Web) -> String {
    let html = web.get(&format!("/jobs/{JOB}")).text();
    let (_, rest) = html.split_once("name=\"form\" value=\"").expect("a form");
    format!("form={}", rest.split('"').next().unwrap())
}

#[test]
fn forms_of_the_page_change_jobs() {
    let web = Web::start(Vec::new());
    let form = form(&web);
    let origin = format!("http://{}", web.address);
    for act in ["pause", "resume", "retry", "cancel"] {
        let lines = [("Origin", &*origin), ("Sec-Fetch-Site", "same-origin")];
        let reply = web.post(&format!("/jobs/{JOB}/{act}"), &lines, &form);
        assert_eq!(reply.status, 303, "{}", reply.text());
        assert_eq!(reply.header("location"), Some(&*format!("/jobs/{JOB}")));
    }
    assert_eq!(web.farm.acts(), ["pause", "resume", "retry", "cancel"]);
}

#[test]
fn a_link_changes_nothing() {
    let web = Web::start(Vec::new());
    let form = form(&web);
    for act in ["pause", "resume", "retry", "cancel"] {
        let reply = web.get(&format!("/jobs/{JOB}/{act}?{form}"));
        assert_eq!(reply.status, 405, "{act}");
        assert_eq!(reply.header("allow"), Some("post"));
    }
    assert!(web.farm.acts().is_empty());
}

#[test]
fn forms_of_other_sites_change_nothing() {
    let web = Web::start(Vec::new());
    let form = form(&web);
    let cancel = format!("/jobs/{JOB}/cancel");
    let foreign: [(&[(&str, &str)], &str); 5] = [
        (&[("Origin", "http://evil.example")], &form),
        (&[("Origin", "null")], &form),
        (&[("Sec-Fetch-Site", "cross-site")], &form),
        (&[], "form=guess"),
        (&[], ""),
    ];
    for (lines, form) in foreign {
        let reply = web.post(&cancel, lines, form);
        assert_eq!(reply.status, 403, "{lines:?} {form}");
    }
    assert!(web.farm.acts().is_empty());
}

#[test]
fn the_coordinator_decides_what_the_user_may_do_and_the_page_has_no_other_buttons() {
    let web = Web::start(Vec::new());
    let form = form(&web);
    *web.farm.viewer.lock().unwrap() = true;
    let html = web.get(&format!("/jobs/{JOB}")).text();
    assert!(
        !html.contains("<button") && html.contains("no right to change"),
        "{html}"
    );
    let reply = web.post(&format!("/jobs/{JOB}/cancel"), &[], &form);
    assert_eq!(reply.status, 403);
    assert!(reply.text().contains("viewers may not change jobs"));
}

#[test]
fn stages_and_tasks_of_a_job_that_is_cancelled_or_paused_say_so() {
    let web = Web::start(Vec::new());
    // The state of the only stage, and the words of its cells.
    let states = || {
        let html = web.get(&format!("/jobs/{JOB}")).text();
        let (_, stages) = html.split_once("id=\"stages\"").expect(&html);
        let badge = stages.split("<span class=\"badge").nth(1).unwrap();
        let word = badge.split(['>', '<']).nth(1).unwrap().to_owned();
        let titles = html.split("<title>task ").skip(1);
        let cells = titles.map(|title| title.split([' ', '<']).nth(1).unwrap().to_owned());
        (word, cells.collect::<Vec<_>>())
    };
    let cells = |rest: &str| {
        ["done", rest, "running", "dead", rest]
            .map(str::to_owned)
            .to_vec()
    };
    assert_eq!(states(), ("running".to_owned(), cells("pending")));
    web.farm.acts.lock().unwrap().push("pause".into());
    assert_eq!(states(), ("running".to_owned(), cells("paused")));
    *web.farm.idle.lock().unwrap() = true;
    assert_eq!(states().0, "paused");
    *web.farm.ended.lock().unwrap() = true;
    let (stage, titles) = states();
    assert_eq!((&*stage, &*titles[1]), ("cancelled", "cancelled"));
}

#[test]
fn a_picture_of_tasks_is_one_stop_of_the_tab_key() {
    let web = Web::start(Vec::new());
    let html = web.get(&format!("/jobs/{JOB}")).text();
    let (_, picture) = html.split_once("<figure class=\"grid\">").expect(&html);
    let picture = picture.split("</figure>").next().unwrap();
    assert_eq!(picture.matches("tabindex=\"0\"").count(), 1, "{picture}");
    assert_eq!(picture.matches("tabindex=\"-1\"").count(), 4, "{picture}");
    assert!(html.contains("/assets/grid.js"));
}

#[test]
fn unknown_actions_and_other_methods_are_refused() {
    let web = Web::start(Vec::new());
    let form = form(&web);
    assert_eq!(
        web.post(&format!("/jobs/{JOB}/explode"), &[], &form).status,
        404
    );
    assert_eq!(web.post("/", &[], &form).status, 405);
    let cookie = [("Cookie", web.cookie())];
    let deleted = web.raw(&web.request("DELETE", &format!("/jobs/{JOB}"), &cookie, ""));
    assert_eq!(deleted.status, 405);
}

#[test]
fn after_an_action_no_viewer_gets_content_from_before() {
    let web = Web::start(Vec::new());
    let follow = || {
        let path = format!("/live?to=%2Fjobs%2F{JOB}");
        let mut stream = web.connect();
        let request = web.request("GET", &path, &[("Cookie", web.cookie())], "");
        stream.write_all(request.as_bytes()).unwrap();
        let (mut seen, mut part) = (String::new(), [0; 4096]);
        // An event ends with an empty line.
        while !seen.contains("\n\n") {
            let n = stream.read(&mut part).unwrap();
            assert!(n > 0, "the events ended: {seen}");
            seen += &String::from_utf8_lossy(&part[..n]);
        }
        (stream, seen)
    };
    let (_stream, first) = follow();
    assert!(first.contains("act-pause"), "{first}");
    let reply = web.post(&format!("/jobs/{JOB}/pause"), &[], &form(&web));
    assert_eq!(reply.status, 303);
    let (_stream, next) = follow();
    assert!(
        next.contains("act-resume") && !next.contains("act-pause"),
        "{next}"
    );
}
