//! Scenes of the stores: what there is, pictures, values of pixels, and volumes of light in flight.

mod cache;
mod contents;
mod export;
mod histogram;
mod light;
mod made;
mod models;
mod physics;
mod picture;
mod small;
mod stores;
mod truth;
mod volume;

use std::sync::Arc;

use http::{HeaderValue, StatusCode, header};
use picofarm_dataset::Quantity;
use serde_json::json;

use self::export::Look;

pub use self::{
    contents::{Content, Contents},
    light::{Light, lights},
    made::Made,
    models::{Listed, Model, StoreModels, Sweep},
    picture::{Picture, Span},
    stores::{DataSet, Listing, Stores},
    truth::Truth,
};
use crate::{
    App,
    answer::{Answer, Problem, answer, compressed},
    query::{Query, encode},
};

const BINARY: &str = "application/octet-stream";
const JSON: &str = "application/json";
const PNG: &str = "image/png";
const GLB: &str = "model/gltf-binary";
const GIF: &str = "image/gif";
const SVG: &str = "image/svg+xml";

/// A scene of a data set, as URLs name it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SceneId {
    /// The data set.
    pub set: String,
    /// The scene.
    pub scene: u64,
}

impl SceneId {
    /// Reads the parameters `set` and `scene`.
    ///
    /// # Errors
    /// Names a missing or wrong parameter.
    pub fn of(query: &Query) -> Result<Self, Problem> {
        let set = query.text("set").to_owned();
        if set.is_empty() {
            return Err(Problem::input("set: expected a data set, found nothing"));
        }
        let scene = query.required("scene")?;
        Ok(Self { set, scene })
    }

    /// Returns the parameters of a URL.
    pub fn encode(&self, more: &[(&str, &str)]) -> String {
        let scene = self.scene.to_string();
        let mut pairs = vec![("set", &*self.set), ("scene", &*scene)];
        pairs.extend(more);
        encode(&pairs)
    }
}

/// The path of the page with a scene's light in flight.
pub fn flight_path(set: &str, scene: u64) -> String {
    let set = set.to_owned();
    format!("/flight?{}", SceneId { set, scene }.encode(&[]))
}

/// Computes something on a thread that may take its time.
async fn apart<T: Send + 'static>(
    work: impl FnOnce() -> Result<T, Problem> + Send + 'static,
) -> Result<T, Problem> {
    let broken = |e| {
        let status = StatusCode::INTERNAL_SERVER_ERROR;
        Problem::new(status, format!("the computation broke: {e}"))
    };
    tokio::task::spawn_blocking(work).await.map_err(broken)?
}

/// Returns an answer that browsers save under a name, which needs no escapes.
fn file(media: &'static str, body: impl Into<bytes::Bytes>, name: &str) -> Answer {
    let mut answer = answer(StatusCode::OK, media, body);
    let named = format!("attachment; filename=\"{name}\"");
    let named = HeaderValue::from_str(&named).expect("a name of letters and digits");
    answer
        .headers_mut()
        .insert(header::CONTENT_DISPOSITION, named);
    answer
}

/// Parses a pixel, `COLUMN,ROW` as in the player's address, into its row and column.
fn pixel_of(text: &str) -> Result<[u64; 2], Problem> {
    let parsed = text.split_once(',').and_then(|(column, row)| {
        let number = |text: &str| text.parse::<u64>().ok();
        Some([number(row)?, number(column)?])
    });
    parsed.ok_or_else(|| Problem::input(format!("pixel: expected COLUMN,ROW, found {text:?}")))
}

