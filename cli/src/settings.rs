//! Settings: flags > environment (`PICOFARM_…`) > file > defaults, and the source of each.

use std::path::{Path, PathBuf};

use figment::{
    Figment, Metadata, Profile, Provider,
    providers::{Env, Serialized},
    value::{Dict, Map, Value},
};
use picofarm_credentials::Secret;
use picofarm_store::Bandwidth;
use picofarm_tasks::Access;
use serde::{Deserialize, Serialize};

use crate::{
    args::Global,
    error::{CliError, Result},
    files,
};

/// Name of the settings file among the sources of settings.
const TOML: &str = "TOML file";

/// The effective settings.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Settings {
    /// URL of the coordinator.
    pub coordinator: String,
    /// Folder with furniture assets.
    pub assets: PathBuf,
    /// Log filter.
    pub log: String,
    /// Certificate authority of the coordinator (PEM).
    pub ca: Option<PathBuf>,
    /// Client certificate (PEM).
    pub cert: Option<PathBuf>,
    /// Private key of the client certificate (PEM).
    pub key: Option<PathBuf>,
    /// File with the token.
    pub token_file: Option<PathBuf>,
    /// Maximum upload rate of this process to object stores, in megabytes per second.
    pub store_upload_mb_s: Option<f64>,
    /// Maximum download rate of this process from object stores, in megabytes per second.
    pub store_download_mb_s: Option<f64>,
}

/// Environment variable with the token itself. The token is neither a setting nor an argument,
/// because those are displayed and recorded.
const TOKEN: &str = "PICOFARM_TOKEN";

impl Settings {
    /// Returns the credentials for a coordinator, and the trusted certificates.
    ///
    /// # Errors
    /// Fails if the token file cannot be used.
    pub fn access(&self) -> Result<Access> {
        let token = match std::env::var(TOKEN) {
            Ok(token) if !token.trim().is_empty() => Some(Secret::new(token.trim())),
            _ => match &self.token_file {
                Some(path) => Some(Secret::read(path).map_err(CliError::input)?),
                None => None,
            },
        };
        Ok(Access {
            ca: self.ca.clone(),
            certificate: self.cert.clone(),
            key: self.key.clone(),
            token,
        })
    }

    /// Returns the limits of this process's transfers to and from object stores.
    ///
    /// # Errors
    /// Fails if a rate is not a positive number.
    pub fn bandwidth(&self) -> Result<Bandwidth> {
        let rate = |name: &str, mb_s: Option<f64>| match mb_s {
            Some(mb_s) if !(mb_s.is_finite() && mb_s > 0.0) => Err(CliError::input(format!(
                "settings: {name}: expected megabytes a second above 0, found {mb_s}"
            ))
            .hint("leave it out for no limit")),
            other => Ok(other.map(|mb_s| mb_s * 1e6)),
        };
        Ok(Bandwidth {
            upload: rate("store_upload_mb_s", self.store_upload_mb_s)?,
            download: rate("store_download_mb_s", self.store_download_mb_s)?,
        })
    }
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
            log: "warn,picofarm::audit=info".into(),
            ca: None,
            cert: None,
            key: None,
            token_file: None,
            store_upload_mb_s: None,
            store_download_mb_s: None,
        }
    }
}

/// Settings with the source of each field.
pub struct Resolved {
    pub settings: Settings,
    pub sources: Vec<(&'static str, String)>,
    /// Whether the environment has a token.
    pub token: bool,
}

const FIELDS: [&str; 9] = [
    "coordinator",
    "assets",
    "log",
    "ca",
    "cert",
    "key",
    "token_file",
    "store_upload_mb_s",
    "store_download_mb_s",
];

/// Resolves the settings.
///
/// # Errors
/// Fails if a named settings file is missing, or if a field is unknown or of the wrong type.
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
        figment = figment.merge(File::read(path)?);
    }
    figment = figment.merge(Env::prefixed("PICOFARM_").only(&FIELDS));
    let shown = |path: &Option<PathBuf>| path.as_ref().map(|p| p.display().to_string());
    let flags: [(&str, Option<String>); 9] = [
        ("coordinator", global.coordinator.clone()),
        ("assets", shown(&global.assets_dir)),
        ("log", global.log.clone()),
        ("ca", shown(&global.ca)),
        ("cert", shown(&global.cert)),
        ("key", shown(&global.key)),
        ("token_file", shown(&global.token_file)),
        ("store_upload_mb_s", None),
        ("store_download_mb_s", None),
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
    let token = std::env::var_os(TOKEN).is_some_and(|t| !t.is_empty());
    let settings = figment.extract::<Settings>().map_err(|e| {
        CliError::input(format!("settings: {e}")).hint(format!(
            "known settings are {}; see `picofarm config`",
            FIELDS.join(", ")
        ))
    })?;
    Ok(Resolved {
        settings,
        sources,
        token,
    })
}

/// A settings file.
struct File {
    path: PathBuf,
    values: Dict,
}

impl File {
    fn read(path: &Path) -> Result<Self> {
        let text = files::read_text(path, files::SETTINGS)?;
        let table: toml::Table = toml::from_str(&text)
            .map_err(|e| CliError::input(format!("settings: {}: {e}", path.display())))?;
        let values = Value::serialize(table).ok().and_then(Value::into_dict);
        Ok(Self {
            path: path.to_owned(),
            values: values.expect("a table is a dictionary"),
        })
    }
}

impl Provider for File {
    fn metadata(&self) -> Metadata {
        Metadata::from(TOML, self.path.as_path())
    }

    fn data(&self) -> Result<Map<Profile, Dict>, figment::Error> {
        Ok(Profile::Default.collect(self.values.clone()))
    }
}

fn source(figment: &Figment, name: &str, file: Option<&Path>) -> String {
    let metadata = figment.find_metadata(name).map(|m| m.name.to_string());
    match metadata.as_deref() {
        Some(n) if n.contains("environment") => {
            format!("environment PICOFARM_{}", name.to_uppercase())
        }
        Some(TOML) => {
            format!("file {}", file.unwrap_or(Path::new("?")).display())
        }
        _ => "default".into(),
    }
}
