//! The Python processes of a training: how they start, connect and end.

use std::{
    collections::BTreeMap,
    io::{BufReader, ErrorKind},
    os::unix::net::{UnixListener, UnixStream},
    path::Path,
    sync::Arc,
    thread::{self, JoinHandle},
    time::{Duration, Instant},
};

use bytes::Bytes;
use picofarm_model::ModelError;
use tempfile::TempDir;

use super::rank::{Lost, answer};
use crate::{
    interpreter::Interpreter,
    python::{self, Answer, Ended, Host, Order, Patience, Report},
    task::{Control, TaskError},
};

/// The modules of a process, written into its folder, so that the interpreter needs PyTorch only.
const CODE: [(&str, &str); 7] = [
    ("picofarm_torch/__init__.py", ""),
    (
        "picofarm_torch/_embeddings.py",
        include_str!("../../../../../../python/picofarm/torch/_embeddings.py"),
    ),
    (
        "picofarm_torch/_networks.py",
        include_str!("../../../../../../python/picofarm/torch/_networks.py"),
    ),
    (
        "picofarm_torch/_nlost.py",
        include_str!("../../../../../../python/picofarm/torch/_nlost.py"),
    ),
    (
        "picofarm_torch/_swinir.py",
        include_str!("../../../../../../python/picofarm/torch/_swinir.py"),
    ),
    (
        "picofarm_torch/_train.py",
        include_str!("../../../../../../python/picofarm/torch/_train.py"),
    ),
    (
        "picofarm_torch/_unets.py",
        include_str!("../../../../../../python/picofarm/torch/_unets.py"),
    ),
];
/// The function that a process runs.
const ENTRY: &str = "picofarm_torch._train:start";
/// How long processes may take to load PyTorch and to connect.
const CONNECT: Duration = Duration::from_secs(600);
/// How long a process that no longer answers may take to end.
const END: Duration = Duration::from_secs(20);
/// Interval at which connections and ends are looked for.
const LOOK: Duration = Duration::from_millis(10);
/// A file system in memory.
const MEMORY: &str = "/dev/shm";
/// Longest path of a Unix socket on all systems, in bytes.
const SOCKET_PATH: usize = 100;

/// The processes of a training. They end when the connections are closed.
pub(super) struct Processes {
    folder: TempDir,
    /// The folder of batches, if it is another.
    memory: Option<TempDir>,
    listener: UnixListener,
    control: Arc<Control>,
    runs: Option<JoinHandle<Result<Ended, TaskError>>>,
    count: usize,
}

/// Nothing is reported by the runner's messages.
struct Silent;

impl Host for Silent {
    fn report(&mut self, _: Report) -> Result<Answer, TaskError> {
        Ok(Answer::Go)
    }

    fn checkpoint(&mut self, _: u64, _: &Path) -> Result<(), TaskError> {
        Ok(())
    }

    fn artifact(&mut self, _: &str, _: &Path) -> Result<(), TaskError> {
        Ok(())
    }
}

impl Processes {
    /// Starts processes. Files with batches will take `bytes` in all.
    pub(super) fn start(
        interpreter: &Interpreter,
        count: usize,
        bytes: u64,
    ) -> Result<Self, ModelError> {
        let unprepared = |e: std::io::Error| {
            let what = format!("cannot prepare PyTorch: {e}; make room, or set TMPDIR");
            ModelError::Engine(what)
        };
        let folder = scratch().map_err(unprepared)?;
        let path = folder.path().join("socket");
        let listener = UnixListener::bind(&path).map_err(unprepared)?;
        listener.set_nonblocking(true).map_err(unprepared)?;
        let memory = has_room(bytes).then(|| tempfile::tempdir_in(MEMORY));
        let memory = memory.transpose().map_err(unprepared)?;
        let threads = (rayon::current_num_threads() / count).max(1);
        let variables = vec![
            (
                "PICOFARM_TORCH_SOCKET".to_owned(),
                path.display().to_string(),
            ),
            ("PICOFARM_TORCH_PROCESSES".to_owned(), count.to_string()),
            ("OMP_NUM_THREADS".to_owned(), threads.to_string()),
            // Threads that wait must not keep this worker from preparing scenes.
            ("OMP_WAIT_POLICY".to_owned(), "PASSIVE".to_owned()),
        ];
        let control = Arc::new(Control::default());
        let (interpreter, theirs) = (interpreter.clone(), Arc::clone(&control));
        let span = tracing::Span::current();
        let run = move || {
            let _entered = span.enter();
            let code =
                CODE.map(|(name, text)| (name.to_owned(), Bytes::from_static(text.as_bytes())));
            let order = Order {
                entry: ENTRY.to_owned(),
                code: &code,
                variables,
                ..Order::default()
            };
            python::run(
                &interpreter,
                order,
                &mut Silent,
                (&theirs, Patience::default()),
            )
        };
        let thread = thread::Builder::new().name("torch".into());
        Ok(Self {
            folder,
            memory,
            listener,
            control,
            runs: Some(thread.spawn(run).map_err(unprepared)?),
            count,
        })
    }

