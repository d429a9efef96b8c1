//! Pairwise connections of all processes, and the all-reduce of a step over them.

use std::{
    io::{self, Read, Write},
    net::{Shutdown, TcpStream},
    ops::Range,
    sync::{
        Mutex, PoisonError,
        atomic::{AtomicBool, Ordering},
        mpsc::{RecvTimeoutError, channel},
    },
    thread,
    time::Duration,
};

use picofarm_model::{
    ModelError,
    train::group::{Block, Blocks, Compute, Part, add_values},
};

/// Interval at which an all-reduce checks whether to stop.
const ASK: Duration = Duration::from_millis(100);
/// Maximum number of blocks of a process in a step, and of running statistics.
const MOST: u32 = 1 << 16;
/// Maximum number of values to allocate before they arrive.
const RESERVED: usize = 1 << 22;

/// Aborts an all-reduce: every connection is closed, so that all waiting threads wake up.
#[derive(Default)]
pub struct Breaker(Mutex<Vec<TcpStream>>);

impl Breaker {
    /// Closes all connections.
    pub fn break_off(&self) {
        for stream in self
            .0
            .lock()
            .unwrap_or_else(PoisonError::into_inner)
            .drain(..)
        {
            let _ = stream.shutdown(Shutdown::Both);
        }
    }

    fn arm(&self, streams: Vec<TcpStream>) {
        self.break_off();
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = streams;
    }
}

/// Closes all connections on a panic, so that no process waits for data that never arrives.
struct BrokenBy<'a>(&'a Breaker);

impl Drop for BrokenBy<'_> {
    fn drop(&mut self) {
        if thread::panicking() {
            self.0.break_off();
        }
    }
}

/// Connections of one process with all others.
pub struct Mesh {
    rank: usize,
    /// By rank; `None` at its own.
    peers: Vec<Option<TcpStream>>,
}

impl Mesh {
    /// Returns a mesh of connections by rank, with none at its own.
    pub fn new(rank: usize, peers: Vec<Option<TcpStream>>, breaker: &Breaker) -> io::Result<Self> {
        let mut handles = Vec::new();
        for stream in peers.iter().flatten() {
            // The leading process monitors liveness, so there are no timeouts here.
            stream.set_read_timeout(None)?;
            stream.set_write_timeout(None)?;
            handles.push(stream.try_clone()?);
        }
        breaker.arm(handles);
        Ok(Self { rank, peers })
    }

    /// Returns the number of processes.
    pub fn len(&self) -> usize {
        self.peers.len()
    }

    /// Returns the sums over all processes of their parts of a step with this number of batches. A
    /// part is summed while the next one is computed. Also returns the result of `compute`; if that
    /// is an error, the others notice it by their closed connections.
    pub fn sums(
        &self,
        step: u64,
        batches: usize,
        compute: Compute<'_>,
        breaker: &Breaker,
        stopped: &dyn Fn() -> bool,
    ) -> (Result<(), ModelError>, io::Result<Vec<Part>>) {
        let (hand, handed) = channel::<Part>();
        let (done, sums) = channel();
        let stop = AtomicBool::new(false);
        thread::scope(|scope| {
            let _broken = BrokenBy(breaker);
            let stop = &stop;
            scope.spawn(move || {
                let stopped = || stop.load(Ordering::SeqCst);
                let parts = handed.iter();
                let sums = parts.map(|part| self.sum(step, batches, part, breaker, &stopped));
                // There is no receiver if computing panicked.
                let _ = done.send(sums.collect::<io::Result<Vec<Part>>>());
            });
            let computed = compute(&mut |part| {
                // There is no receiver if summing has already failed, which is reported below.
                let _ = hand.send(part);
            });
            drop(hand);
            if computed.is_err() {
                breaker.break_off();
            }
            let sums = loop {
                match sums.recv_timeout(ASK) {
                    Ok(sums) => break sums,
                    Err(RecvTimeoutError::Timeout) => {
                        if stopped() {
                            stop.store(true, Ordering::SeqCst);
                        }
                    }
                    Err(RecvTimeoutError::Disconnected) => {
                        break Err(io::Error::other("a thread that adds up gradients panicked"));
                    }
                }
            };
            (computed, sums)
        })
    }

