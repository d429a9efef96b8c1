//! The pages as HTML. Each begins with a link to its content, works without scripts except where
//! it draws, and shows texts of others escaped.

mod audit;
mod chart;
mod events;
mod flight;
mod gallery;
mod grid;
mod job;
mod models;
mod overview;
mod parts;
mod room;
mod scene;
mod task;
mod workers;

use maud::{DOCTYPE, Markup, html};

use self::parts::safe;
use crate::{App, answer::Problem, query::Query, routes};

/// A page without its frame.
pub struct Page {
    /// Its title.
    pub title: String,
    /// The part of the site that it belongs to.
    pub tab: &'static str,
    /// Whether the content changes by itself, and is sent again then.
    pub live: bool,
    /// A script that it needs.
    pub script: Option<&'static str>,
    /// The content.
    pub content: Markup,
}

/// The parts of the site.
const TABS: [(&str, &str); 7] = [
    ("/", "Farm"),
    ("/jobs", "Jobs"),
    ("/workers", "Workers"),
    ("/events", "Events"),
    ("/audit", "Audit"),
    ("/data", "Data sets"),
    ("/models", "Models"),
];

/// Returns the page at `path`.
///
/// # Errors
/// Fails if there is no such page, or if the coordinator or a store does not answer.
pub async fn content(app: &App, path: &str, query: &Query) -> Result<Page, Problem> {
    match routes::parts(path)[..] {
        [] => overview::farm(app).await,
        ["jobs"] => overview::jobs(app, query).await,
        ["jobs", id] => job::page(app, routes::job(id)?, query).await,
        ["jobs", id, "tasks", stage, task] => {
            let (Ok(stage), Ok(task)) = (stage.parse(), task.parse()) else {
                return Err(Problem::missing("expected /jobs/JOB/tasks/STAGE/TASK"));
            };
            task::page(app, routes::job(id)?, stage, task).await
        }
        ["workers"] => workers::page(app, query).await,
        ["events"] => events::page(app, query).await,
        ["audit"] => audit::page(app, query).await,
        ["data"] => gallery::page(app, query).await,
        ["data", "scene"] => scene::page(app, query).await,
        ["models"] => models::page(app, query).await,
        ["models", "model"] => models::model(app, query).await,
        ["models", "sweep"] => models::sweep(app, query).await,
        ["data", "room"] => room::page(app, query).await,
        ["flight"] => flight::page(app, query).await,
        _ => Err(Problem::missing(format!("there is no page {path}"))),
    }
}

/// Returns an error as a page. That of a coordinator that is away waits until it answers.
pub fn problem(problem: &Problem) -> Page {
    let title = problem.heading();
    Page {
        title: title.into(),
        tab: "",
        live: problem.is_away(),
        script: None,
        content: html! {
            section #problem.problem role="alert" {
                h1 { (title) }
                p { (safe(&problem.message)) }
                @if let Some(hint) = &problem.hint { p.hint { (safe(hint)) } }
            }
        },
    }
}

/// Returns the page for browsers without the key, with the reason why the last one was refused.
pub fn locked(why: &str) -> Page {
    Page {
        title: "Locked".into(),
        tab: "",
        live: false,
        script: None,
        content: html! {
            section.problem {
                h1 { "This page needs its key" }
                @if !why.is_empty() { p role="alert" { (why) } }
                p { "Open the link that " code { "picofarm web" } " printed, or enter the key at its end. "
                    "The key is new at each start of the program." }
                form.search method="post" action=(routes::LOGIN) {
                    label { "key " input name="key" type="password" size="34" autocomplete="off" required; }
                    button { "Open" }
                }
            }
        },
    }
}

/// Returns the whole document.
pub fn layout(app: &App, page: &Page) -> Markup {
    /// Parts that need no farm; the first is the start where none answers.
    const STORES: [&str; 2] = ["/data", "/models"];
    let farm = app.linked || !STORES.contains(&page.tab);
    let tabs = TABS
        .into_iter()
        .filter(|(path, _)| farm || STORES.contains(path));
    html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                meta name="color-scheme" content="light dark";
                title { (safe(&page.title)) " · picofarm" }
                link rel="stylesheet" href="/assets/style.css";
                link rel="icon" href="/assets/icon.svg" type="image/svg+xml";
                @if page.live { script type="module" src="/assets/live.js" {} }
                @if let Some(script) = page.script {
                    script type="module" src={ "/assets/" (script) } {}
                }
            }
            body {
                a.skip href="#main" { "Skip to content" }
                header.top {
                    a.brand href=(if farm { "/" } else { STORES[0] }) { "picofarm" }
                    nav aria-label="Site" {
                        @for (path, name) in tabs {
                            a href=(path) aria-current=[(path == page.tab).then_some("page")] {
                                (name)
                            }
                        }
                    }
                    @if farm { span.where title="coordinator" { (safe(app.farm.url())) } }
                    span #state.state role="status" {}
                }
                main #main { (page.content) }
            }
        }
    }
}
