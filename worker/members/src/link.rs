//! The connection between the leading process and another one: messages both ways, and a sign of life every other second.

use std::{
    io,
    net::{Shutdown, TcpStream},
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicBool, Ordering},
        mpsc::Sender,
    },
    thread,
    time::Duration,
};

use tracing::debug;

use crate::{
    mesh::Breaker,
    message::{Message, Payload, receive, send},
};

/// How often a sign of life is sent.
const BEAT: Duration = Duration::from_secs(2);
/// After so much silence the other one is lost.
const SILENCE: Duration = Duration::from_secs(20);

/// What comes over links.
#[derive(Debug)]
pub enum Heard {
    /// A message, and bytes after it.
    Said(Message, Vec<u8>),
    /// The other one is lost.
    Lost,
}

/// A link.
pub struct Link {
    /// Tells links apart.
    pub id: u64,
    out: Arc<Mutex<TcpStream>>,
    stream: TcpStream,
    over: Arc<AtomicBool>,
}

impl Link {
    /// What comes goes to `heard`; where the other one is lost, what is being added up ends by `breaker`.
    pub fn open(
        id: u64,
        stream: TcpStream,
        heard: Sender<(u64, Heard)>,
        breaker: Arc<Breaker>,
    ) -> io::Result<Self> {
        stream.set_read_timeout(Some(SILENCE))?;
        stream.set_write_timeout(Some(SILENCE))?;
        let over = Arc::new(AtomicBool::new(false));
        let link = Self {
            id,
            out: Arc::new(Mutex::new(stream.try_clone()?)),
            over: over.clone(),
            stream: stream.try_clone()?,
        };
        let mut from = stream;
        let theirs = over.clone();
        thread::Builder::new()
            .name("member link".into())
            .spawn(move || {
                loop {
                    match receive(&mut from, Payload::State) {
                        Ok((Message::Alive, _)) => {}
                        Ok((message, payload)) => {
                            // Whoever adds up would wait for what never comes.
                            if matches!(message, Message::Where | Message::Failed { .. }) {
                                breaker.break_off();
                            }
                            if heard.send((id, Heard::Said(message, payload))).is_err() {
                                return;
                            }
                        }
                        Err(error) => {
                            if !theirs.swap(true, Ordering::SeqCst) {
                                debug!(%error, "a process of the training is lost");
                            }
                            breaker.break_off();
                            let _ = heard.send((id, Heard::Lost));
                            return;
                        }
                    }
                }
            })?;
        let out = link.out.clone();
        thread::Builder::new()
            .name("member beat".into())
            .spawn(move || {
                while !over.load(Ordering::SeqCst) {
                    let mut to = out.lock().unwrap_or_else(PoisonError::into_inner);
                    if send(&mut *to, &Message::Alive, &[]).is_err() {
                        return;
                    }
                    drop(to);
                    thread::sleep(BEAT);
                }
            })?;
        Ok(link)
    }

    /// Sends a message; `false` where the other one is lost.
    pub fn say(&self, message: &Message, payload: &[u8]) -> bool {
        let mut to = self.out.lock().unwrap_or_else(PoisonError::into_inner);
        let sent = send(&mut *to, message, payload).is_ok();
        if !sent {
            // Whoever reads from it hears of it.
            let _ = self.stream.shutdown(Shutdown::Both);
        }
        sent
    }
}

impl Drop for Link {
    fn drop(&mut self) {
        self.over.store(true, Ordering::SeqCst);
        let _ = self.stream.shutdown(Shutdown::Both);
    }
}
