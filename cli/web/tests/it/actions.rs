//! What changes a job, and what does not.

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
fn the_coordinator_decides_what_the_user_may_do() {
    let web = Web::start(Vec::new());
    *web.farm.viewer.lock().unwrap() = true;
    let reply = web.post(&format!("/jobs/{JOB}/cancel"), &[], &form(&web));
    assert_eq!(reply.status, 403);
    assert!(reply.text().contains("viewers may not change jobs"));
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
