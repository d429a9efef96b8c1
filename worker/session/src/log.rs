//! Forwards tasks' log lines to the coordinator. The threads of a lane's pool work for one task at
//! a time, so all of their lines belong to the running task. [`task_logs`] must be among the
//! layers of the program's subscriber; without it, tasks' lines stay on this machine.

use std::{
    cell::RefCell,
    collections::VecDeque,
    fmt::{Debug, Write},
    sync::{Arc, Mutex, MutexGuard},
    time::Instant,
};

use picofarm_proto::{
    ids::LeaseRef,
    messages::{LogAllowance, LogLevel, LogLine, TaskLog, log::cut},
};
use tracing::{
    Event, Level, Subscriber,
    field::{Field, Visit},
};
use tracing_subscriber::{
    Layer,
    filter::{LevelFilter, Targets},
    layer::Context,
    registry::LookupSpan,
};

/// Targets with lines that are forwarded, from INFO upwards. Those of other libraries are not,
/// because their content is unknown.
const OURS: [&str; 9] = [
    "picofarm_tasks",
    "picofarm_dataset",
    "picofarm_exchange",
    "picofarm_model",
    "picofarm_results",
    "picofarm_scene",
    "picofarm_session",
    "picofarm_store",
    "picofarm_transient",
];
/// Bytes of a task's allowance reserved for the line with the number of omitted lines.
const NOTE_BYTES: usize = 128;
/// Maximum number of messages queued while no coordinator is connected.
const UNSENT: usize = 64;

thread_local! {
    /// The collector of this thread's lines.
    static HERE: RefCell<Option<Arc<Collector>>> = const { RefCell::new(None) };
}

/// Returns the layer that forwards lines of workers' threads to their workers. On other threads, it
/// costs a lookup of a thread-local for each line from INFO upwards.
pub fn task_logs<S>() -> impl Layer<S>
where
    S: Subscriber + for<'a> LookupSpan<'a>,
{
    let ours = OURS.map(|target| (target, LevelFilter::INFO));
    Tap.with_filter(Targets::new().with_targets(ours))
}

struct Tap;

impl<S: Subscriber> Layer<S> for Tap {
    fn on_event(&self, event: &Event<'_>, _: Context<'_, S>) {
        HERE.with_borrow(|here| {
            if let Some(collector) = here {
                collector.add(event);
            }
        });
    }
}

/// A log line.
#[derive(Debug)]
pub(crate) struct TaskLine {
    at: Instant,
    level: LogLevel,
    text: String,
}

/// Collects the lines of one task after another.
#[derive(Default)]
pub(crate) struct Collector(Mutex<LogBuffer>);

#[derive(Default)]
struct LogBuffer {
    allowance: LogAllowance,
    lines: Vec<TaskLine>,
    left_out: u64,
}

impl Collector {
    /// From now on, collects this thread's lines.
    pub(crate) fn serve(self: &Arc<Self>) {
        HERE.with_borrow_mut(|here| *here = Some(self.clone()));
    }

    /// Starts a new task.
    pub(crate) fn begin(&self) {
        let mut buffer = LogBuffer::default();
        let note = buffer.allowance.take(NOTE_BYTES);
        debug_assert!(note, "the note is smaller than the allowance");
        *self.buffer() = buffer;
    }

    /// Returns the lines since the last call.
    pub(crate) fn take(&self) -> Vec<TaskLine> {
        std::mem::take(&mut self.buffer().lines)
    }

    /// Returns the last lines of the task.
    pub(crate) fn end(&self) -> Vec<TaskLine> {
        let mut buffer = self.buffer();
        let mut lines = std::mem::take(&mut buffer.lines);
        match buffer.left_out {
            0 => {}
            n => lines.push(TaskLine {
                at: Instant::now(),
                level: LogLevel::Warn,
                text: format!("{n} further lines are only in the worker's own log"),
            }),
        }
        lines
    }

    fn add(&self, event: &Event<'_>) {
        let mut text = Text::default();
        event.record(&mut text);
        let Text { mut message, rest } = text;
        message.push_str(&rest);
        cut(&mut message);
        let mut buffer = self.buffer();
        if buffer.allowance.take(message.len()) {
            buffer.lines.push(TaskLine {
                at: Instant::now(),
                level: match *event.metadata().level() {
                    Level::ERROR => LogLevel::Error,
                    Level::WARN => LogLevel::Warn,
                    _ => LogLevel::Info,
                },
                text: message,
            });
        } else {
            buffer.left_out += 1;
        }
    }

    fn buffer(&self) -> MutexGuard<'_, LogBuffer> {
        self.0.lock().expect("nothing panics while it is locked")
    }
}

