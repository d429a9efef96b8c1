//! One process of a training by PyTorch: its connection, and the files with its batches.

use std::{
    fs::File,
    io::{BufRead, BufReader, Read, Write},
    os::unix::{fs::FileExt, net::UnixStream},
    path::{Path, PathBuf},
};

use picofarm_model::input::Batch;
use serde_json::{Value, json};

/// The number of files for batches of a step: one is computed, and one is written.
const SLOTS: usize = 2;
/// Most bytes of an answer.
const ANSWER_BYTES: u64 = 1 << 20;

/// The end of a conversation.
#[derive(Debug)]
pub(super) enum Lost {
    /// The program has failed, with these words.
    Failed(String),
    /// The connection or a file has failed.
    Io(std::io::Error),
}

impl From<std::io::Error> for Lost {
    fn from(error: std::io::Error) -> Self {
        Self::Io(error)
    }
}

/// A process.
pub(super) struct Rank {
    lines: BufReader<UnixStream>,
    /// The files with batches. The last one is for predictions.
    files: Vec<Numbers>,
    answer: PathBuf,
    /// The file for the next batch.
    next: usize,
    /// The number of commands without an answer.
    waiting: usize,
    /// The latest answer.
    latest: Value,
}

/// A batch that a process can read.
pub(super) struct Placed(Value);

impl Placed {
    /// Returns a command about the batch.
    pub(super) fn command(&self, what: &str, flags: &[(&str, bool)]) -> Value {
        let mut command = self.0.clone();
        command["do"] = what.into();
        for (name, flag) in flags {
            command[*name] = (*flag).into();
        }
        command
    }
}

impl Rank {
    /// Creates a process with a connection. Its files are in `folder`.
    pub(super) fn new(number: usize, stream: UnixStream, folder: &Path) -> Self {
        let file = |which: usize| Numbers {
            path: folder.join(format!("batch-{number}-{which}")),
            file: None,
        };
        Self {
            lines: BufReader::new(stream),
            files: (0..=SLOTS).map(file).collect(),
            answer: folder.join(format!("answer-{number}")),
            next: 0,
            waiting: 0,
            latest: Value::Null,
        }
    }

    /// Sends a command. Its answer is awaited by [`Self::settle`].
    pub(super) fn send(&mut self, command: &Value) -> Result<(), Lost> {
        let line = format!("{command}\n");
        self.lines.get_mut().write_all(line.as_bytes())?;
        self.waiting += 1;
        Ok(())
    }

    /// Waits for the answers to all commands. Returns the latest one.
    pub(super) fn settle(&mut self) -> Result<Value, Lost> {
        while self.waiting > 0 {
            self.latest = answer(&mut self.lines)?;
            self.waiting -= 1;
        }
        Ok(self.latest.clone())
    }

    /// Writes a batch of a step to the file that the process does not read. At most one earlier
    /// batch may be without an answer.
    pub(super) fn place(&mut self, batch: &Batch) -> Result<Placed, Lost> {
        let file = &mut self.files[self.next];
        self.next = (self.next + 1) % SLOTS;
        file.write(batch)
    }

    /// Returns the network's output for a batch.
    pub(super) fn predict(&mut self, batch: &Batch) -> Result<Vec<f32>, Lost> {
        let asked = Batch {
            target: Vec::new(),
            ..batch.clone()
        };
        let placed = self.files[SLOTS].write(&asked)?;
        let mut command = placed.command("predict", &[]);
        command["answer"] = json!(self.answer);
        self.send(&command)?;
        let answered = self.settle()?;
        let bytes = std::fs::read(&self.answer)?;
        let values: Vec<f32> = bytes
            .as_chunks()
            .0
            .iter()
            .map(|b| f32::from_ne_bytes(*b))
            .collect();
        match answered["count"].as_u64() == Some(values.len() as u64) {
            true => Ok(values),
            false => Err(Lost::Failed(format!("{answered} is no answer to a batch"))),
        }
    }
}

/// Reads one answer.
pub(super) fn answer(lines: &mut BufReader<UnixStream>) -> Result<Value, Lost> {
    let mut line = String::new();
    let read = lines.take(ANSWER_BYTES).read_line(&mut line)?;
    if read == 0 {
        let closed = std::io::ErrorKind::UnexpectedEof;
        return Err(Lost::Io(closed.into()));
    }
    let answer: Value = serde_json::from_str(&line)
        .map_err(|e| Lost::Failed(format!("an answer is no JSON: {e}")))?;
    match answer["error"].as_str() {
        Some(error) => Err(Lost::Failed(error.trim_end().to_owned())),
        None => Ok(answer),
    }
}

/// A file with the numbers of a batch.
struct Numbers {
    path: PathBuf,
    file: Option<File>,
}

impl Numbers {
    /// Writes a batch.
    fn write(&mut self, batch: &Batch) -> Result<Placed, Lost> {
        let file = match &mut self.file {
            Some(file) => file,
            none => none.insert(File::create(&self.path)?),
        };
        let mut at = 0;
        let parts: [&[u8]; 3] = [
            bytemuck::cast_slice(&batch.dense),
            bytemuck::cast_slice(&batch.one_hot),
            bytemuck::cast_slice(&batch.target),
        ];
        for part in parts {
            file.write_all_at(part, at)?;
            at += part.len() as u64;
        }
        let pixels = batch.images * batch.height * batch.width;
        Ok(Placed(json!({
            "file": self.path,
            "bytes": at,
            "images": batch.images,
            "height": batch.height,
            "width": batch.width,
            "dense": batch.dense.len() / pixels,
            "one_hot": !batch.one_hot.is_empty(),
            "outputs": batch.target.len() / pixels,
        })))
    }
}
