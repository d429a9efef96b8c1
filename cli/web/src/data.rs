//! Scenes of the stores: what there is, pictures, values of pixels, and volumes of light in flight.

mod cache;
mod contents;
mod histogram;
mod light;
mod models;
mod picture;
mod stores;
mod truth;
mod volume;

use std::sync::Arc;

use http::StatusCode;
use serde_json::json;

pub use self::{
    contents::{Content, Contents},
    light::{Light, lights},
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
            let found = histogram::of_pixel(&truth, (light, &volume), parts, pixel)?;
            compressed(JSON, found.to_string(), 1)
        }
        _ => return Err(Problem::missing(format!("there is no /bytes/{what}"))),
    })
}
