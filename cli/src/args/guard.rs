//! Options that say who may use a coordinator, and how much.

use std::path::PathBuf;

use clap::{Args, Subcommand};
use picofarm_coordinator::auth::Role;

/// TLS, tokens and limits of a coordinator.
#[derive(Args)]
pub struct Guard {
    /// Certificate (PEM) to show to clients and workers, who then use https://
    #[arg(
        long,
        value_name = "FILE",
        requires = "tls_key",
        env = "PICOFARM_TLS_CERT"
    )]
    pub tls_cert: Option<PathBuf>,
    /// Private key (PEM) of --tls-cert
    #[arg(
        long,
        value_name = "FILE",
        requires = "tls_cert",
        env = "PICOFARM_TLS_KEY"
    )]
    pub tls_key: Option<PathBuf>,
    /// Mutual TLS: clients and workers must show a certificate signed by one of these (PEM)
    #[arg(
        long,
        value_name = "FILE",
        requires = "tls_cert",
        env = "PICOFARM_CLIENT_CA"
    )]
    pub client_ca: Option<PathBuf>,
    /// Who may do what (see `picofarm token`); read again whenever it changes
    #[arg(long, value_name = "FILE", env = "PICOFARM_TOKENS")]
    pub tokens: Option<PathBuf>,
    /// Go without TLS or without tokens where they are wanted
    #[arg(long)]
    pub allow_insecure: bool,
    /// Jobs of one caller that have not ended, at most
    #[arg(long, value_name = "N", default_value_t = 1_000)]
    pub max_jobs_per_user: usize,
    /// Tasks of one job, at most
    #[arg(long, value_name = "N", default_value_t = 10_000_000)]
    pub max_tasks_per_job: u64,
    /// Workers connected at a time, at most
    #[arg(long, value_name = "N", default_value_t = 10_000)]
    pub max_sessions: usize,
}

/// What can be done with the token file.
#[derive(Subcommand)]
pub enum Token {
    /// Make a token and print it, once: only its SHA-256 is kept
    Create {
        /// Who it is for: jobs and workers carry this name
        #[arg(long)]
        name: String,
        /// What it may do: view, submit, work, admin
        #[arg(long, value_name = "ROLES", value_delimiter = ',', required = true)]
        role: Vec<Role>,
        #[command(flatten)]
        file: TokenFile,
    },
    /// List who has access
    List {
        #[command(flatten)]
        file: TokenFile,
    },
    /// Take someone's access away; running coordinators notice within seconds
    Revoke {
        /// Whose
        name: String,
        #[command(flatten)]
        file: TokenFile,
    },
}

/// Where tokens are kept.
#[derive(Args)]
pub struct TokenFile {
    /// The token file
    #[arg(
        long,
        value_name = "FILE",
        default_value = "picofarm-data/tokens.toml",
        env = "PICOFARM_TOKENS"
    )]
    pub tokens: PathBuf,
}
