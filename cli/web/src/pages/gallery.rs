//! The data sets, and a gallery of the scenes of one.

mod filter;

use http::StatusCode;
use maud::{Markup, html};
use picofarm_dataset::DatasetSpec;
use picofarm_figures::number::thousands;

use self::filter::Filter;
use super::{
    Page,
    parts::{bytes, safe},
};
use crate::{
    App,
    answer::Problem,
    data::{Content, DataSet, Listing, SceneId, flight_path},
    query::{Query, encode},
};

/// Scenes on a page.
const SHOWN: usize = 24;

/// Returns the list of data sets, or the gallery of one.
pub async fn page(app: &App, query: &Query) -> Result<Page, Problem> {
    let listed = app.stores.list().await;
    let (content, live) = match query.text("set") {
        "" => (list(app, &listed), false),
        id => {
            let set = listed.sets.iter().find(|set| set.id == id);
            let problem = || match listed.unread.iter().find(|unread| unread.id == id) {
                Some(unread) => Problem {
                    hint: unread.hint.clone(),
                    ..Problem::new(StatusCode::INTERNAL_SERVER_ERROR, &unread.why)
                },
                None => Problem::missing(format!("set: there is no data set {id:?}")),
            };
            gallery(app, set.ok_or_else(problem)?, query).await?
        }
    };
    Ok(Page {
        title: "Data sets".into(),
        tab: "/data",
        live,
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
                div.strip { @for scene in set.scenes.iter().take(3) { (card(set, *scene, None)) } }
            }
        } }
        (super::room::list(&listed.made))
    }
}

/// Returns a gallery, and whether its scenes are still being read for a filter.
async fn gallery(app: &App, set: &DataSet, query: &Query) -> Result<(Markup, bool), Problem> {
    let filter = Filter::parse(query)?;
    let start = query.number("start")?.unwrap_or(0) as usize;
    let contents = match filter.needs_contents() {
        true => Some(app.stores.contents(set).await?),
        false => None,
    };
    let contents = contents.as_deref();
    let scenes = filter.select(&set.scenes, contents);
    let read = contents
        .map(|contents| contents.len())
        .filter(|read| *read < set.scenes.len());
    let link = |start: usize| Filter::path(query, &set.id, start);
    let shown = scenes.iter().skip(start).take(SHOWN);
    let content = html! {
        h1 { (safe(&set.place)) }
        p { (thousands(set.scenes.len() as u64)) " of " (thousands(set.dataset.spec().scenes)) " scenes · "
            (describe(set.dataset.spec())) }
        (Filter::form(query, &set.id, contents))
        @if let Some(read) = read {
            p #reading.hint role="status" { "The manifests of " (thousands(read as u64)) " scenes have been read so far. "
                "The page adds the others as they are read." }
        }
        @if contents.is_some() { p #found { (thousands(scenes.len() as u64)) " scenes are as selected." } }
        @if scenes.is_empty() { p.none { "No finished scene here." } }
        div.cards { @for scene in shown { (card(set, *scene, contents.and_then(|c| c.get(*scene)))) } }
        nav.pages aria-label="Pages" {
            @if start > 0 { a href=(link(start.saturating_sub(SHOWN))) { "Previous" } }
            @if start.saturating_add(SHOWN) < scenes.len() { a href=(link(start + SHOWN)) { "Next" } }
        }
    };
    Ok((content, read.is_some()))
}

/// The facts from a scene's manifest in a line.
fn describe_content(content: &Content) -> Markup {
    html! {
        @if !content.room.is_empty() { " · " (safe(&content.room)) }
        @if let Some(error) = content.error { " · error " (format!("{:.1} %", 100.0 * error)) }
        @if let Some(rays) = content.rays { " · " (picofarm_figures::number::prefixed(rays as f64)) " rays" }
        @if content.bytes > 0 { " · " (bytes(content.bytes)) }
        @if let Some(damage) = &content.damage { " · " span.doubtful { (safe(damage)) } }
    }
}

fn card(set: &DataSet, scene: u64, content: Option<&Content>) -> Markup {
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
                a href=(flight_path(&set.id, scene)) { "light in flight" }
                @if let Some(content) = content { (describe_content(content)) } }
        }
    }
}
