//! The listening socket of a process: it authenticates incoming connections and passes them on.

use std::{
    io,
    net::{Shutdown, TcpListener, TcpStream, ToSocketAddrs},
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicUsize, Ordering},
        mpsc::{Receiver, Sender, channel},
    },
    thread,
    time::Duration,
};

use subtle::ConstantTimeEq;
use tracing::{debug, warn};
use uuid::Uuid;

use crate::message::{Address, Message, Payload, Wish, receive, send};

/// Timeout for the introduction of a connection and its answer.
const INTRODUCTION: Duration = Duration::from_secs(10);
/// Maximum number of concurrent unauthenticated connections.
const MOST_UNIDENTIFIED: usize = 64;

/// An authenticated connection.
pub struct Arrived {
    pub wish: Wish,
    pub stream: TcpStream,
}

/// A listening process.
pub struct Endpoint {
    address: Address,
    leads: Arc<AtomicBool>,
    closed: Arc<AtomicBool>,
    arrived: Receiver<Arrived>,
    local: std::net::SocketAddr,
}

impl Endpoint {
    /// Listens on a host, at a free port if none is given.
    pub fn open(host: &str, training: &str) -> io::Result<Self> {
        let (name, port) = match host.rsplit_once(':') {
            Some((name, port)) if !name.contains(':') || name.ends_with(']') => {
                let port: u16 = port.parse().map_err(io::Error::other)?;
                (name.trim_matches(['[', ']']), port)
            }
            _ => (host.trim_matches(['[', ']']), 0),
        };
        let addresses: Vec<_> = (name, port).to_socket_addrs()?.collect();
        let listener = TcpListener::bind(&addresses[..])?;
        let local = listener.local_addr()?;
        let port = local.port();
        let address = match name.contains(':') {
            true => format!("[{name}]:{port}"),
            false => format!("{name}:{port}"),
        };
        let address = Address {
            address,
            secret: format!("{}{}", Uuid::new_v4().simple(), Uuid::new_v4().simple()),
        };
        let (outbox, arrived) = channel();
        let closed = Arc::new(AtomicBool::new(false));
        let leads = Arc::new(AtomicBool::new(false));
        let acceptor = Arc::new(Acceptor {
            secret: address.secret.clone(),
            training: training.to_owned(),
            leads: leads.clone(),
            closed: closed.clone(),
            unidentified: AtomicUsize::new(0),
            outbox,
        });
        thread::Builder::new()
            .name("members".into())
            .spawn(move || acceptor.serve(&listener))?;
        Ok(Self {
            address,
            leads,
            closed,
            arrived,
            local,
        })
    }

    /// Returns the address at which others reach it.
    pub fn address(&self) -> &Address {
        &self.address
    }

    /// Sets whether processes that want to take part are accepted from now on.
    pub fn lead(&self, leads: bool) {
        self.leads.store(leads, Ordering::SeqCst);
    }

    /// Returns the next connection that has arrived.
    pub fn arrived(&self) -> Option<Arrived> {
        self.arrived.try_recv().ok()
    }
}

impl Drop for Endpoint {
    fn drop(&mut self) {
        self.closed.store(true, Ordering::SeqCst);
        // Wakes the accepting thread.
        let _ = TcpStream::connect_timeout(&self.local, Duration::from_secs(1));
    }
}

struct Acceptor {
    secret: String,
    training: String,
    leads: Arc<AtomicBool>,
    closed: Arc<AtomicBool>,
    unidentified: AtomicUsize,
    outbox: Sender<Arrived>,
}

impl Acceptor {
    fn serve(self: &Arc<Self>, listener: &TcpListener) {
        for stream in listener.incoming() {
            if self.closed.load(Ordering::SeqCst) {
                return;
            }
            let stream = match stream {
                Ok(stream) => stream,
                Err(error) => {
                    warn!(%error, "a connection of another process of the training is not taken");
                    thread::sleep(Duration::from_millis(100));
                    continue;
                }
            };
            if self.unidentified.fetch_add(1, Ordering::SeqCst) >= MOST_UNIDENTIFIED {
                self.unidentified.fetch_sub(1, Ordering::SeqCst);
                let _ = stream.shutdown(Shutdown::Both);
                continue;
            }
            let acceptor = self.clone();
            let begun = thread::Builder::new().spawn(move || {
                if let Err(error) = acceptor.ask(stream) {
                    debug!(%error, "a connection is closed before it says what it wants");
                }
                acceptor.unidentified.fetch_sub(1, Ordering::SeqCst);
            });
            if begun.is_err() {
                self.unidentified.fetch_sub(1, Ordering::SeqCst);
            }
        }
    }

    /// Authenticates a connection, and passes it on.
    fn ask(&self, mut stream: TcpStream) -> io::Result<()> {
        stream.set_nodelay(true)?;
        stream.set_read_timeout(Some(INTRODUCTION))?;
        stream.set_write_timeout(Some(INTRODUCTION))?;
        let (
            Message::Hello {
                secret,
                training,
                wish,
            },
            _,
        ) = receive(&mut stream, Payload::None)?
        else {
            return Err(io::Error::other("no greeting"));
        };
        if !bool::from(secret.as_bytes().ct_eq(self.secret.as_bytes())) {
            return Err(io::Error::other("another secret"));
        }
        let why = if training != self.training {
            Some("another training")
        } else if matches!(wish, Wish::Join(_)) && !self.leads.load(Ordering::SeqCst) {
            Some("this process does not lead")
        } else {
            None
        };
        if let Some(why) = why {
            let why = why.to_owned();
            return send(&mut stream, &Message::Refused { why }, &[]);
        }
        send(&mut stream, &Message::Welcome, &[])?;
        let _ = self.outbox.send(Arrived { wish, stream });
        Ok(())
    }
}

/// Connects to another process.
pub fn visit(to: &Address, training: &str, wish: Wish) -> io::Result<TcpStream> {
    let mut last = io::Error::other(format!("{} has no address", to.address));
    for address in to.address.to_socket_addrs()? {
        match TcpStream::connect_timeout(&address, INTRODUCTION / 2) {
            Ok(mut stream) => {
                stream.set_nodelay(true)?;
                stream.set_read_timeout(Some(INTRODUCTION))?;
                stream.set_write_timeout(Some(INTRODUCTION))?;
                let hello = Message::Hello {
                    secret: to.secret.clone(),
                    training: training.to_owned(),
                    wish,
                };
                send(&mut stream, &hello, &[])?;
                return match receive(&mut stream, Payload::None)? {
                    (Message::Welcome, _) => Ok(stream),
                    (Message::Refused { why }, _) => Err(io::Error::other(why)),
                    _ => Err(io::Error::other("no answer to a greeting")),
                };
            }
            Err(error) => last = error,
        }
    }
    Err(last)
}
