//! The socket of a Python process, and threads that read from it and from the process's output.

use std::{
    collections::BTreeMap,
    io::{BufRead, BufReader, ErrorKind, Read, Write},
    net::Shutdown,
    os::unix::net::{UnixListener, UnixStream},
    path::Path,
    sync::mpsc::SyncSender,
    thread,
    time::Duration,
};

use serde_json::Value;

use super::message::MESSAGE_BYTES;

/// Most connections of the processes of a task at a time.
const CONNECTIONS: usize = 64;
/// Most bytes of a line of output; the rest is left out.
const OUTPUT_LINE: usize = 4096;

/// How long an answer may wait for a process that does not read.
const ANSWER_WITHIN: Duration = Duration::from_secs(30);

/// What the threads hear.
#[derive(Debug)]
pub(super) enum Event {
    /// A line on a connection.
    Message(usize, Vec<u8>),
    /// A connection has ended.
    Closed(usize),
    /// A message is too long.
    Flood,
    /// A line of output.
    Output(String),
    /// One of the process's outputs ended.
    OutputEnded,
}

/// The socket and its connections.
pub(super) struct Channel {
    listener: UnixListener,
    connections: BTreeMap<usize, UnixStream>,
    /// Number of connections so far.
    begun: usize,
    sender: SyncSender<Event>,
}

impl Channel {
    /// Opens the socket of the task in a folder.
    pub(super) fn open(folder: &Path, sender: SyncSender<Event>) -> std::io::Result<Self> {
        let listener = UnixListener::bind(folder.join("socket"))?;
        listener.set_nonblocking(true)?;
        Ok(Self {
            listener,
            connections: BTreeMap::new(),
            begun: 0,
            sender,
        })
    }

    /// Accepts waiting connections. Further ones than [`CONNECTIONS`] are closed.
    pub(super) fn accept(&mut self) -> std::io::Result<()> {
        loop {
            let stream = match self.listener.accept() {
                Ok((stream, _)) => stream,
                Err(e) if e.kind() == ErrorKind::WouldBlock => return Ok(()),
                Err(e) if e.kind() == ErrorKind::Interrupted => continue,
                Err(e) => return Err(e),
            };
            if self.connections.len() >= CONNECTIONS {
                continue;
            }
            stream.set_nonblocking(false)?;
            stream.set_write_timeout(Some(ANSWER_WITHIN))?;
            let (reader, sender) = (stream.try_clone()?, self.sender.clone());
            let number = self.begun;
            self.begun += 1;
            self.connections.insert(number, stream);
            thread::Builder::new()
                .name("python-socket".into())
                .spawn(move || read_messages(reader, number, &sender))?;
        }
    }

    /// Answers on a connection. One that does not take the answer is closed.
    pub(super) fn answer(&mut self, number: usize, answer: &Value) {
        let text = format!("{answer}\n");
        let stream = self.connections.get_mut(&number);
        if stream.is_some_and(|stream| stream.write_all(text.as_bytes()).is_err()) {
            self.forget(number);
        }
    }

    /// Closes a connection.
    pub(super) fn forget(&mut self, number: usize) {
        if let Some(stream) = self.connections.remove(&number) {
            // It may be closed already.
            let _ = stream.shutdown(Shutdown::Both);
        }
    }

    /// Closes all connections. The supervisor then ends the task's processes.
    pub(super) fn close(&mut self) {
        for stream in self.connections.values() {
            // It may be closed already.
            let _ = stream.shutdown(Shutdown::Both);
        }
    }
}

impl Drop for Channel {
    fn drop(&mut self) {
        self.close();
    }
}

/// Sends each line of a connection, and then its end.
fn read_messages(stream: UnixStream, number: usize, sender: &SyncSender<Event>) {
    let mut reader = BufReader::new(stream);
    loop {
        let mut line = Vec::new();
        let read = reader
            .by_ref()
            .take(MESSAGE_BYTES)
            .read_until(b'\n', &mut line);
        let event = match read {
            Ok(_) if line.last() == Some(&b'\n') => Event::Message(number, line),
            Ok(n) if n as u64 == MESSAGE_BYTES => Event::Flood,
            // Also half a message, after which the process ended.
            Ok(_) | Err(_) => Event::Closed(number),
        };
        let goes_on = matches!(event, Event::Message(..));
        if sender.send(event).is_err() || !goes_on {
            return;
        }
    }
}

/// Starts a thread that reads lines of output. Of a line that is written over by carriage returns
/// it keeps the last state.
pub(super) fn read_output(
    output: impl Read + Send + 'static,
    sender: SyncSender<Event>,
) -> std::io::Result<()> {
    let reading = move || {
        let mut reader = BufReader::new(output);
        while let Some(line) = output_line(&mut reader) {
            if sender.send(Event::Output(line)).is_err() {
                return;
            }
        }
        // The worker has given up if nobody hears it.
        let _ = sender.send(Event::OutputEnded);
    };
    thread::Builder::new()
        .name("python-output".into())
        .spawn(reading)
        .map(|_| ())
}

fn output_line(reader: &mut impl BufRead) -> Option<String> {
    let mut line = Vec::new();
    let mut any = false;
    loop {
        let (used, ended) = {
            let there = match reader.fill_buf() {
                Ok(there) => there,
                Err(e) if e.kind() == ErrorKind::Interrupted => continue,
                Err(_) => return None,
            };
            if there.is_empty() {
                break;
            }
            any = true;
            let end = there.iter().position(|b| matches!(b, b'\n' | b'\r'));
            let part = &there[..end.unwrap_or(there.len())];
            let room = OUTPUT_LINE.saturating_sub(line.len());
            line.extend_from_slice(&part[..part.len().min(room)]);
            let mark = end.map(|at| there[at]);
            // A line with `\r\n` ends at `\n`.
            if mark == Some(b'\r') && there.get(end.unwrap_or(0) + 1) != Some(&b'\n') {
                line.clear();
            }
            (end.map_or(there.len(), |at| at + 1), mark == Some(b'\n'))
        };
        reader.consume(used);
        if ended {
            break;
        }
    }
    any.then(|| String::from_utf8_lossy(&line).into_owned())
}
