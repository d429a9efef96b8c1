//! `picofarm assets …`, and which furniture a job uses.

use std::path::Path;

use picofarm_scene::{AssetLibrary, SceneError};
use serde_json::json;

use crate::{
    args::Assets,
    error::Result,
    output::{Output, table},
    settings::Settings,
};

/// The libraries that can be asked for by name.
const NAMES: [&str; 3] = ["sweethome3d", "parametric", "gltf"];
/// Those that `auto` chooses among, best first: a folder of somebody's own models is asked for by name.
const AUTO: [&str; 2] = ["sweethome3d", "parametric"];

/// The library that a job's `assets` names: a name, a fingerprint, or `auto` for the best installed.
///
/// # Errors
/// It is not installed, or no library is called so.
pub fn library(name: &str, dir: &Path) -> Result<AssetLibrary> {
    let dirs = [dir.to_owned()];
    if name == "auto" {
        for name in AUTO {
            match AssetLibrary::find(name, &dirs) {
                Err(SceneError::Assets { .. }) => {}
                found => return Ok(found?),
            }
        }
    }
    for known in NAMES {
        if name != known && name.starts_with(known) {
            let library = AssetLibrary::find(known, &dirs)?;
            if library.fingerprint() == name {
                return Ok(library);
            }
        }
    }
    Ok(AssetLibrary::find(name, &dirs)?)
}

/// The fingerprint of the library that `name` stands for.
///
/// # Errors
/// As [`library`].
pub fn resolve(name: &str, dir: &Path) -> Result<String> {
    Ok(library(name, dir)?.fingerprint().to_owned())
}

pub async fn run(command: Assets, settings: &Settings, output: Output) -> Result<()> {
    match command {
        Assets::Install => {
            output.say(format!(
                "fetching Sweet Home 3D's furniture into {} …",
                settings.assets.display()
            ));
            let dir = settings.assets.clone();
            let installed = tokio::task::spawn_blocking(move || picofarm_scene::install(&dir))
                .await
                .expect("the installer does not panic")?;
            let fingerprint = resolve("sweethome3d", &settings.assets)?;
            output.result(
                &json!({"dir": installed, "fingerprint": fingerprint}),
                || format!("installed {fingerprint} in {}", settings.assets.display()),
            );
        }
        Assets::List => {
            let dirs = [settings.assets.clone()];
            let rows: Vec<_> = NAMES
                .iter()
                .map(|name| match AssetLibrary::find(name, &dirs) {
                    Ok(l) => vec![
                        (*name).to_owned(),
                        l.fingerprint().to_owned(),
                        format!("{} models", l.len()),
                    ],
                    Err(e) => vec![(*name).to_owned(), "not installed".into(), e.to_string()],
                })
                .collect();
            output.result(&rows, || table(&rows));
        }
    }
    Ok(())
}
