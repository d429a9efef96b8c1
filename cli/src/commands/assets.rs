//! `picofarm assets …`, and the choice of furniture for a job.

use std::path::Path;

use picofarm_proto::show;
use picofarm_scene::AssetLibrary;
use serde_json::json;

use crate::{
    args::Assets,
    error::Result,
    output::{Output, table},
    settings::Settings,
};

/// Returns the fingerprint of the library called `name`.
///
/// # Errors
/// Fails if the library is not installed, or if there is no library of this name.
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
        Assets::Scan { folder } => {
            let dir = folder.unwrap_or_else(|| settings.assets.clone());
            let scanned = tokio::task::spawn_blocking(move || picofarm_scene::scan(&dir))
                .await
                .expect("the scan does not panic")?;
            output.result(
                &json!({"list": scanned.list, "listed": scanned.listed, "refused": scanned.refused}),
                || {
                    let refused = scanned.refused.iter().map(|(path, why)| {
                        show::line(&format!("refused: {path}: {why}")).to_string() + "\n"
                    });
                    let listed = scanned.listed.iter().map(|(label, n)| format!("{n} {label}"));
                    let listed: Vec<String> = listed.collect();
                    let all = format!("{}: {}\n", scanned.list.display(), listed.join(", "));
                    refused.collect::<String>() + &all
                },
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
