//! Light in flight: the player of a scene's histograms.

use maud::html;

use super::{Page, parts::safe};
use crate::{
    App,
    answer::Problem,
    data::{Light, SceneId, lights},
    query::{Query, encode},
};

/// Returns the player of the scene in `set` and `scene`.
pub async fn page(app: &App, query: &Query) -> Result<Page, Problem> {
    let id = SceneId::of(query)?;
    let light = Light::of(query)?;
    let dataset = app.stores.dataset(&id.set).await?;
    dataset.manifest(id.scene).await?;
    let folder = app.stores.folder(&id.set)?;
    let lights = lights(dataset.spec(), folder.as_deref());
    // Links are shared, and may name light that another data set has.
    let absent = lights.iter().all(|(kind, _)| *kind != light);
    let asked = light.name();
    let light = if absent { Light::All } else { light };
    let spec = dataset.spec();
    let content = html! {
        h1 { "Light in flight, scene " (id.scene) }
        p.where-from { a href={ "/data?" (encode(&[("set", &id.set)])) } { "data set" } " " (safe(app.stores.place(&id.set)?))
            " · " a href={ "/data/scene?" (id.encode(&[])) } { "images" } " · " (super::gallery::describe(spec)) }
        @if absent {
            p.hint role="status" { "This data set stores no light " code { (safe(asked)) } " of its own: all light is shown." }
        }
        noscript { p.problem { "The player needs JavaScript." } }
        div #flight.flight data-scene=(id.encode(&[])) data-light=(light.name()) {
            div.stage {
                div.views role="group" aria-label="View" {
                    button #image type="button" aria-pressed="true" title="key 2" { "Image" }
                    button #space type="button" aria-pressed="false" title="key 3" { "In space" }
                    label.check hidden { input #surface type="checkbox" checked; " light at the surfaces" }
                }
                div.screen #screen tabindex="0" role="application"
                    aria-label="Room with light in flight. Space plays, comma and full stop step, arrow keys move the picked pixel; in space they turn the room." {
                    canvas #view width=(spec.width) height=(spec.height) {}
                    canvas #marks width=(spec.width) height=(spec.height) aria-hidden="true" {}
                    p #message role="alert" {}
                }
                div.transport {
                    button #play type="button" title="Play or pause (space)" { "Play" }
                    div.when {
                        input #time type="range" min="0" max=(spec.gate.bins - 1) step="any" value="0" aria-label="Time";
                        canvas #energy height="36" aria-hidden="true" {}
                    }
                    output #clock { "0.00 ns" }
                }
                p #how.hint {}
            }
            div.side {
                form #controls.controls {
                    label { span { "Light" } select #light {
                        @for (kind, title) in &lights {
                            option value=(kind.name()) selected[*kind == light] { (title) }
                        }
                    } }
                    label { span { "Scale" } select #scale {
                        option value="linear" { "linear" } option value="root" selected { "square root" }
                        option value="log" { "logarithmic" }
                    } }
                    label { span { "Colours" } select #map {
                        option value="0" { "inferno" } option value="1" { "viridis" } option value="2" { "grey" }
                    } }
                    label { span { "Exposure" } input #exposure type="range" min="-6" max="10" step="0.25" value="0"; }
                    label { span { "Shutter" } input #shutter type="range" min="1" max="32" step="1" value="2"; output #bins { "2 bins" } }
                    label { span { "Speed" } input #speed type="range" min="-2" max="2" step="0.25" value="0"; output #rate { } }
                    label { span { "Room" } input #room type="range" min="0" max="1" step="0.05" value="0.25"; }
                    label.check { input #spots type="checkbox"; " show the spots" }
                    div.buttons {
                        button #export type="button" title="key s" { "Save PNG" }
                        button #record type="button" title="key r" { "Record WebM" }
                        button #gif type="button" title="key g" { "Save GIF" }
                        button #figure type="button" title="key f" { "Save figure (SVG)" }
                        button #link type="button" { "Copy link" }
                    }
                    p #saved.hint role="status" {}
                }
                figure.histogram {
                    figcaption #picked aria-live="polite" { "Pick a pixel to see its histogram." }
                    div #seen.seen {}
                    canvas #histogram height="220" tabindex="0" role="img" aria-label="Histogram of the picked pixel" {}
                    p #kinds.legend.times {
                        span.item { span.key.one {} "one bounce" } span.item { span.key.two {} "two bounces, lit by the spot" }
                        span.item { span.key.more {} "three and more" }
                    }
                    div.toggle {
                        label.check { input #hlog type="checkbox" checked; " logarithmic" }
                        label.check { input #zoom type="checkbox" checked; " only bins with light" }
                    }
                }
                p.status { span #loaded role="status" {} " " span #fps {} }
            }
        }
    };
    Ok(Page {
        title: format!("Light in flight, scene {}", id.scene),
        tab: "/data",
        live: false,
        script: Some("flight.js"),
        content,
    })
}
