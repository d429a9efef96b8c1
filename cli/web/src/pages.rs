//! The pages as HTML. Each begins with a link to its content, works without scripts except where
//! it draws, and shows texts of others escaped.

mod audit;
mod events;
mod flight;
mod gallery;
mod grid;
mod job;
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
const TABS: [(&str, &str); 6] = [
    ("/", "Farm"),
    ("/jobs", "Jobs"),
    ("/workers", "Workers"),
    ("/events", "Events"),
    ("/audit", "Audit"),
    ("/data", "Data sets"),
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
            let number = |text: &str| text.parse::<u64>().ok();
            let (Some(stage), Some(task)) = (number(stage), number(task)) else {
                return Err(Problem::missing("expected /jobs/JOB/tasks/STAGE/TASK"));
            };
            task::page(app, routes::job(id)?, stage as u32, task).await
        }
        ["workers"] => workers::page(app).await,
        ["events"] => events::page(app, query).await,
        ["audit"] => audit::page(app, query).await,
        ["data"] => gallery::page(app, query).await,
        ["data", "scene"] => scene::page(app, query).await,
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

/// Returns the page for browsers without the key.
pub fn locked() -> Page {
    Page {
        title: "Locked".into(),
        tab: "",
        live: false,
        script: None,
        content: html! {
            section.problem {
                h1 { "This page needs its link" }
                p { "Open the link that " code { "picofarm web" } " printed, which ends with a key. "
                    "The key is new at each start of the program." }
            }
        },
    }
}

/// Returns the whole document.
pub fn layout(app: &App, page: &Page) -> Markup {
    const DATA: &str = "/data";
    let farm = app.linked || page.tab != DATA;
    let tabs = TABS.into_iter().filter(|(path, _)| farm || *path == DATA);
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
                    a.brand href=(if farm { "/" } else { DATA }) { "picofarm" }
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
