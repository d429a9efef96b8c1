//! Arguments of `web`.

use std::net::SocketAddr;

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
}
