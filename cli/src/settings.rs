//! Settings: flags > environment (`PICOFARM_…`) > file > defaults, and where each came from.

use std::path::{Path, PathBuf};

use figment::{
    Figment,
    providers::{Env, Format, Serialized, Toml},
};
use serde::{Deserialize, Serialize};

use crate::{
    args::Global,
    error::{CliError, Result},
};

/// What is in force.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Settings {
    /// URL of the coordinator.
    pub coordinator: String,
    /// Folder with furniture assets.
    pub assets: PathBuf,
    /// Log filter.
    pub log: String,
}

fn user_dir(variable: &str, fallback: &str) -> PathBuf {
    let base = std::env::var_os(variable).map(PathBuf::from);
    let home = || PathBuf::from(std::env::var_os("HOME").unwrap_or_else(|| ".".into()));
    base.filter(|p| p.is_absolute())
        .unwrap_or_else(|| home().join(fallback))
        .join("picofarm")
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            coordinator: "http://127.0.0.1:7420".into(),
            assets: user_dir("XDG_DATA_HOME", ".local/share").join("assets"),
            log: "warn".into(),
        }
    }
}

/// Settings with the source of each field.
pub struct Resolved {
    pub settings: Settings,
    pub sources: Vec<(&'static str, String)>,
}

const FIELDS: [&str; 3] = ["coordinator", "assets", "log"];

/// Resolves the settings.
///
/// # Errors
/// A named settings file that is missing, or a field that is unknown or of the wrong type.
pub fn resolve(global: &Global) -> Result<Resolved> {
    let file = match &global.config {
        Some(path) if !path.is_file() => {
            return Err(CliError::input(format!(
                "--config {}: no such file",
                path.display()
            )));
        }
        Some(path) => Some(path.clone()),
        None => [
            PathBuf::from("picofarm.toml"),
            user_dir("XDG_CONFIG_HOME", ".config").join("picofarm.toml"),
        ]
        .into_iter()
        .find(|p| p.is_file()),
    };
    let mut figment = Figment::from(Serialized::defaults(Settings::default()));
    if let Some(path) = &file {
        figment = figment.merge(Toml::file_exact(path));
    }
    figment = figment.merge(Env::prefixed("PICOFARM_").only(&FIELDS));
    let flags: [(&str, Option<String>); 3] = [
        ("coordinator", global.coordinator.clone()),
        (
            "assets",
            global.assets_dir.as_ref().map(|p| p.display().to_string()),
        ),
        ("log", global.log.clone()),
    ];
    let mut sources = Vec::new();
    for (name, value) in flags {
        if let Some(value) = value {
            figment = figment.merge((name, value));
            sources.push((name, "flag".into()));
        } else {
            sources.push((name, source(&figment, name, file.as_deref())));
        }
    }
    let settings = figment.extract::<Settings>().map_err(|e| {
        CliError::input(format!("settings: {e}")).hint(format!(
            "known settings are {}; see `picofarm config`",
            FIELDS.join(", ")
        ))
    })?;
    Ok(Resolved { settings, sources })
}

fn source(figment: &Figment, name: &str, file: Option<&Path>) -> String {
    let metadata = figment.find_metadata(name).map(|m| m.name.to_string());
    match metadata.as_deref() {
        Some(n) if n.contains("environment") => {
            format!("environment PICOFARM_{}", name.to_uppercase())
        }
        Some(n) if n.contains("TOML") => {
            format!("file {}", file.unwrap_or(Path::new("?")).display())
        }
        _ => "default".into(),
    }
}
