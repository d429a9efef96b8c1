//! The images of a scene, or of two side by side, with the values of a pixel.

use http::StatusCode;
use maud::{Markup, html};
use picofarm_figures::number::digits;
use picofarm_store::published::Manifest as _;

use super::{
    Page,
    gallery::describe,
    parts::{bytes, safe},
    room::path as room_path,
};
use crate::{
    App,
    answer::{DAMAGED, Problem},
    data::{Picture, SceneId, Span, Truth, flight_path},
    query::Query,
};

/// Returns the page of the scene in `set` and `scene`, next to that in `set2` and `scene2`.
pub async fn page(app: &App, query: &Query) -> Result<Page, Problem> {
    let first = SceneId::of(query)?;
    let other = match query.number("scene2")? {
        None => None,
        Some(scene) => {
            let set = match query.text("set2") {
                "" => first.set.clone(),
                set => set.to_owned(),
            };
            Some(SceneId { set, scene })
        }
    };
    let spot = query.number("spot")?.unwrap_or(0);
    let mut columns = vec![(app.stores.truth(app, &first).await?, first.clone())];
    if let Some(other) = &other {
        columns.push((app.stores.truth(app, other).await?, other.clone()));
    }
    let spots = columns[0].0.spec.spots;
    let mut rooms = Vec::new();
    for (truth, _) in &columns {
        rooms.push(app.stores.rooms_of(&truth.manifest).await);
    }
    let content = html! {
        h1 { "Scene " (first.scene) @if let Some(other) = &other { " and scene " (other.scene) } }
        form.search action="/data/scene" {
            input type="hidden" name="set" value=(first.set);
            label { "scene " input name="scene" type="number" min="0" value=(first.scene); }
            label { "compare with scene " input name="scene2" type="number" min="0" value=(query.text("scene2")); }
            @if !query.text("set2").is_empty() { input type="hidden" name="set2" value=(query.text("set2")); }
            label { "mask of spot " input name="spot" type="number" min="0"
                max=(spots.saturating_sub(1)) value=(spot); }
            button { "Show" }
        }
        p.readout #readout role="status" aria-live="polite" { "Point at an image for the values of a pixel. Arrow keys move the point." }
        div.columns.two[columns.len() > 1] {
            @for ((truth, id), rooms) in columns.iter().zip(&rooms) {
                (column(truth, id, &app.stores.place(&id.set)?, (spot, rooms))?)
            }
        }
    };
    Ok(Page {
        title: format!("Scene {}", first.scene),
        tab: "/data",
        live: false,
        script: Some("scene.js"),
        content,
    })
}

fn column(
    truth: &Truth,
    id: &SceneId,
    place: &str,
    (spot, rooms): (u64, &[(SceneId, String)]),
) -> Result<Markup, Problem> {
    let named = spot.to_string();
    let lit = Picture::Lit(spot as usize);
    let mut pictures: Vec<(Picture, String)> = Vec::new();
    pictures.extend(Picture::ALL.map(|(picture, title)| (picture, title.to_owned())));
    if truth.spec.spots > 0 {
        let shown = lit.span(truth);
        if let Err(problem) = shown
            && problem.status == StatusCode::BAD_REQUEST
        {
            return Err(problem);
        }
        pictures.push((lit, format!("Lit by spot {spot}")));
    }
    Ok(html! {
        section.column data-scene=(id.encode(&[])) data-width=(truth.spec.width) data-height=(truth.spec.height)
            aria-label={ "Scene " (id.scene) } {
            p { a href={ "/data?" (crate::query::encode(&[("set", &id.set)])) } { "data set" } " " (safe(place))
                " · " (describe(&truth.spec)) " · " a href=(flight_path(&id.set, id.scene)) { "light in flight" }
                @for (room, place) in rooms { " · " a href=(room_path(&room.set, room.scene)) { "in 3D, " (safe(place)) } } }
            @if !truth.is_whole() {
                p.problem { "Some arrays of this scene are damaged. " (safe(DAMAGED)) "." }
            }
            div.images {
                @for (picture, title) in &pictures {
                    @let more: &[(&str, &str)] = match picture {
                        Picture::Lit(_) => &[("what", "lit"), ("spot", &named)],
                        other => &[("what", other.name())],
                    };
                    @match picture.span(truth) {
                    Err(problem) => { figure.image {
                        div.damaged role="alert" { (safe(&problem.message)) }
                        figcaption { (title) }
                    } }
                    Ok(span) => { figure.image {
                        div.frame tabindex="0" role="application" aria-label={ (title) ", arrow keys move the point" } {
                            img src={ "/bytes/picture?" (id.encode(more)) } alt=(title)
                                width=(truth.spec.width) height=(truth.spec.height);
                            span.cross.h {} span.cross.v {}
                        }
                        figcaption { (title) @if let Some(span) = span { (scale(&span)) } }
                    } }
                    }
                }
            }
            section.physics data-physics=(id.encode(&[])) {
                h2 { "Light and geometry" }
                p role="status" { "Comparing the light with the geometry…" }
                noscript { p { "The comparison needs JavaScript." } }
            }
            (origin(truth))
        }
    })
}

/// Where the scene comes from.
fn origin(truth: &Truth) -> Markup {
    let manifest = &truth.manifest;
    let made = &manifest.provenance;
    let plan = serde_json::to_string_pretty(&made.plan).unwrap_or_default();
    html! {
        details.origin {
            summary { "Origin" }
            dl.facts-list {
                dt { "made by" } dd { (safe(made.plan["kind"].as_str().unwrap_or("render"))) " of " (safe(&made.renderer)) }
                dt { "task key" } dd { code { (safe(&made.task_key)) } }
                dt { "seed" } dd { (made.seed) }
                dt { "stored" } dd { (manifest.objects.len()) " objects, " (bytes(manifest.total_bytes())) }
                @if !made.plan["source"].is_null() { dt { "parent" } dd { code { (safe(&made.plan["source"])) } } }
                dt { "plan" } dd { pre { (safe(plan)) } }
            }
        }
    }
}

/// The colour bar.
fn scale(span: &Span) -> Markup {
    let [low, high] = span.ends.map(|value| digits(f64::from(value), 3));
    html! {
        span.scale { (low) " " span.ramp.(span.map) {} " " (high) " " (span.unit) }
    }
}
