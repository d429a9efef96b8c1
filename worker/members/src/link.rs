//! The connection between the leading process and another one: messages in both directions, and a
//! keepalive every other second.

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

/// Interval between keepalives.
const BEAT: Duration = Duration::from_secs(2);
/// After this time without a message, the other process is lost.
const SILENCE: Duration = Duration::from_secs(20);

/// An event of a link.
#[derive(Debug)]
pub enum LinkEvent {
    /// A message, and the bytes after it.
    Message(Message, Vec<u8>),
    /// The other process is lost.
    Lost,
}

/// A connection with another process.
pub struct Link {
    /// Id of the link.
    pub id: u64,
    out: Arc<Mutex<TcpStream>>,
    stream: TcpStream,
    over: Arc<AtomicBool>,
}

impl Link {
    /// Opens a link. Its events are sent to `events`. If the other process is lost, `breaker`
    /// aborts the current all-reduce.
    pub fn open(
        id: u64,
        stream: TcpStream,
        events: Sender<(u64, LinkEvent)>,
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
                            // A process in an all-reduce would wait for data that never arrives.
                            if matches!(message, Message::Where | Message::Failed { .. }) {
                                breaker.break_off();
                            }
                            if events
                                .send((id, LinkEvent::Message(message, payload)))
                                .is_err()
                            {
                                return;
                            }
                        }
                        Err(error) => {
                            if !theirs.swap(true, Ordering::SeqCst) {
                                debug!(%error, "a process of the training is lost");
                            }
                            breaker.break_off();
                            let _ = events.send((id, LinkEvent::Lost));
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

    /// Sends a message. Returns `false` if the other process is lost.
    pub fn say(&self, message: &Message, payload: &[u8]) -> bool {
        let mut to = self.out.lock().unwrap_or_else(PoisonError::into_inner);
        let sent = send(&mut *to, message, payload).is_ok();
        if !sent {
            // The reading thread notices this.
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
