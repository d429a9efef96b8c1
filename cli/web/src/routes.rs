//! Which code answers which request.

use std::sync::Arc;

use http::{HeaderValue, Method, StatusCode, header, request::Parts};
use picofarm_proto::ids::JobId;

use crate::{
    App,
    answer::{self, Answer, Problem, compressed, see_other},
    assets, data, live, pages,
    query::Query,
};

const HTML: &str = "text/html; charset=utf-8";
const TEXT: &str = "text/plain; charset=utf-8";

/// The address of the form with the key.
pub const LOGIN: &str = "/key";

/// What a user may do with a job.
const ACTS: [&str; 4] = ["cancel", "pause", "resume", "retry"];

/// Answers a request. `form` is the body of a POST.
pub async fn answer(app: &Arc<App>, head: &Parts, form: &str) -> Answer {
    answer::encode(&head.headers, find(app, head, form).await)
}

/// Returns whether a request has the key, in its cookie or in its address.
pub fn has_key(app: &App, head: &Parts) -> bool {
    let asked = || Query::parse(head.uri.query().unwrap_or_default());
    app.guard.knows(&head.headers) || app.guard.is_key(asked().text("key"))
}

async fn find(app: &Arc<App>, head: &Parts, form: &str) -> Answer {
    if let Err(why) = app.guard.check_host(&head.headers) {
        let status = StatusCode::MISDIRECTED_REQUEST;
        return answer::answer(status, TEXT, why + "\n");
    }
    let path = head.uri.path();
    let query = Query::parse(head.uri.query().unwrap_or_default());
    if let Some(name) = path.strip_prefix("/assets/")
        && let Some((media, text)) = assets::find(name)
    {
        return compressed(media, text.as_bytes(), 6);
    }
    if app.guard.is_key(query.text("key")) && is_read(&head.method) {
        return admit(app, head);
    }
    if path == LOGIN {
        return log_in(app, head, &Query::parse(form));
    }
    if !app.guard.knows(&head.headers) {
        return page(app, StatusCode::UNAUTHORIZED, &pages::locked(""));
    }
    let answered = match head.method {
        Method::GET | Method::HEAD => read(app, path, query).await,
        Method::POST => act(app, head, path, &Query::parse(form)).await,
        _ => Err(not_allowed("GET, HEAD")),
    };
    answered.unwrap_or_else(|problem| match is_read(&head.method) {
        true => self::problem(app, &problem),
        // The address of an action shows nothing that could be followed.
        false => {
            let mut shown = pages::problem(&problem);
            shown.live = false;
            refuse(app, &problem, &shown)
        }
    })
}

/// Returns an error as a page.
pub fn problem(app: &App, problem: &Problem) -> Answer {
    refuse(app, problem, &pages::problem(problem))
}

fn refuse(app: &App, problem: &Problem, shown: &pages::Page) -> Answer {
    let mut answer = page(app, problem.status, shown);
    if problem.status == StatusCode::METHOD_NOT_ALLOWED
        && let Some(allowed) = &problem.hint
        && let Ok(allowed) = HeaderValue::from_str(allowed)
    {
        answer.headers_mut().insert(header::ALLOW, allowed);
    }
    answer
}

fn is_read(method: &Method) -> bool {
    matches!(*method, Method::GET | Method::HEAD)
}

fn not_allowed(allowed: &str) -> Problem {
    Problem {
        status: StatusCode::METHOD_NOT_ALLOWED,
        message: format!("this address answers only {allowed}"),
        hint: Some(allowed.into()),
    }
}

/// Answers the form with the key.
fn log_in(app: &App, head: &Parts, form: &Query) -> Answer {
    if head.method != Method::POST {
        return problem(app, &not_allowed("POST"));
    }
    if let Err(why) = app.guard.check_origin(&head.headers) {
        return problem(app, &Problem::new(StatusCode::FORBIDDEN, why));
    }
    if !app.guard.is_key(form.text("key").trim()) {
        let shown = pages::locked("This is not the key of this server.");
        return page(app, StatusCode::UNAUTHORIZED, &shown);
    }
    welcome(app, "/")
}

/// Sends the browser to a path, with the cookie.
fn welcome(app: &App, to: &str) -> Answer {
    let mut answer = see_other(to);
    if let Ok(cookie) = HeaderValue::from_str(&app.guard.cookie()) {
        answer.headers_mut().insert(header::SET_COOKIE, cookie);
    }
    answer
}

/// Exchanges the key of a link for a cookie, so that the key stays in no history of pages.
fn admit(app: &App, head: &Parts) -> Answer {
    let pairs = url::form_urlencoded::parse(head.uri.query().unwrap_or_default().as_bytes());
    let mut rest = url::form_urlencoded::Serializer::new(String::new());
    rest.extend_pairs(pairs.filter(|(name, _)| name != "key"));
    let rest = rest.finish();
    let path = head.uri.path();
    // A path that begins with two slashes would name another host.
    let mut to = format!("/{}", path.trim_start_matches('/'));
    if !rest.is_empty() {
        to = format!("{to}?{rest}");
    }
    welcome(app, &to)
}

fn page(app: &App, status: StatusCode, page: &pages::Page) -> Answer {
    let html = pages::layout(app, page).into_string();
    let mut answer = compressed(HTML, html, 5);
    *answer.status_mut() = status;
    answer
}

async fn read(app: &Arc<App>, path: &str, query: Query) -> Result<Answer, Problem> {
    if path == "/live" {
        return live::follow(app, query.text("to"));
    }
    if let Some(what) = path.strip_prefix("/bytes/") {
        return data::bytes(app, what, &query).await;
    }
    if path == "/models/report" {
        let page = app.stores.report(query.text("store"), query.text("name"));
        return Ok(answer::foreign(page.await?));
    }
    if let ["jobs", _, act] = parts(path)[..]
        && ACTS.contains(&act)
    {
        return Err(not_allowed("POST"));
    }
    let content = pages::content(app, path, &query).await?;
    Ok(page(app, StatusCode::OK, &content))
}

/// The parts of a path between its slashes.
pub fn parts(path: &str) -> Vec<&str> {
    path.split('/').filter(|part| !part.is_empty()).collect()
}

/// Changes a job, with the rights of the user who started the server.
async fn act(app: &App, head: &Parts, path: &str, form: &Query) -> Result<Answer, Problem> {
    let ["jobs", id, act] = parts(path)[..] else {
        return Err(not_allowed("GET, HEAD"));
    };
    if !ACTS.contains(&act) {
        return Err(Problem::missing(format!("a job has no action {act:?}")));
    }
    let refused = |why| Problem::new(StatusCode::FORBIDDEN, why);
    let checked = app.guard.check_form(&head.headers, form.text("form"));
    checked.map_err(refused)?;
    let job = job(id)?;
    match act {
        "cancel" => app.farm.cancel(job).await?,
        "retry" => app.farm.retry(job).await?,
        act => app.farm.pause(job, act == "pause").await?,
    }
    app.feeds.renew();
    Ok(see_other(&format!("/jobs/{job}")))
}

/// Parses a job's id.
pub fn job(id: &str) -> Result<JobId, Problem> {
    let wrong = |_| Problem::missing(format!("there is no job {id:?}"));
    id.parse().map_err(wrong)
}
