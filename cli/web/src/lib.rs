//! The farm in a browser: jobs, workers and events of a coordinator, pictures of data sets, and
//! light in flight. A server of HTML pages, server-sent events and binary volumes over HTTP/1.1.
//!
//! The server is a client of the coordinator ([`Farm`]) and of the stores: it has no rights and no
//! state of its own. All pages come from this binary, without files from elsewhere.
//!
//! Layers, each of which imports only from those above it: [`guard`](mod@guard) (who may ask),
//! `data` (scenes and volumes of stores), `pages` (HTML), `routes`, `server`.

mod answer;
mod assets;
mod data;
mod farm;
mod guard;
mod history;
mod live;
mod pages;
mod places;
mod query;
mod routes;
mod server;
mod tls;

use std::{net::SocketAddr, sync::Arc};

use picofarm_credentials::CredentialError;
use picofarm_store::StorageError;
use tokio::net::{TcpListener, TcpSocket};
use tokio_util::sync::CancellationToken;

pub use farm::{Events, Explained, Farm, JobFilter, Refusal, Refused, Workers};
pub use guard::is_host;
pub use tls::TlsFiles;

use self::{data::Stores, guard::Guard, history::Histories, live::Feeds, tls::Tls};

/// Most connections that wait to be accepted.
const WAITING: u32 = 1024;

/// What a server shows and to whom.
pub struct Settings {
    /// Address to listen on; port 0 = any free port.
    pub listen: SocketAddr,
    /// Names, without ports, under which browsers may reach the server, besides those of this
    /// machine's loopback interface.
    pub hosts: Vec<String>,
    /// The certificate with which browsers are answered; without one, answers are not encrypted.
    pub tls: Option<TlsFiles>,
    /// Whether other machines may be answered without encryption.
    pub allow_insecure: bool,
    /// Folders and URLs of the stores, data sets and renders to show. No others are read.
    pub stores: Vec<String>,
    /// Whether a coordinator answers at the start. Without one, the pages of data sets have no
    /// links to those of a farm.
    pub farm: bool,
}

/// A server that listens and does not yet answer.
pub struct Server {
    listener: TcpListener,
    address: SocketAddr,
    app: Arc<App>,
}

/// What all requests share.
struct App {
    guard: Guard,
    farm: Arc<dyn Farm>,
    /// Whether the pages of data sets lead to those of the farm.
    linked: bool,
    stores: Stores,
    tls: Option<Tls>,
    feeds: Feeds,
    histories: Histories,
    limits: server::Limits,
    stop: CancellationToken,
}

/// Why a server cannot start.
#[derive(Debug)]
pub enum StartError {
    /// The address cannot be used.
    Listen(SocketAddr, std::io::Error),
    /// The address is reachable from elsewhere, and no name for it was given.
    Open(SocketAddr),
    /// The address is reachable from elsewhere, and no certificate was given.
    Clear(SocketAddr),
    /// The certificate or its key is not usable.
    Certificate(CredentialError),
    /// A store cannot be opened.
    Store(StorageError),
}

impl std::fmt::Debug for Server {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        // Without the key.
        f.debug_struct("Server")
            .field("address", &self.address)
            .finish_non_exhaustive()
    }
}

/// Listens on an address. Tokio's own function lets 128 connections wait to be accepted, so that a
/// flood of more delays others by seconds.
fn open_listener(address: SocketAddr) -> std::io::Result<TcpListener> {
    let socket = match address {
        SocketAddr::V4(_) => TcpSocket::new_v4()?,
        SocketAddr::V6(_) => TcpSocket::new_v6()?,
    };
    // A restarted server may use the address at once.
    #[cfg(unix)]
    socket.set_reuseaddr(true)?;
    socket.bind(address)?;
    socket.listen(WAITING)
}

impl Server {
    /// Listens on the address.
    ///
    /// # Errors
    /// Fails if the address cannot be used, or if a store's URL or the certificate is not usable.
    /// An address that is not of the loopback interface needs a name in `settings.hosts` and a
    /// certificate, unless `settings.allow_insecure`.
    pub async fn bind(settings: Settings, farm: Arc<dyn Farm>) -> Result<Self, StartError> {
        let listen = settings.listen;
        if !listen.ip().is_loopback() && settings.hosts.is_empty() {
            return Err(StartError::Open(listen));
        }
        if !listen.ip().is_loopback() && settings.tls.is_none() && !settings.allow_insecure {
            return Err(StartError::Clear(listen));
        }
        let tls = settings.tls.map(Tls::open).transpose();
        let tls = tls.map_err(StartError::Certificate)?;
        let stores = Stores::open(&settings.stores).map_err(StartError::Store)?;
        let failed = |e| StartError::Listen(listen, e);
        let listener = open_listener(listen).map_err(failed)?;
        let address = listener.local_addr().map_err(failed)?;
        let app = App {
            guard: Guard::new(settings.hosts, tls.is_some()),
            farm,
            linked: settings.farm,
            stores,
            tls,
            feeds: Feeds::default(),
            histories: Histories::default(),
            limits: server::Limits::default(),
            stop: CancellationToken::new(),
        };
        Ok(Self {
            listener,
            address,
            app: Arc::new(app),
        })
    }

    /// Returns the address that it listens on.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Returns the link to `path` for the user who started the server. It contains the key, without
    /// which nothing is answered.
    pub fn link(&self, path: &str) -> String {
        let host = match self.app.guard.first_host() {
            Some(host) if !self.address.ip().is_loopback() || self.app.tls.is_some() => {
                format!("{host}:{}", self.address.port())
            }
            _ => self.address.to_string(),
        };
        let join = if path.contains('?') { '&' } else { '?' };
        let scheme = self.app.guard.scheme();
        format!("{scheme}{host}{path}{join}key={}", self.app.guard.key())
    }

    /// Returns the path of the page that shows light in flight of the first finished scene; `None`
    /// if the stores have none.
    pub async fn first_flight(&self) -> Option<String> {
        let listed = self.app.stores.list().await;
        let set = listed.sets.iter().find(|set| !set.scenes.is_empty())?;
        Some(data::flight_path(&set.id, *set.scenes.first()?))
    }

    /// Returns a line for each store or folder in one that cannot be read: its location and the
    /// reason. The page of the data sets lists them too.
    pub async fn unread(&self) -> Vec<String> {
        let listed = self.app.stores.list().await;
        let lines = listed.unread.iter();
        lines
            .map(|unread| format!("{}: {}", unread.place, unread.why))
            .collect()
    }

    /// Answers requests until `stop`.
    pub async fn serve(self, stop: CancellationToken) {
        server::run(self.listener, self.app, stop).await;
    }
}