    /// Waits for the connections of all processes, in their order. Returns them with the versions
    /// that the first one has.
    pub(super) fn connect(
        &mut self,
    ) -> Result<(Vec<UnixStream>, BTreeMap<String, String>), ModelError> {
        let mut found = BTreeMap::new();
        let mut versions = BTreeMap::new();
        while found.len() < self.count {
            let stream = self.accept()?;
            let (rank, theirs) = introduced(&stream).map_err(|e| self.explain(e))?;
            if rank == 0 {
                versions = theirs;
            }
            found.insert(rank, stream);
        }
        Ok((found.into_values().collect(), versions))
    }

    fn accept(&mut self) -> Result<UnixStream, ModelError> {
        let until = Instant::now() + CONNECT;
        loop {
            match self.listener.accept() {
                Ok((stream, _)) => {
                    let blocks = stream.set_nonblocking(false);
                    return blocks.map(|()| stream).map_err(|e| self.explain(e.into()));
                }
                Err(e) if e.kind() == ErrorKind::WouldBlock => {}
                Err(e) => return Err(self.explain(e.into())),
            }
            if self.has_ended() {
                let closed = std::io::Error::from(ErrorKind::UnexpectedEof);
                return Err(self.explain(closed.into()));
            }
            if Instant::now() > until {
                let what = format!("PyTorch was not loaded within {} s", CONNECT.as_secs());
                return Err(ModelError::Engine(what));
            }
            thread::sleep(LOOK);
        }
    }

    /// Returns the folder for the training's state.
    pub(super) fn folder(&self) -> &Path {
        self.folder.path()
    }

    /// Returns the folder for batches.
    pub(super) fn numbers(&self) -> &Path {
        self.memory.as_ref().unwrap_or(&self.folder).path()
    }

    fn has_ended(&self) -> bool {
        self.runs.as_ref().is_none_or(JoinHandle::is_finished)
    }

    /// Explains the end of a conversation by that of the processes.
    pub(super) fn explain(&mut self, lost: Lost) -> ModelError {
        let error = match lost {
            Lost::Failed(what) => return ModelError::Engine(format!("PyTorch: {what}")),
            Lost::Io(error) => error,
        };
        let until = Instant::now() + END;
        while !self.has_ended() && Instant::now() < until {
            thread::sleep(LOOK);
        }
        let ended = match self.runs.take_if(|runs| runs.is_finished()) {
            Some(runs) => runs.join(),
            None => return ModelError::Engine(format!("PyTorch does not answer: {error}")),
        };
        ModelError::Engine(match ended {
            Ok(Err(why)) => format!("PyTorch has ended: {why}"),
            Ok(Ok(_)) => "PyTorch has ended before the training".into(),
            Err(_) => "the thread of PyTorch panicked".into(),
        })
    }

    /// Returns the error for a file of a state.
    pub(super) fn unwritten(&self, path: &Path, error: &std::io::Error) -> ModelError {
        ModelError::Engine(format!(
            "{}: {error}; make room, or set TMPDIR",
            path.display()
        ))
    }
}

impl Drop for Processes {
    fn drop(&mut self) {
        self.control.give_up();
        if let Some(runs) = self.runs.take() {
            // A panic there has no further consequence.
            let _ = runs.join();
        }
    }
}

/// Creates a folder whose path is short enough for a socket.
fn scratch() -> std::io::Result<TempDir> {
    let prefix = "picofarm-torch-";
    let usual = tempfile::Builder::new().prefix(prefix).tempdir()?;
    match usual.path().as_os_str().len() + "/socket".len() > SOCKET_PATH {
        true => tempfile::Builder::new().prefix(prefix).tempdir_in("/tmp"),
        false => Ok(usual),
    }
}

/// Returns whether the file system in memory has twice this room.
fn has_room(bytes: u64) -> bool {
    rustix::fs::statvfs(MEMORY)
        .is_ok_and(|there| there.f_bavail.saturating_mul(there.f_frsize) >= bytes.saturating_mul(2))
}

/// Hears the number and the versions of a process.
fn introduced(stream: &UnixStream) -> Result<(u64, BTreeMap<String, String>), Lost> {
    let hello = answer(&mut BufReader::new(stream.try_clone()?))?;
    let versions = serde_json::from_value(hello["versions"].clone());
    match (hello["rank"].as_u64(), versions) {
        (Some(rank), Ok(versions)) => Ok((rank, versions)),
        _ => Err(Lost::Failed(format!("{hello} is no introduction"))),
    }
}
