//! A TCP proxy that simulates network failures: it cuts its connections, or delays or withholds
//! data.

use std::{
    io::{ErrorKind, Read, Write},
    net::{Shutdown, SocketAddr, TcpListener, TcpStream},
    sync::{
        Arc,
        atomic::{AtomicU8, AtomicU64, Ordering::SeqCst},
    },
    thread,
    time::Duration,
};

/// Behaviour of the proxy.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Mode {
    /// Data pass at once.
    Pass = 0,
    /// No data pass in either direction, but connections stay open, as in a network partition.
    Hold = 1,
    /// Each piece of data passes after a delay.
    Delay = 2,
}

/// The proxy. It runs until the process ends.
pub struct Proxy {
    /// Address on which it listens.
    pub address: SocketAddr,
    state: Arc<State>,
}

struct State {
    mode: AtomicU8,
    /// Connections with an earlier number are cut.
    generation: AtomicU64,
}

impl Proxy {
    /// Starts a proxy in front of `target`.
    ///
    /// # Panics
    /// If no port is free.
    pub fn before(target: SocketAddr) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").expect("a port is free");
        let address = listener.local_addr().expect("it listens");
        let state = Arc::new(State {
            mode: AtomicU8::new(Mode::Pass as u8),
            generation: AtomicU64::new(0),
        });
        let shared = state.clone();
        thread::spawn(move || {
            for client in listener.incoming().flatten() {
                // If nobody listens, the client's connection is closed at once.
                if let Ok(server) = TcpStream::connect(target) {
                    join(client, server, &shared);
                }
            }
        });
        Self { address, state }
    }

    /// Sets the behaviour from now on.
    pub fn set(&self, mode: Mode) {
        self.state.mode.store(mode as u8, SeqCst);
    }

    /// Cuts all connections, but accepts new ones.
    pub fn cut(&self) {
        self.state.generation.fetch_add(1, SeqCst);
    }

    /// Returns its URL.
    pub fn url(&self) -> String {
        format!("http://{}", self.address)
    }
}

fn join(client: TcpStream, server: TcpStream, state: &Arc<State>) {
    let generation = state.generation.load(SeqCst);
    let (Ok(client2), Ok(server2)) = (client.try_clone(), server.try_clone()) else {
        return;
    };
    for (from, to) in [(client, server), (server2, client2)] {
        let state = state.clone();
        thread::spawn(move || {
            pass(&from, &to, &state, generation);
            // Both directions end together; they may already be closed.
            let _ = from.shutdown(Shutdown::Both);
            let _ = to.shutdown(Shutdown::Both);
        });
    }
}

fn pass(mut from: &TcpStream, mut to: &TcpStream, state: &State, generation: u64) {
    let cut = || state.generation.load(SeqCst) != generation;
    // With a timeout, so that a silent connection notices a cut.
    let _ = from.set_read_timeout(Some(Duration::from_millis(20)));
    let _ = to.set_nodelay(true);
    let mut piece = [0; 16 << 10];
    while !cut() {
        let n = match from.read(&mut piece) {
            Ok(0) => return,
            Ok(n) => n,
            Err(e) if matches!(e.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => continue,
            Err(_) => return,
        };
        if state.mode.load(SeqCst) == Mode::Delay as u8 {
            thread::sleep(Duration::from_millis(150));
        }
        while state.mode.load(SeqCst) == Mode::Hold as u8 {
            if cut() {
                return;
            }
            thread::sleep(Duration::from_millis(10));
        }
        if to.write_all(&piece[..n]).is_err() {
            return;
        }
    }
}
