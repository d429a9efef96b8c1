//! A TCP proxy that fails when asked to: cut its connections, or hold back what passes.

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

/// How it behaves.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u8)]
pub enum Mode {
    /// Everything passes at once.
    Pass = 0,
    /// Nothing passes, in either direction; connections stay open, as in a partition.
    Hold = 1,
    /// Each piece passes a while later.
    Delay = 2,
}

/// The proxy; it lives until the process ends.
pub struct Proxy {
    /// Where it listens.
    pub address: SocketAddr,
    state: Arc<State>,
}

struct State {
    mode: AtomicU8,
    /// Connections of an earlier number are cut.
    generation: AtomicU64,
}

impl Proxy {
    /// A proxy before `target`.
    ///
    /// # Panics
    /// When no port is free.
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
                // Where nobody listens, the client is let go at once.
                if let Ok(server) = TcpStream::connect(target) {
                    join(client, server, &shared);
                }
            }
        });
        Self { address, state }
    }

    /// How it behaves from now on.
    pub fn set(&self, mode: Mode) {
        self.state.mode.store(mode as u8, SeqCst);
    }

    /// Cuts all connections; new ones are welcome.
    pub fn cut(&self) {
        self.state.generation.fetch_add(1, SeqCst);
    }

    /// Its URL.
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
            // Both directions end together; they may be over already.
            let _ = from.shutdown(Shutdown::Both);
            let _ = to.shutdown(Shutdown::Both);
        });
    }
}

fn pass(mut from: &TcpStream, mut to: &TcpStream, state: &State, generation: u64) {
    let cut = || state.generation.load(SeqCst) != generation;
    // A timeout, so that a cut is noticed on a silent connection.
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
