//! Options for access to a coordinator and its limits.

use std::{path::PathBuf, time::SystemTime};

use clap::{Args, Subcommand};
use picofarm_coordinator::auth::{Expiry, Role, Visibility};

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
    #[arg(long, value_name = "N", default_value_t = 1_000, value_parser = super::ranges::at_least_one)]
    pub max_jobs_per_user: usize,
    /// Priorities beyond this, above or below 0, are an administrator's
    #[arg(long, value_name = "N", default_value_t = 100)]
    pub max_priority: u32,
    /// What callers see of others' jobs: all, those of their projects (project), or nothing (own);
    /// administrators see all
    #[arg(
        long,
        value_name = "WHAT",
        default_value_t = Visibility::All,
        env = "PICOFARM_VISIBILITY"
    )]
    pub visibility: Visibility,
    /// Keep lines of the audit log (see `picofarm audit`) this many days
    #[arg(long, value_name = "DAYS", default_value_t = 365)]
    pub audit_days: u32,
    /// Tasks of one job, at most
    #[arg(long, value_name = "N", default_value_t = 10_000_000, value_parser = clap::value_parser!(u64).range(1..))]
    pub max_tasks_per_job: u64,
    /// Workers connected at a time, at most
    #[arg(long, value_name = "N", default_value_t = 10_000, value_parser = super::ranges::at_least_one)]
    pub max_sessions: usize,
    /// Connections at a time, at most; never more than the limit of open files allows
    #[arg(long, value_name = "N", default_value_t = 20_000, value_parser = super::ranges::at_least_one)]
    pub max_connections: usize,
    /// Connections of one address at a time, at most; of IPv6, one /64 network [default: three
    /// quarters of all]
    #[arg(long, value_name = "N", value_parser = super::ranges::at_least_one)]
    pub max_connections_per_address: Option<usize>,
    /// Memory that this process may use, MiB: what requests, jobs and connections may take follows
    /// from it [default: the limit of its control group or of the machine, 4096 at most]
    #[arg(long, value_name = "MIB", value_parser = clap::value_parser!(u64).range(128..=1 << 30), env = "PICOFARM_MEMORY_MIB")]
    pub memory_mib: Option<u64>,
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
        /// Projects that it may name in its jobs (`project = "NAME"`)
        #[arg(long, value_name = "PROJECTS", value_delimiter = ',')]
        member: Vec<String>,
        /// Projects all of whose jobs it may cancel, pause, resume and retry
        #[arg(long, value_name = "PROJECTS", value_delimiter = ',')]
        maintainer: Vec<String>,
        /// When it expires: a time from now (90d, 12h), a date (2027-03-01, its beginning in UTC),
        /// or e.g. 2027-03-01T08:00:00Z [default: never]
        #[arg(long, value_name = "TIME", value_parser = expiry)]
        expires: Option<Expiry>,
        #[command(flatten)]
        file: TokenFile,
    },
    /// List who has access, and until when
    List {
        #[command(flatten)]
        file: TokenFile,
    },
    /// Take someone's access away, and ask the coordinators that --coordinator names whether they
    /// refuse it now
    Revoke {
        /// Whose
        name: String,
        #[command(flatten)]
        file: TokenFile,
    },
}

fn expiry(text: &str) -> Result<Expiry, String> {
    Expiry::parse(text, SystemTime::now())
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

/// Which part of the audit log.
#[derive(Args)]
pub struct Audit {
    /// Only acts of this caller
    #[arg(long, value_name = "NAME")]
    pub who: Option<String>,
    /// Only acts on this job: its whole id, as in the log; it may be forgotten by now
    #[arg(long, value_name = "ID")]
    pub job: Option<String>,
    /// Only the last N lines
    #[arg(long, default_value_t = 100, value_name = "N")]
    pub last: u32,
}