    /// Returns the sum over all processes of a part of a step.
    ///
    /// # Errors
    /// If a connection ends, or the received data belong to another step.
    fn sum(
        &self,
        step: u64,
        batches: usize,
        part: Part,
        breaker: &Breaker,
        stopped: &dyn Fn() -> bool,
    ) -> io::Result<Part> {
        let (n, len) = (self.len(), part.len);
        let slice = |rank: usize| slice(len, rank, n);
        let head = Head::new(step, &part);
        // Receives this process's slice from all others.
        let found = self.with_all(
            breaker,
            stopped,
            |to, peer| {
                head.write(to)?;
                for block in part.blocks.as_slice() {
                    to.write_all(bytemuck::cast_slice(&block.sum[slice(peer)]))?;
                }
                to.flush()
            },
            |from, _| Head::read(from, step, len)?.blocks(from, slice(self.rank).len()),
        )?;
        let mut found = found.into_iter();
        let mut sum = Blocks::default();
        let mut first = None;
        for rank in 0..n {
            let theirs = match rank == self.rank {
                true => part.blocks.clone_slice(&slice(rank)),
                false => found.next().expect("one of each other process"),
            };
            for block in theirs {
                if block.begin == 0 {
                    first = Some(rank);
                }
                if !sum.fits(&block) {
                    return Err(bad("batches that another process has"));
                }
                sum.push(block, &mut |a, b| add_values(a, &b));
            }
        }
        let (true, Some(first)) = (sum.is_whole(batches), first) else {
            return Err(bad("batches of a step are missing"));
        };
        let ours = sum
            .total(&mut |a, b| add_values(a, &b))
            .expect("a step has batches");
        // Sends the sum of this process's slice, and running statistics, to all others.
        let moved = match self.rank == first {
            true => statistics(&part.moved),
            false => Vec::new(),
        };
        let sums = self.with_all(
            breaker,
            stopped,
            |to, _| {
                to.write_all(bytemuck::cast_slice(&ours))?;
                to.write_all(&moved)?;
                to.flush()
            },
            |from, peer| {
                let sum = values(from, slice(peer).len())?;
                let moved = match peer == first {
                    true => read_statistics(from)?,
                    false => Vec::new(),
                };
                Ok((sum, moved))
            },
        )?;
        let mut sums = sums.into_iter();
        let mut whole = Vec::with_capacity(len);
        let mut moved = part.moved;
        for rank in 0..n {
            if rank == self.rank {
                whole.extend_from_slice(&ours);
                continue;
            }
            let (sum, theirs) = sums.next().expect("one of each other process");
            whole.extend(sum);
            if rank == first {
                moved = theirs;
            }
        }
        Ok(Part {
            len,
            blocks: Blocks::whole(batches, whole),
            moved,
        })
    }

    /// Writes to all others and reads from them concurrently. Returns the data read, by rank.
    fn with_all<T: Send>(
        &self,
        breaker: &Breaker,
        stopped: &dyn Fn() -> bool,
        write: impl Fn(&mut io::BufWriter<&TcpStream>, usize) -> io::Result<()> + Sync,
        // Reading is unbuffered, because a buffer would lose the bytes that belong to the next
        // reader.
        read: impl Fn(&mut &TcpStream, usize) -> io::Result<T> + Sync,
    ) -> io::Result<Vec<T>> {
        let broken = AtomicBool::new(false);
        let (done, ends) = channel::<()>();
        let result: io::Result<Vec<T>> = thread::scope(|scope| {
            let (write, read, broken) = (&write, &read, &broken);
            let mut writers = Vec::new();
            let mut readers = Vec::new();
            for (rank, stream) in self.peers.iter().enumerate() {
                let Some(stream) = stream else { continue };
                let end = |failed: bool| {
                    if failed && !broken.swap(true, Ordering::SeqCst) {
                        breaker.break_off();
                    }
                };
                let over = done.clone();
                writers.push(scope.spawn(move || {
                    let result = write(&mut io::BufWriter::new(stream), rank);
                    end(result.is_err());
                    let _ = over.send(());
                    result
                }));
                let over = done.clone();
                readers.push(scope.spawn(move || {
                    let result = read(&mut &*stream, rank);
                    end(result.is_err());
                    let _ = over.send(());
                    result
                }));
            }
            drop(done);
            let mut left = writers.len() + readers.len();
            while left > 0 {
                match ends.recv_timeout(ASK) {
                    Ok(()) => left -= 1,
                    Err(RecvTimeoutError::Timeout) => {
                        if stopped() {
                            breaker.break_off();
                        }
                    }
                    Err(RecvTimeoutError::Disconnected) => break,
                }
            }
            let panicked = || io::Error::other("a thread that adds up gradients panicked");
            for writer in writers {
                writer.join().map_err(|_| panicked())??;
            }
            let read = readers.into_iter();
            read.map(|reader| reader.join().map_err(|_| panicked())?)
                .collect()
        });
        if result.is_err() {
            breaker.break_off();
        }
        result
    }
}

/// Returns the range of values that the process with this rank sums.
fn slice(len: usize, rank: usize, of: usize) -> Range<usize> {
    let at = |rank: usize| (len as u128 * rank as u128 / of as u128) as usize;
    at(rank)..at(rank + 1)
}

