//! Log lines on stderr, written by a thread of their own.
//!
//! The reader of stderr may stop reading, and a full pipe would block every thread that logs. Lines
//! therefore wait in a bounded queue. A line that does not fit is dropped and counted, and the next
//! line that fits is preceded by the number of dropped lines.

use std::{
    collections::VecDeque,
    io::{self, Write},
    sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant},
};

/// Maximum size of the queue, in bytes.
const ROOM: usize = 4 << 20;
/// Time limit for writing the last lines when the program ends.
const LAST_LINES: Duration = Duration::from_secs(1);

/// Accepts log lines, one per call, and never blocks.
#[derive(Clone)]
pub struct LogLines(Arc<Shared>);

/// On drop, writes the queued lines, unless nobody reads them.
pub struct Flush(LogLines);

#[derive(Default)]
struct Shared {
    queue: Mutex<Queue>,
    changed: Condvar,
}

#[derive(Default)]
struct Queue {
    lines: VecDeque<Vec<u8>>,
    /// Size of the queued lines and of those being written, in bytes.
    bytes: usize,
    /// Number of lines dropped since the last line that fitted.
    dropped: u64,
    writing: bool,
}

impl Queue {
    fn push(&mut self, line: Vec<u8>) {
        self.bytes += line.len();
        self.lines.push_back(line);
    }

    /// Queues a line, or counts it as dropped.
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
            // If stderr is closed or full, there is no place to report it.
            let _ = to.write_all(&lines).and_then(|()| to.flush());
            queue = self.lock();
            queue.writing = false;
            queue.bytes -= lines.len();
            self.changed.notify_all();
        }
    }
}

impl LogLines {
    /// Starts a thread that writes log lines to `to`.
    ///
    /// # Errors
    /// Fails if the system cannot start a thread.
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

    /// Writer that accepts one piece for each `()` that it receives.
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
