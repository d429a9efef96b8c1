//! Turns accepted sockets into connections: assigns a place to each, begins TLS if required, and
//! ends silent ones.

use std::{
    future::Future,
    io,
    net::SocketAddr,
    pin::Pin,
    sync::Arc,
    task::{Context, Poll, ready},
    time::Duration,
};

use rustls::pki_types::CertificateDer;
use tokio::{
    io::{AsyncRead, AsyncWrite, ReadBuf},
    net::{TcpListener, TcpStream},
    sync::{mpsc, watch},
};
use tokio_rustls::{TlsAcceptor, server::TlsStream};
use tokio_stream::wrappers::ReceiverStream;
use tokio_util::sync::CancellationToken;
use tonic::transport::server::Connected;

use super::{
    bounds::Connections,
    slots::{ConnectionSlot, ConnectionSlots, HeldSlot},
    watched::Certificates,
};
use crate::auth::Throttle;

/// Time limit of a TLS handshake.
const HANDSHAKE: Duration = Duration::from_secs(10);
/// Delay after the system returned no connection (no file handles, no memory), so that others can
/// end.
const PAUSE: Duration = Duration::from_millis(100);
/// Connections that may wait for the server.
const READY: usize = 64;

/// Returns the connections of a listener, until `stop`. `tls` contains the current certificates.
pub(crate) fn accept(
    listener: TcpListener,
    slots: Arc<ConnectionSlots>,
    bounds: Connections,
    tls: Option<watch::Receiver<Certificates>>,
    stop: CancellationToken,
) -> ReceiverStream<Result<Connection, io::Error>> {
    let (ready, connections) = mpsc::channel(READY);
    tokio::spawn(async move {
        let (full, failed) = (Throttle::default(), Throttle::default());
        loop {
            let accepted = tokio::select! {
                accepted = listener.accept() => accepted,
                () = stop.cancelled() => return,
                () = ready.closed() => return,
            };
            let (stream, address) = match accepted {
                Ok(accepted) => accepted,
                Err(error) => {
                    if let Some(unsaid) = failed.allows() {
                        tracing::warn!(%error, unsaid, "no connection can be accepted");
                    }
                    tokio::time::sleep(PAUSE).await;
                    continue;
                }
            };
            loop {
                let wait = slots.patience();
                if wait.is_zero() {
                    break;
                }
                tokio::time::sleep(wait).await;
            }
            let held = match slots.enter(address.ip()) {
                Ok(held) => held,
                Err(why) => {
                    if let Some(unsaid) = full.allows() {
                        tracing::warn!(peer = %address, ?why, unsaid, "a connection is refused: there are too many");
                    }
                    continue;
                }
            };
            // Small messages are not delayed. The socket works even if this option fails.
            let _ = stream.set_nodelay(true);
            let tls = tls.as_ref().map(|tls| tls.borrow().clone());
            let ready = ready.clone();
            tokio::spawn(async move {
                if let Some(connection) =
                    Connection::begin(stream, address, held, bounds, tls).await
                {
                    // The server is gone if it is stopping.
                    let _ = ready.send(Ok(connection)).await;
                }
            });
        }
    });
    ReceiverStream::new(connections)
}

enum Io {
    Plain(TcpStream),
    Tls(Box<TlsStream<TcpStream>>),
}

/// A connection with its place. Reading from it fails when it must end.
pub(crate) struct Connection {
    io: Io,
    address: SocketAddr,
    /// Number of changes of the client certificate authorities when the connection began.
    authorities: u64,
    held: HeldSlot,
    over: Option<Pin<Box<dyn Future<Output = &'static str> + Send>>>,
}

/// The information about a connection for handlers.
#[derive(Clone)]
pub(crate) struct Peer {
    /// The remote address.
    pub address: SocketAddr,
    /// The client's verified certificate chain.
    pub certificates: Option<Arc<Vec<CertificateDer<'static>>>>,
    /// Number of changes of the client certificate authorities when the connection began.
    pub authorities: u64,
    pub(super) slot: Arc<ConnectionSlot>,
}

