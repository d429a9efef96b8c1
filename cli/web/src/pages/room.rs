//! A reconstruction in 3D: its mesh to look at from all sides, and its errors.

use maud::{Markup, html};
use picofarm_figures::number::digits;
use serde_json::Value;

use super::{Page, parts::safe};
use crate::{
    App,
    answer::Problem,
    data::{Made, SceneId, flight_path},
    query::Query,
};

/// Returns the page of the room in `set` and `scene`.
pub async fn page(app: &App, query: &Query) -> Result<Page, Problem> {
    let id = SceneId::of(query)?;
    let room = app.stores.room(&id).await?;
    let source = room.source.as_ref().map(|source| source.encode(&[]));
    let content = html! {
        h1 { "Scene " (id.scene) " in 3D" }
        p.where-from { (safe(app.stores.place(&id.set)?))
            @if let Some(source) = &room.source {
                " · " a href={ "/data/scene?" (source.encode(&[])) } { "images" }
                " · " a href=(flight_path(&source.set, source.scene)) { "light in flight" }
            }
        }
        noscript { p.problem { "The view needs JavaScript." } }
        div #room.flight data-room=(id.encode(&[])) data-source=[source.as_ref()] {
            div.stage {
                div.screen.space #screen tabindex="0" role="application"
                    aria-label="The room in 3D. Arrow keys turn it, plus and minus move closer and away, Home goes to the camera." {
                    canvas #view width="512" height="512" {}
                    canvas #marks width="512" height="512" aria-hidden="true" {}
                    p #message role="alert" {}
                }
                p.hint { "Drag to turn, with Shift or two fingers to move; the wheel or + and − go closer and away." }
            }
            div.side {
                form #controls.controls {
                    label { span { "Colours" } select #colour {
                        option value="shape" { "shape" }
                        @if source.is_some() { option value="error" { "distance from the true depth" } }
                        option value="seen" { "what the camera sees" }
                    } }
                    label { span { "Error" } input #most type="range" min="0.02" max="0.5" step="0.02" value="0.1"; output #limit {} }
                    label.check { input #hidden type="checkbox" checked; " show what the camera does not see" }
                    label.check { input #back type="checkbox"; " show walls from behind" }
                    div.buttons {
                        button #export type="button" { "Save PNG" }
                        a.button href={ "/bytes/mesh?" (id.encode(&[])) } download={ "room-" (id.scene) ".glb" } { "Save mesh (glTF)" }
                        button #camera type="button" { "Camera's view" }
                    }
                    p #meaning.legend {}
                }
                (errors(&room.metrics))
                p.status { span #loaded role="status" {} }
            }
        }
    };
    Ok(Page {
        title: format!("Scene {} in 3D", id.scene),
        tab: "/data",
        live: false,
        script: Some("room.js"),
        content,
    })
}

/// The errors that a reconstruction states, and its facts.
fn errors(metrics: &Value) -> Markup {
    let metres = |pointer: &str| {
        let value = metrics.pointer(pointer).and_then(Value::as_f64);
        value.map(|value| format!("{} m", digits(value, 3)))
    };
    let count = |name: &str| metrics[name].as_u64();
    let rows = [
        ("visible from the camera", "/novel_views/visible/l1_m"),
        ("hidden from the camera", "/novel_views/occluded/l1_m"),
        ("outside of the view", "/novel_views/outside/l1_m"),
        ("all", "/novel_views/all/l1_m"),
        ("mesh to truth", "/mesh/accuracy_m"),
        ("truth to mesh", "/mesh/completeness_m"),
    ];
    let rows: Vec<(&str, String)> = rows
        .iter()
        .filter_map(|(name, pointer)| Some((*name, metres(pointer)?)))
        .collect();
    let verdict = picofarm_results::Verdict::of_reconstruction(metrics);
    html! {
        h2 { "Stored errors" }
        @if rows.is_empty() { p.none { "This reconstruction stores no errors: nothing true was there to compare with." } }
        @else {
            p.hint { "Mean distance along the rays of novel views, and between mesh and truth." }
            dl.facts-list { @for (name, value) in &rows { dt { (name) } dd { (value) } } }
        }
        h2 { "Facts" }
        dl.facts-list {
            @if let Some(triangles) = count("triangles") { dt { "triangles" } dd { (triangles) } }
            @if let Some(spots) = count("spots") { dt { "spots" } dd { (spots) } }
        }
        h2 { "Verdict" }
        p.doubtful[verdict.doubtful] { (safe(&verdict.text)) }
    }
}

/// The rooms in 3D of the stores, for the list of data sets.
pub fn list(made: &[Made]) -> Markup {
    let with_rooms = made.iter().filter(|made| !made.rooms().is_empty());
    html! {
        @for made in with_rooms {
            section.made {
                h2 { (safe(&made.place)) }
                p { "in 3D: " @for scene in made.rooms().iter().take(MOST) {
                    a href=(path(&made.id, *scene)) { "scene " (scene) } " "
                }
                @if made.rooms().len() > MOST { "and " (made.rooms().len() - MOST) " more, linked from the pages of their scenes" } }
            }
        }
    }
}

/// Most links of a list.
const MOST: usize = 24;

/// Returns the path of the page of a room in 3D.
pub fn path(set: &str, scene: u64) -> String {
    let set = set.to_owned();
    format!("/data/room?{}", SceneId { set, scene }.encode(&[]))
}