fn bad(what: &str) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, what)
}

/// The batches of a process in a part of a step, and the number of values.
struct Head {
    step: u64,
    len: u64,
    blocks: Vec<(u32, u32)>,
}

impl Head {
    fn new(step: u64, part: &Part) -> Self {
        let blocks = part.blocks.as_slice().iter();
        Self {
            step,
            len: part.len as u64,
            blocks: blocks.map(|b| (b.begin as u32, b.len as u32)).collect(),
        }
    }

    fn write(&self, to: &mut impl Write) -> io::Result<()> {
        to.write_all(&self.step.to_le_bytes())?;
        to.write_all(&self.len.to_le_bytes())?;
        to.write_all(&(self.blocks.len() as u32).to_le_bytes())?;
        for (begin, len) in &self.blocks {
            to.write_all(&begin.to_le_bytes())?;
            to.write_all(&len.to_le_bytes())?;
        }
        Ok(())
    }

    fn read(from: &mut impl Read, step: u64, len: usize) -> io::Result<Self> {
        let len = len as u64;
        let mut their = || {
            let mut bytes = [0; 8];
            from.read_exact(&mut bytes)?;
            Ok::<_, io::Error>(u64::from_le_bytes(bytes))
        };
        if their()? != step {
            return Err(bad("another process is at another step"));
        }
        if their()? != len {
            return Err(bad("another process adds up another part of the network"));
        }
        let count = count(from)?;
        let blocks: io::Result<Vec<(u32, u32)>> = (0..count)
            .map(|_| Ok((number(from)?, number(from)?)))
            .collect();
        Ok(Self {
            step,
            len,
            blocks: blocks?,
        })
    }

    /// Reads the sums of its blocks, each of `len` values.
    fn blocks(self, from: &mut impl Read, len: usize) -> io::Result<Vec<Block<Vec<f32>>>> {
        let blocks = self.blocks.into_iter();
        blocks
            .map(|(begin, batches)| {
                Ok(Block {
                    begin: begin as usize,
                    len: batches as usize,
                    sum: values(from, len)?,
                })
            })
            .collect()
    }
}

fn number(from: &mut impl Read) -> io::Result<u32> {
    let mut bytes = [0; 4];
    from.read_exact(&mut bytes)?;
    Ok(u32::from_le_bytes(bytes))
}

fn count(from: &mut impl Read) -> io::Result<u32> {
    match number(from)? {
        count if count <= MOST => Ok(count),
        _ => Err(bad("more than a step has")),
    }
}

/// Reads `len` values. Values that never arrive are not allocated.
fn values(from: &mut impl Read, len: usize) -> io::Result<Vec<f32>> {
    let mut values: Vec<f32> = Vec::with_capacity(len.min(RESERVED));
    while values.len() < len {
        let at = values.len();
        values.resize(len.min(at + RESERVED), 0.0);
        from.read_exact(bytemuck::cast_slice_mut(&mut values[at..]))?;
    }
    if cfg!(target_endian = "big") {
        for value in &mut values {
            *value = f32::from_bits(value.to_bits().swap_bytes());
        }
    }
    Ok(values)
}

/// Serializes running statistics.
fn statistics(moved: &[(usize, Vec<f32>)]) -> Vec<u8> {
    let mut bytes = (moved.len() as u32).to_le_bytes().to_vec();
    for (which, values) in moved {
        bytes.extend((*which as u32).to_le_bytes());
        bytes.extend((values.len() as u32).to_le_bytes());
        bytes.extend_from_slice(bytemuck::cast_slice(values));
    }
    bytes
}

fn read_statistics(from: &mut impl Read) -> io::Result<Vec<(usize, Vec<f32>)>> {
    let count = count(from)?;
    let one = |_| {
        let which = number(from)? as usize;
        let len = number(from)? as usize;
        Ok((which, values(from, len)?))
    };
    (0..count).map(one).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_part_of_another_step_or_length_is_refused() {
        let mut part = Part {
            len: 7,
            ..Part::default()
        };
        let block = Block {
            begin: 2,
            len: 2,
            sum: vec![1.0; 7],
        };
        part.blocks.push(block, &mut |a, b| add_values(a, &b));
        let mut bytes = Vec::new();
        Head::new(3, &part).write(&mut bytes).unwrap();
        let read = |step, len| Head::read(&mut &bytes[..], step, len);
        assert_eq!(read(3, 7).unwrap().blocks, [(2, 2)]);
        let refused = |step, len| read(step, len).err().unwrap().to_string();
        assert!(refused(4, 7).contains("another step"));
        assert!(refused(3, 6).contains("another part"));
    }
}