/// Answers a request below `/bytes/`, which only scripts and pictures make.
///
/// # Errors
/// Fails on wrong parameters and on scenes that cannot be read.
pub async fn bytes(app: &Arc<App>, what: &str, query: &Query) -> Result<Answer, Problem> {
    let id = SceneId::of(query)?;
    let pixel =
        || -> Result<[u64; 2], Problem> { Ok([query.required("row")?, query.required("column")?]) };
    Ok(match what {
        "picture" => {
            let picture = Picture::of(query)?;
            let truth = app.stores.truth(app, &id).await?;
            answer(StatusCode::OK, PNG, picture.draw(&truth)?.0)
        }
        "card" => {
            let truth = app.stores.truth(app, &id).await?;
            answer(StatusCode::OK, PNG, picture::card(&truth))
        }
        "value" => {
            let pixel = pixel()?;
            let truth = app.stores.truth(app, &id).await?;
            compressed(JSON, truth.values(pixel)?.to_string(), 1)
        }
        "flight" => {
            let light = Light::of(query)?;
            let dataset = app.stores.dataset(&id.set).await?;
            let scene = truth::facts(&dataset, id.scene).await?;
            let volume = app.stores.volume(app, &id, light).await?;
            let facts = json!({"volume": volume.facts(), "scene": scene});
            compressed(JSON, facts.to_string(), 1)
        }
        "coarse" => {
            let volume = app.stores.volume(app, &id, Light::of(query)?).await?;
            compressed(BINARY, volume.coarse().to_vec(), 1)
        }
        "slab" => {
            let (from, to) = (query.required("from")?, query.required("to")?);
            let volume = app.stores.volume(app, &id, Light::of(query)?).await?;
            compressed(BINARY, volume.slab(from, to)?.to_vec(), 1)
        }
        "pixel" => {
            let pixel = pixel()?;
            let truth = app.stores.truth(app, &id).await?;
            let light = Light::of(query)?;
            let volume = app.stores.volume(app, &id, light).await?;
            // The parts are those of all light.
            let parts = match light {
                Light::All => app.stores.parts(app, &id).await?,
                _ => None,
            };
            let parts = parts
                .as_ref()
                .map(|parts| parts.each_ref().map(|part| &**part));
            let mut found = histogram::of_pixel(&truth, (light, &volume), parts, pixel)?;
            found["seen"] = app.stores.seen(&truth, truth.pixel(pixel)?).await?.into();
            compressed(JSON, found.to_string(), 1)
        }
        "view" => {
            let dataset = app.stores.dataset(&id.set).await?;
            let facts = truth::facts(&dataset, id.scene).await?;
            compressed(JSON, facts.to_string(), 1)
        }
        "depth" => {
            let dataset = app.stores.dataset(&id.set).await?;
            let depth = dataset.read::<f32>(id.scene, Quantity::Depth).await?;
            let bytes: Vec<u8> = depth.iter().flat_map(|z| z.to_le_bytes()).collect();
            compressed(BINARY, bytes, 1)
        }
        "physics" => {
            let truth = app.stores.truth(app, &id).await?;
            let volume = app.stores.volume(app, &id, Light::All).await?;
            let parts = app.stores.parts(app, &id).await?;
            let found = apart(move || {
                let parts = parts
                    .as_ref()
                    .map(|parts| parts.each_ref().map(|part| &**part));
                physics::verdict(&truth, &volume, parts)
            });
            compressed(JSON, found.await?.to_string(), 1)
        }
        "gif" => {
            let look = Look::of(query)?;
            let volume = app.stores.volume(app, &id, Light::of(query)?).await?;
            let gif = apart(move || Ok(export::gif(&volume, &look))).await?;
            file(GIF, gif, &format!("light-in-flight-{}.gif", id.scene))
        }
        "figure" => {
            let look = Look::of(query)?;
            let at = match query.text("pixel") {
                "" => None,
                text => Some(pixel_of(text)?),
            };
            let truth = app.stores.truth(app, &id).await?;
            let light = Light::of(query)?;
            let volume = app.stores.volume(app, &id, light).await?;
            let draw = move || export::figure(&truth, (light, &volume), &look, at);
            let svg = apart(draw).await?;
            file(SVG, svg, &format!("light-in-flight-{}.svg", id.scene))
        }
        "mesh" => compressed(GLB, app.stores.room(&id).await?.mesh, 1),
        _ => return Err(Problem::missing(format!("there is no /bytes/{what}"))),
    })
}
