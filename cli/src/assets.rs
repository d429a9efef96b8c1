//! `picofarm assets …`, and which furniture a job uses.

use std::path::Path;

use picofarm_scene::AssetLibrary;
use serde_json::json;

use crate::{
    args::Assets,
    error::Result,
    output::{Output, table},
    settings::Settings,
};

/// The fingerprint of the library that `name` stands for.
///
/// # Errors
/// It is not installed, or no library is called so.
pub fn resolve(name: &str, dir: &Path) -> Result<String> {
    Ok(AssetLibrary::named(name, &[dir.to_owned()])?
        .fingerprint()
        .to_owned())
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
            let rows: Vec<_> = AssetLibrary::NAMES
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
