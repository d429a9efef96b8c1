//! Keys of results: hashes of descriptions.

use std::fmt;

use sha2::{Digest, Sha256};

/// Hash of the canonical description of a stage's tasks, without their number, name or budgets.
#[derive(Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct StageKey(pub [u8; 32]);

/// Key of one task's result.
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
    /// Returns the key for a description of everything that affects the results of a stage's tasks
    /// except their number.
    pub fn of(description: serde_json::Value) -> Self {
        Self(Sha256::digest(canonical(description).as_bytes()).into())
    }
}

/// Returns the key of task `index` of a stage.
pub fn task_key(stage: &StageKey, index: u64) -> TaskKey {
    let mut hash = Sha256::new();
    hash.update(stage.0);
    hash.update(index.to_le_bytes());
    TaskKey(hash.finalize().into())
}

/// Returns the key of a task that makes one scene from another, given the stage and the key of the
/// source scene.
pub fn derived_key(stage: &StageKey, source: &TaskKey) -> TaskKey {
    let mut hash = Sha256::new();
    hash.update(b"derived");
    hash.update(stage.0);
    hash.update(source.0);
    TaskKey(hash.finalize().into())
}

/// Returns JSON with the members of each object sorted. Whether serde_json sorts them itself
/// depends on its feature `preserve_order`, which any crate of a build may enable.
pub(super) fn canonical(mut description: serde_json::Value) -> String {
    description.sort_all_objects();
    description.to_string()
}