impl Peer {
    /// Returns the place of the connection.
    pub(crate) fn slot(&self) -> Arc<ConnectionSlot> {
        Arc::clone(&self.slot)
    }
}

impl Connection {
    /// Begins a connection. Returns `None` if the TLS handshake did not complete in time.
    async fn begin(
        stream: TcpStream,
        address: SocketAddr,
        held: HeldSlot,
        bounds: Connections,
        tls: Option<Certificates>,
    ) -> Option<Self> {
        let authorities = tls.as_ref().map_or(0, |tls| tls.authorities);
        let ended = Arc::clone(held.slot()).ended(bounds.first_request, bounds.idle);
        let mut over: Pin<Box<dyn Future<Output = _> + Send>> = Box::pin(ended);
        let io = match tls {
            None => Io::Plain(stream),
            Some(Certificates { config, .. }) => tokio::select! {
                shaken = tokio::time::timeout(HANDSHAKE, TlsAcceptor::from(config).accept(stream)) => match shaken {
                    Ok(Ok(stream)) => Io::Tls(Box::new(stream)),
                    Ok(Err(error)) => {
                        tracing::debug!(peer = %address, %error, "no TLS");
                        return None;
                    }
                    Err(_) => {
                        tracing::debug!(peer = %address, "the TLS handshake took too long");
                        return None;
                    }
                },
                why = &mut over => {
                    tracing::debug!(peer = %address, why, "a connection is closed");
                    return None;
                }
            },
        };
        Some(Self {
            io,
            address,
            authorities,
            held,
            over: Some(over),
        })
    }

    /// Fails if the connection must end.
    fn poll_over(&mut self, context: &mut Context<'_>) -> io::Result<()> {
        if let Some(over) = &mut self.over {
            let Poll::Ready(why) = over.as_mut().poll(context) else {
                return Ok(());
            };
            tracing::debug!(peer = %self.address, why, "a connection is closed");
            self.over = None;
        }
        Err(io::ErrorKind::TimedOut.into())
    }
}

impl Connected for Connection {
    type ConnectInfo = Peer;

    fn connect_info(&self) -> Peer {
        let certificates = match &self.io {
            Io::Plain(_) => None,
            Io::Tls(stream) => {
                let chain = stream.get_ref().1.peer_certificates();
                chain.map(|chain| Arc::new(chain.to_vec()))
            }
        };
        Peer {
            address: self.address,
            certificates,
            authorities: self.authorities,
            slot: Arc::clone(self.held.slot()),
        }
    }
}

impl AsyncRead for Connection {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        self.poll_over(context)?;
        match &mut self.io {
            Io::Plain(stream) => Pin::new(stream).poll_read(context, buffer),
            Io::Tls(stream) => Pin::new(stream).poll_read(context, buffer),
        }
    }
}

macro_rules! write {
    ($self:ident, $stream:ident => $call:expr) => {
        match &mut $self.io {
            Io::Plain(stream) => {
                let $stream = Pin::new(stream);
                $call
            }
            Io::Tls(stream) => {
                let $stream = Pin::new(stream);
                $call
            }
        }
    };
}

impl AsyncWrite for Connection {
    fn poll_write(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[u8],
    ) -> Poll<io::Result<usize>> {
        write!(self, stream => stream.poll_write(context, bytes))
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        pieces: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        write!(self, stream => stream.poll_write_vectored(context, pieces))
    }

    fn is_write_vectored(&self) -> bool {
        match &self.io {
            Io::Plain(stream) => stream.is_write_vectored(),
            Io::Tls(stream) => stream.is_write_vectored(),
        }
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        write!(self, stream => stream.poll_flush(context))
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        ready!(write!(self, stream => stream.poll_shutdown(context)))?;
        Poll::Ready(Ok(()))
    }
}
