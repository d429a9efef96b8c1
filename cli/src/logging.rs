//! Log lines on stderr, written by a thread of their own.
//!
//! Whoever reads stderr may stop reading: a pipe that is full would hold up every thread that logs.
//! So lines wait in a queue with a bound. A line that finds no room is dropped and counted, and the
//! next line that does says how many were dropped.

use std::{
    collections::VecDeque,
    io::{self, Write},
    sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant},
};

/// Bytes that may wait.
const ROOM: usize = 4 << 20;
/// How long the last lines may take when the program ends.
const LAST_LINES: Duration = Duration::from_secs(1);

/// Takes log lines, one a call, and never blocks.
#[derive(Clone)]
pub struct LogLines(Arc<Shared>);

/// Writes what waits when it is dropped, unless nobody reads.
pub struct Flush(LogLines);

#[derive(Default)]
struct Shared {
    queue: Mutex<Queue>,
    changed: Condvar,
}

#[derive(Default)]
struct Queue {
    lines: VecDeque<Vec<u8>>,
    /// Of the lines, and of those that are being written.
    bytes: usize,
    /// Lines that found no room since the last that did.
    dropped: u64,
    writing: bool,
}

impl Queue {
    fn push(&mut self, line: Vec<u8>) {
        self.bytes += line.len();
        self.lines.push_back(line);
    }

    /// Takes a line, or counts it.
    fn offer(&mut self, line: &[u8]) {
        if self.bytes + line.len() > ROOM {
            self.dropped += 1;
            return;
        }
        self.note_dropped();
        self.push(line.to_vec());
    }

    fn note_dropped(&mut self) {
        if self.dropped > 0 {
            let dropped = std::mem::take(&mut self.dropped);
            let note =
                format!("{dropped} log lines were dropped here, because stderr was not read\n");
            self.push(note.into_bytes());
        }
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, Queue> {
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn write(&self, mut to: impl Write) {
        let mut queue = self.lock();
        loop {
            if queue.lines.is_empty() {
                queue.note_dropped();
            }
            let lines: Vec<u8> = queue.lines.drain(..).flatten().collect();
            if lines.is_empty() {
                queue = self
                    .changed
                    .wait(queue)
                    .unwrap_or_else(PoisonError::into_inner);
                continue;
            }
            queue.writing = true;
            drop(queue);
            // A stderr that is closed or full takes no line that would say so.
            let _ = to.write_all(&lines).and_then(|()| to.flush());
            queue = self.lock();
            queue.writing = false;
            queue.bytes -= lines.len();
            self.changed.notify_all();
        }
    }
}

impl LogLines {
    /// Lines for `to`, which a new thread writes.
    ///
    /// # Errors
    /// The system gives no thread.
    pub fn start(to: impl Write + Send + 'static) -> io::Result<(Self, Flush)> {
        let lines = Self(Arc::default());
        let shared = Arc::clone(&lines.0);
        std::thread::Builder::new()
            .name("log".into())
            .spawn(move || shared.write(to))?;
        let flush = Flush(lines.clone());
        Ok((lines, flush))
    }
}

impl Write for LogLines {
    fn write(&mut self, line: &[u8]) -> io::Result<usize> {
        self.0.lock().offer(line);
        self.0.changed.notify_all();
        Ok(line.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Drop for Flush {
    fn drop(&mut self) {
        let until = Instant::now() + LAST_LINES;
        let mut queue = self.0.0.lock();
        while queue.writing || !queue.lines.is_empty() {
            let left = until.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return;
            }
            let waited = self.0.0.changed.wait_timeout(queue, left);
            queue = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc;

    use super::*;

    /// Takes a piece for each `()` that it is sent.
    struct Slow(mpsc::Receiver<()>, mpsc::Sender<Vec<u8>>);

    impl Write for Slow {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            self.0.recv().map_err(io::Error::other)?;
            self.1.send(bytes.to_vec()).map_err(io::Error::other)?;
            Ok(bytes.len())
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn a_reader_that_stops_reading_stops_nobody_and_is_told_what_it_missed() {
        let (go, gone) = mpsc::channel();
        let (written, read) = mpsc::channel();
        let (mut lines, flush) = LogLines::start(Slow(gone, written)).unwrap();
        let line = [b'x'; 1 << 10];
        for _ in 0..2 * ROOM / line.len() {
            lines.write_all(&line).unwrap();
        }
        assert!(lines.0.lock().bytes <= ROOM);
        for _ in 0..2 {
            go.send(()).unwrap();
        }
        let mut all = read.recv().unwrap();
        all.extend(read.recv().unwrap());
        lines.write_all(b"last\n").unwrap();
        for _ in 0..4 {
            go.send(()).unwrap();
        }
        drop(flush);
        all.extend(read.try_iter().flatten());
        let text = String::from_utf8(all).unwrap();
        assert!(
            text.contains("log lines were dropped here"),
            "{}",
            text.len()
        );
        assert!(text.ends_with("last\n"));
    }
}
