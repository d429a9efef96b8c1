//! Arguments of `web`.

use std::{net::SocketAddr, path::PathBuf};

use clap::Args;

/// Address of the pages, where none is given.
pub const WEB: &str = "127.0.0.1:7421";

#[derive(Args)]
pub struct Web {
    /// Address to listen on (port 0 = any free port; the link is printed)
    #[arg(long, default_value = WEB, value_name = "ADDR")]
    pub listen: SocketAddr,
    /// Store, data set or render to show; may be repeated. No other folder is read
    #[arg(long, value_name = "PATH_OR_URL", value_parser = crate::args::location::parse)]
    pub store: Vec<String>,
    /// Name under which browsers on other machines reach this server, without a port; required if
    /// --listen is not a loopback address; may be repeated
    #[arg(long, value_name = "NAME")]
    pub host: Vec<String>,
    /// Certificate chain (PEM) with which browsers are answered; required if --listen is not a
    /// loopback address
    #[arg(long, value_name = "FILE", requires = "tls_key")]
    pub tls_cert: Option<PathBuf>,
    /// Private key (PEM) of --tls-cert
    #[arg(long, value_name = "FILE", requires = "tls_cert")]
    pub tls_key: Option<PathBuf>,
    /// Answer other machines without encryption: whoever sees the traffic has your rights
    #[arg(long, conflicts_with = "tls_cert")]
    pub allow_insecure: bool,
}