/// An event's message, and its fields as ` name=value`.
#[derive(Default)]
struct Text {
    message: String,
    rest: String,
}

impl Visit for Text {
    fn record_debug(&mut self, field: &Field, value: &dyn Debug) {
        let written = match field.name() {
            "message" => write!(self.message, "{value:?}"),
            name => write!(self.rest, " {name}={value:?}"),
        };
        written.expect("writing to a string");
    }
}

/// Lines that have not been sent to a coordinator. Best effort: the oldest are dropped.
#[derive(Default)]
pub(crate) struct Unsent(VecDeque<(LeaseRef, u64, Vec<TaskLine>)>);

impl Unsent {
    /// Adds lines of a task.
    pub(crate) fn push(&mut self, lease: LeaseRef, index: u64, lines: Vec<TaskLine>) {
        if lines.is_empty() {
            return;
        }
        if self.0.len() == UNSENT {
            self.0.pop_front();
        }
        self.0.push_back((lease, index, lines));
    }

    /// Returns the messages to send now.
    pub(crate) fn drain(&mut self, now: Instant) -> impl Iterator<Item = TaskLog> {
        self.0.drain(..).map(move |(lease, index, lines)| {
            let line = |line: TaskLine| LogLine {
                ago_ms: u32::try_from((now - line.at).as_millis()).unwrap_or(u32::MAX),
                level: line.level,
                text: line.text,
            };
            TaskLog {
                lease,
                index,
                lines: lines.into_iter().map(line).collect(),
            }
        })
    }
}

#[cfg(test)]
mod tests {
    use picofarm_proto::{
        ids::{Epoch, RangeId},
        messages::log::{BYTES, LINES},
    };
    use tracing::{info, warn};
    use tracing_subscriber::prelude::*;
    use uuid::Uuid;

    use super::*;

    fn texts(lines: &[TaskLine]) -> Vec<String> {
        let text = |l: &TaskLine| format!("{}: {}", l.level, l.text);
        lines.iter().map(text).collect()
    }

    /// Runs `work` on a thread that the collector serves.
    fn on_a_worker(collector: &Arc<Collector>, work: impl FnOnce() + Send) {
        std::thread::scope(|s| {
            s.spawn(|| {
                let subscriber = tracing_subscriber::registry().with(task_logs());
                collector.serve();
                tracing::subscriber::with_default(subscriber, work);
            });
        });
    }

    #[test]
    fn lines_of_a_workers_thread_are_collected_with_their_fields_and_no_others() {
        let collector = Arc::new(Collector::default());
        collector.begin();
        on_a_worker(&collector, || {
            info!(triangles = 12, name = "room", "scene made");
            tracing::debug!("too fine");
            warn!(target: "object_store", "somebody else's");
            warn!(error = %"full", "not stored");
        });
        info!("another thread's");
        assert_eq!(
            texts(&collector.take()),
            [
                r#"info: scene made triangles=12 name="room""#,
                "warn: not stored error=full"
            ]
        );
        assert!(collector.end().is_empty());
    }

    #[test]
    fn a_task_that_says_too_much_is_cut_short_and_says_how_much_and_the_next_begins_anew() {
        let collector = Arc::new(Collector::default());
        collector.begin();
        on_a_worker(&collector, || (0..1000).for_each(|i| info!("line {i}")));
        let lines = texts(&collector.end());
        assert_eq!(lines.len(), LINES);
        let last = "warn: 801 further lines are only in the worker's own log";
        assert_eq!(lines[LINES - 1], last);
        collector.begin();
        on_a_worker(&collector, || {
            (0..1000).for_each(|_| info!("{}", "x".repeat(BYTES)))
        });
        let bytes: usize = collector.end().iter().map(|l| l.text.len()).sum();
        assert!(bytes > BYTES / 2 && bytes <= BYTES, "{bytes}");
    }

    #[test]
    fn what_waits_too_long_for_a_coordinator_gives_way() {
        let lease = LeaseRef {
            range: RangeId::from_uuid(Uuid::nil()),
            epoch: Epoch(1),
        };
        let mut unsent = Unsent::default();
        let at = Instant::now();
        unsent.push(lease, 0, Vec::new());
        for task in 0..100 {
            let level = LogLevel::Info;
            let text = String::new();
            unsent.push(lease, task, vec![TaskLine { at, level, text }]);
        }
        let tasks: Vec<u64> = unsent.drain(at).map(|log| log.index).collect();
        assert_eq!(tasks, (36..100).collect::<Vec<_>>());
        assert_eq!(unsent.drain(at).count(), 0);
    }
}
