//! The data sets, and a gallery of the scenes of one.

use http::StatusCode;
use maud::{Markup, html};
use picofarm_dataset::DatasetSpec;
use picofarm_figures::number::thousands;

use super::{Page, parts::safe};
use crate::{
    App,
    answer::Problem,
    data::{DataSet, Listing, SceneId, flight_path},
    query::{Query, encode},
};

/// Scenes on a page.
const SHOWN: usize = 24;

/// Returns the list of data sets, or the gallery of one.
pub async fn page(app: &App, query: &Query) -> Result<Page, Problem> {
    let listed = app.stores.list().await;
    let content = match query.text("set") {
        "" => list(app, &listed),
        id => {
            let set = listed.sets.iter().find(|set| set.id == id);
            let problem = || match listed.unread.iter().find(|unread| unread.id == id) {
                Some(unread) => Problem {
                    hint: unread.hint.clone(),
                    ..Problem::new(StatusCode::INTERNAL_SERVER_ERROR, &unread.why)
                },
                None => Problem::missing(format!("set: there is no data set {id:?}")),
            };
            gallery(set.ok_or_else(problem)?, query)?
        }
    };
    Ok(Page {
        title: "Data sets".into(),
        tab: "/data",
        live: false,
        script: None,
        content,
    })
}

/// The properties of a data set in a line.
pub fn describe(spec: &DatasetSpec) -> String {
    format!(
        "{}×{} pixels, {} bins of {:.1} mm, {} spots, {}",
        spec.width,
        spec.height,
        spec.gate.bins,
        1000.0 * spec.gate.bin_width_m,
        spec.spots,
        spec.profile.name()
    )
}

fn list(app: &App, listed: &Listing) -> Markup {
    html! {
        h1 { "Data sets" }
        @if !listed.unread.is_empty() {
            section #unread.problem role="alert" {
                h2 { "Not readable" }
                ul { @for unread in &listed.unread {
                    li { b { (safe(&unread.place)) } ": " (safe(&unread.why))
                        @if let Some(hint) = &unread.hint { p.hint { (safe(hint)) } } }
                } }
            }
        } @else if listed.sets.is_empty() {
            @let names: Vec<&str> = app.stores.names().collect();
            p.none {
                @if names.is_empty() {
                    "No store is shown. Start " code { "picofarm web --store FOLDER_OR_URL" } "."
                } @else { "No data set yet in " (safe(names.join(", "))) "." }
            }
        }
        ul.sets { @for set in &listed.sets {
            @let link = format!("/data?{}", encode(&[("set", &set.id)]));
            li {
                h2 { a href=(link) { (safe(&set.place)) } }
                p { (thousands(set.scenes.len() as u64)) " of " (thousands(set.dataset.spec().scenes))
                    " scenes · " (describe(set.dataset.spec())) }
                div.strip { @for scene in set.scenes.iter().take(3) { (card(set, *scene)) } }
            }
        } }
        (super::room::list(&listed.made))
    }
}

fn gallery(set: &DataSet, query: &Query) -> Result<Markup, Problem> {
    let (from, to) = (query.number("from")?, query.number("to")?);
    let start = query.number("start")?.unwrap_or(0) as usize;
    let within =
        |scene: &&u64| from.is_none_or(|f| **scene >= f) && to.is_none_or(|t| **scene <= t);
    let scenes: Vec<u64> = set.scenes.iter().filter(within).copied().collect();
    let link = |start: usize| {
        let start = start.to_string();
        let (from, to) = (query.text("from"), query.text("to"));
        let rest = encode(&[
            ("set", &set.id),
            ("from", from),
            ("to", to),
            ("start", &start),
        ]);
        format!("/data?{rest}")
    };
    Ok(html! {
        h1 { (safe(&set.place)) }
        p { (thousands(set.scenes.len() as u64)) " of " (thousands(set.dataset.spec().scenes)) " scenes · "
            (describe(set.dataset.spec())) }
        form.search action="/data" role="search" {
            input type="hidden" name="set" value=(set.id);
            label { "scenes from " input name="from" type="number" min="0" value=(query.text("from")); }
            label { "to " input name="to" type="number" min="0" value=(query.text("to")); }
            button { "Show" }
        }
        @if scenes.is_empty() { p.none { "No finished scene here." } }
        div.cards { @for scene in scenes.iter().skip(start).take(SHOWN) { (card(set, *scene)) } }
        nav.pages aria-label="Pages" {
            @if start > 0 { a href=(link(start.saturating_sub(SHOWN))) { "Previous" } }
            @if start + SHOWN < scenes.len() { a href=(link(start + SHOWN)) { "Next" } }
        }
    })
}

fn card(set: &DataSet, scene: u64) -> Markup {
    let id = SceneId {
        set: set.id.clone(),
        scene,
    };
    html! {
        div.card {
            a href={ "/data/scene?" (id.encode(&[])) } {
                img src={ "/bytes/card?" (id.encode(&[])) } width="384" height="128" loading="lazy"
                    alt={ "Scene " (scene) ": colour, depth and all light" };
            }
            p { "scene " (scene) " · " a href={ "/data/scene?" (id.encode(&[])) } { "images" } " · "
                a href=(flight_path(&set.id, scene)) { "light in flight" } }
        }
    }
}
