//! Options for access to a coordinator and its limits.

use std::{path::PathBuf, time::SystemTime};

use clap::{Args, Subcommand};
use picofarm_coordinator::auth::{Expiry, OwnCode, Role, Visibility};

/// TLS, tokens and limits of a coordinator.
#[derive(Args)]
pub struct Guard {
    /// Certificate (PEM) of this coordinator; clients and workers then use https://
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
    /// Require client certificates that one of these authorities (PEM) signed
    #[arg(
        long,
        value_name = "FILE",
        requires = "tls_cert",
        env = "PICOFARM_CLIENT_CA"
    )]
    pub client_ca: Option<PathBuf>,
    /// File with tokens and their roles (see `picofarm token`), read again when it changes
    #[arg(long, value_name = "FILE", env = "PICOFARM_TOKENS")]
    pub tokens: Option<PathBuf>,
    /// Allow to run without TLS or tokens where they are required
    #[arg(long)]
    pub allow_insecure: bool,
    /// Accept jobs with Python code of their own (kind = "python"), from everyone (all) or in these
    /// projects. Workers with --python run the code as their own user [default: from nobody]
    #[arg(long, value_name = "all|PROJECTS", env = "PICOFARM_ALLOW_PYTHON")]
    pub allow_python: Option<OwnCode>,
    /// Maximum number of active jobs of one caller
    #[arg(long, value_name = "N", default_value_t = 1_000, value_parser = super::ranges::at_least_one)]
    pub max_jobs_per_user: usize,
    /// Maximum number of cores that the jobs of one caller use at a time, counting whole workers;
    /// `max_cores` of a caller in the token file goes before it. Each coordinator counts its own
    /// workers [default: any number]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    pub max_cores_per_user: Option<u32>,
    /// Maximum number of bytes that the jobs of one caller publish, e.g. 2TB; `max_bytes` of a
    /// caller in the token file goes before it. Deleted results count too (see `picofarm usage`)
    /// [default: any number]
    #[arg(long, value_name = "SIZE", value_parser = super::ranges::bytes)]
    pub max_bytes_per_user: Option<u64>,
    /// Maximum priority, above or below 0, without the role of an administrator
    #[arg(long, value_name = "N", default_value_t = 100)]
    pub max_priority: u32,
    /// Jobs of others that callers see: all, those of their projects (project), or none (own);
    /// administrators see all
    #[arg(
        long,
        value_name = "WHAT",
        default_value_t = Visibility::All,
        env = "PICOFARM_VISIBILITY"
    )]
    pub visibility: Visibility,
    /// Days to keep entries of the audit log (see `picofarm audit`)
    #[arg(long, value_name = "DAYS", default_value_t = 365)]
    pub audit_days: u32,
    /// Maximum number of tasks of one job
    #[arg(long, value_name = "N", default_value_t = 10_000_000, value_parser = clap::value_parser!(u64).range(1..))]
    pub max_tasks_per_job: u64,
    /// Maximum number of workers connected at a time
    #[arg(long, value_name = "N", default_value_t = 10_000, value_parser = super::ranges::at_least_one)]
    pub max_sessions: usize,
    /// Maximum number of connections at a time; fewer if the limit of open files is lower
    #[arg(long, value_name = "N", default_value_t = 20_000, value_parser = super::ranges::at_least_one)]
    pub max_connections: usize,
    /// Maximum number of connections of one address, or of one /64 network of IPv6, at a time
    /// [default: three quarters of all]
    #[arg(long, value_name = "N", value_parser = super::ranges::at_least_one)]
    pub max_connections_per_address: Option<usize>,
    /// Memory that this process may use, MiB; it bounds requests, jobs and connections [default:
    /// the limit of its control group or machine, 4096 at most]
    #[arg(long, value_name = "MIB", value_parser = clap::value_parser!(u64).range(128..=1 << 30), env = "PICOFARM_MEMORY_MIB")]
    pub memory_mib: Option<u64>,
}

/// What can be done with the token file.
#[derive(Subcommand)]
pub enum Token {
    /// Create a token and print it once; the file keeps only its SHA-256
    Create {
        /// Name of the owner, which jobs and workers carry
        #[arg(long)]
        name: String,
        /// Roles: view, submit, work, admin
        #[arg(long, value_name = "ROLES", value_delimiter = ',', required = true)]
        role: Vec<Role>,
        /// Projects that its jobs may name (`project = "NAME"`)
        #[arg(long, value_name = "PROJECTS", value_delimiter = ',')]
        member: Vec<String>,
        /// Projects in which it may cancel, pause, resume and retry all jobs
        #[arg(long, value_name = "PROJECTS", value_delimiter = ',')]
        maintainer: Vec<String>,
        /// Expiry: a time from now (90d, 12h), a date (its beginning in UTC), or e.g.
        /// 2027-03-01T08:00:00Z [default: never]
        #[arg(long, value_name = "TIME", value_parser = expiry)]
        expires: Option<Expiry>,
        /// Maximum number of cores that its jobs use at a time, instead of the coordinator's
        /// --max-cores-per-user [default: that one]
        #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
        max_cores: Option<u32>,
        /// Maximum number of bytes that its jobs publish, e.g. 2TB, instead of the coordinator's
        /// --max-bytes-per-user [default: that one]
        #[arg(long, value_name = "SIZE", value_parser = super::ranges::bytes)]
        max_bytes: Option<u64>,
        #[command(flatten)]
        file: TokenFile,
    },
    /// List names, roles and expiry
    List {
        #[command(flatten)]
        file: TokenFile,
    },
    /// Remove a token, and ask each coordinator in --coordinator whether it refuses it now
    Revoke {
        /// Name of the token
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
    /// Only entries of this caller
    #[arg(long, value_name = "NAME")]
    pub who: Option<String>,
    /// Only entries of this job, by its whole id
    #[arg(long, value_name = "ID")]
    pub job: Option<String>,
    /// Only the last N lines
    #[arg(long, default_value_t = 100, value_name = "N")]
    pub last: u32,
}
