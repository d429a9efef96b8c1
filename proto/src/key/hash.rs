//! What a result is named by: hashes of descriptions.

use std::fmt;

use sha2::{Digest, Sha256};

/// Hash of the canonical description of a stage's tasks, without their number, name or budgets.
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct StageKey(pub [u8; 32]);

/// Names one task's result.
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct TaskKey(pub [u8; 32]);

macro_rules! hex_text {
    ($name:ident) => {
        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str(&hex::encode(self.0))
            }
        }
        impl fmt::Debug for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                write!(f, concat!(stringify!($name), "({})"), self)
            }
        }
        impl $name {
            /// Parses 64 hexadecimal digits.
            pub fn parse(text: &str) -> Option<Self> {
                let mut bytes = [0; 32];
                hex::decode_to_slice(text, &mut bytes).ok()?;
                Some(Self(bytes))
            }
        }
    };
}
hex_text!(StageKey);
hex_text!(TaskKey);

impl StageKey {
    /// Of a description of all that shapes the results of a stage's tasks but their number.
    pub fn of(description: serde_json::Value) -> Self {
        Self(Sha256::digest(canonical(description).as_bytes()).into())
    }
}

/// The key of task `index` of a stage.
pub fn task_key(stage: &StageKey, index: u64) -> TaskKey {
    let mut hash = Sha256::new();
    hash.update(stage.0);
    hash.update(index.to_le_bytes());
    TaskKey(hash.finalize().into())
}

/// The key of a task that makes one scene of another: the stage, and the key of the task that made the source.
pub fn derived_key(stage: &StageKey, source: &TaskKey) -> TaskKey {
    let mut hash = Sha256::new();
    hash.update(b"derived");
    hash.update(stage.0);
    hash.update(source.0);
    TaskKey(hash.finalize().into())
}

/// JSON with the members of each object sorted. Whether serde_json sorts them by itself depends on its feature
/// `preserve_order`, which any crate of a build may switch on.
pub(super) fn canonical(mut description: serde_json::Value) -> String {
    description.sort_all_objects();
    description.to_string()
}
