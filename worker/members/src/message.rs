//! Messages between processes, and their format: a JSON header, and bytes after it.

use std::io::{self, Read, Write};

use picofarm_model::train::{Line, group::Standing};
use serde::{Deserialize, Serialize};

/// First bytes of every message.
const MAGIC: &[u8; 4] = b"pfm2";
/// Maximum size of a header in bytes. The list of all members is the longest.
const MOST_HEADER: u32 = 1 << 20;
/// Maximum number of bytes after a header, for a training's whole state.
const MOST_PAYLOAD: u64 = 1 << 37;
/// Maximum number of bytes to allocate before they arrive.
const RESERVED: u64 = 1 << 24;

/// A message.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Message {
    /// The first message of every connection.
    Hello {
        /// The secret required by the called process.
        secret: String,
        /// Key of the training.
        training: String,
        /// The purpose of the connection.
        wish: Wish,
    },
    /// The connection is accepted.
    Welcome,
    /// The connection is rejected.
    Refused {
        /// The reason.
        why: String,
    },
    /// A keepalive.
    Alive,
    /// From the leading process: asks for the state of progress. All processes wait for a new
    /// [`Message::Form`].
    Where,
    /// From the leading process: asks for the process's state.
    SendState,
    /// A training's state, as bytes after the header.
    State,
    /// From the leading process: the members from now on.
    Form {
        /// Number of this agreement.
        generation: u64,
        /// The receiver's rank.
        rank: usize,
        /// All members, by rank.
        members: Vec<Address>,
    },
    /// From the leading process: continue.
    Go,
    /// From the leading process: an epoch is over.
    Epoch {
        /// The result of the epoch.
        line: Line,
        /// Digest of the leading process's numbers.
        digest: u64,
    },
    /// From the leading process: the training is finished and stored.
    Over,
    /// To the leading process: the state of progress.
    Stands(Standing),
    /// To the leading process: connected with all others.
    Formed {
        /// The agreement.
        generation: u64,
    },
    /// To the leading process: a process was lost.
    Failed {
        /// The agreement.
        generation: u64,
    },
}

/// The purpose of a connection.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Wish {
    /// To take part.
    Join(Address),
    /// To sum gradients.
    Add {
        /// The agreement.
        generation: u64,
        /// Rank of the calling process.
        rank: usize,
    },
}

/// The address of a process.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Address {
    /// Address and port.
    pub address: String,
    /// The secret that it requires.
    pub secret: String,
}

/// Writes a message.
pub fn send(to: &mut impl Write, message: &Message, payload: &[u8]) -> io::Result<()> {
    let header = serde_json::to_vec(message).expect("messages are plain data");
    let len = u32::try_from(header.len()).map_err(io::Error::other)?;
    let mut head = MAGIC.to_vec();
    head.extend(len.to_le_bytes());
    head.extend((payload.len() as u64).to_le_bytes());
    head.extend(header);
    to.write_all(&head)?;
    to.write_all(payload)?;
    to.flush()
}

/// Reads a message.
pub fn receive(from: &mut impl Read, most_payload: Payload) -> io::Result<(Message, Vec<u8>)> {
    let bad = |what: &str| io::Error::new(io::ErrorKind::InvalidData, what);
    let mut head = [0; 16];
    from.read_exact(&mut head)?;
    let (magic, lens) = head.split_at(4);
    if magic != MAGIC {
        return Err(bad("no message of a training"));
    }
    let (header, payload) = lens.split_at(4);
    let header = u32::from_le_bytes(header.try_into().expect("four bytes"));
    let payload = u64::from_le_bytes(payload.try_into().expect("eight bytes"));
    let most = match most_payload {
        Payload::None => 0,
        Payload::State => MOST_PAYLOAD,
    };
    if header > MOST_HEADER || payload > most {
        return Err(bad("a message that is too long"));
    }
    let header = read(from, header.into())?;
    let message: Message = serde_json::from_slice(&header)?;
    if payload > 0 && message != Message::State {
        return Err(bad("bytes after a message that has none"));
    }
    Ok((message, read(from, payload)?))
}

/// The content allowed after a header.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Payload {
    /// Nothing.
    None,
    /// A training's state.
    State,
}

/// Reads `len` bytes. Bytes that are announced but never arrive are not allocated.
fn read(from: &mut impl Read, len: u64) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::with_capacity(len.min(RESERVED) as usize);
    from.take(len).read_to_end(&mut bytes)?;
    match bytes.len() as u64 == len {
        true => Ok(bytes),
        false => Err(io::ErrorKind::UnexpectedEof.into()),
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn what_is_sent_is_what_is_received() {
        let mut bytes = Vec::new();
        send(&mut bytes, &Message::State, b"numbers").unwrap();
        send(&mut bytes, &Message::Go, b"").unwrap();
        let mut from = &bytes[..];
        assert_eq!(
            receive(&mut from, Payload::State).unwrap(),
            (Message::State, b"numbers".to_vec())
        );
        assert_eq!(
            receive(&mut from, Payload::None).unwrap(),
            (Message::Go, Vec::new())
        );
        // A process that has not introduced itself cannot send a state.
        assert!(receive(&mut &bytes[..], Payload::None).is_err());
    }

    #[test]
    fn lengths_that_are_stated_and_never_come_take_no_memory() {
        let mut bytes = Vec::new();
        send(&mut bytes, &Message::State, b"x").unwrap();
        bytes[8..16].copy_from_slice(&(MOST_PAYLOAD).to_le_bytes());
        let error = receive(&mut &bytes[..], Payload::State).unwrap_err();
        assert_eq!(error.kind(), io::ErrorKind::UnexpectedEof);
        bytes[8..16].copy_from_slice(&(MOST_PAYLOAD + 1).to_le_bytes());
        assert!(receive(&mut &bytes[..], Payload::State).is_err());
    }

    proptest! {
        #[test]
        fn any_bytes_are_a_message_or_an_error(bytes in prop::collection::vec(any::<u8>(), 0..200), head in any::<bool>()) {
            let mut all = if head { MAGIC.to_vec() } else { Vec::new() };
            all.extend(bytes);
            let _ = receive(&mut &all[..], Payload::State);
        }
    }
}
