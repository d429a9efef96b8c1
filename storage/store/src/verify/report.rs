//! The report of a data set's check.

use std::fmt;

/// Called with the number of checked scenes and the number of all scenes.
pub type Watch<'a> = &'a (dyn Fn(u64, u64) + Sync);

/// The thoroughness of a check.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum VerifyMode {
    /// Checks metadata, manifests, and each object's existence and size. No object is read.
    Fast,
    /// Also checks each object's SHA-256, and that it can be decoded.
    Full,
}

/// A fault of an object.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Fault {
    /// The scene is published, but the object is missing.
    Missing,
    /// Its size differs from the manifest's.
    WrongSize {
        /// The manifest's size.
        expected: u64,
        /// The stored size.
        found: u64,
    },
    /// Its SHA-256 differs from the manifest's; for a manifest, from the snapshot's.
    WrongHash {
        /// The expected SHA-256.
        expected: String,
        /// The SHA-256 of the stored bytes.
        found: String,
    },
    /// It cannot be decoded, or its content contradicts the manifest, for this reason.
    Undecodable(String),
    /// The metadata differs from the specification in this way.
    BadMetadata(String),
    /// The manifest is unusable for this reason.
    BadManifest(String),
    /// A record is unusable.
    BadRecord {
        /// The owner of the record.
        kind: RecordKind,
        /// The reason.
        why: String,
    },
    /// The key does not belong to this data set.
    Foreign,
}

/// The owner of a record, which decides how it is made again.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RecordKind {
    /// A data set's snapshot, recipe or split.
    Dataset,
    /// A model's evaluation, checkpoint or speed: the job that made it makes it again.
    Model,
    /// A trial of a sweep: its sweep makes it again.
    Trial,
}

/// The remedy of a problem.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Remedy {
    /// The instruction for people.
    pub text: &'static str,
    /// Whether `picofarm dataset repair` follows it.
    pub by_repair: bool,
}

/// An object with a fault.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Problem {
    /// Full key.
    pub object: String,
    /// The object's scene, if any.
    pub scene: Option<u64>,
    /// The fault.
    pub fault: Fault,
}

/// The result of a check of a data set or of results.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Verification {
    /// Number of published scenes checked.
    pub scenes: u64,
    /// Number of objects of published scenes checked.
    pub objects: u64,
    /// Their total size in bytes.
    pub bytes: u64,
    /// The problems, ordered by key.
    pub problems: Vec<Problem>,
    /// Objects of scenes without a (usable) manifest: being written at the moment, left by a killed
    /// worker and adopted when the scene is published, or of a scene with a deleted manifest.
    /// Ordered by key.
    pub unpublished: Vec<String>,
    /// Scenes without a manifest but with objects, ascending; see [`Self::unpublished`].
    pub unfinished: Vec<u64>,
}

impl Verification {
    /// Returns whether there are no problems.
    pub fn is_sound(&self) -> bool {
        self.problems.is_empty()
    }
}

impl Fault {
    /// Returns an identifier of the fault for programs.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Missing => "missing",
            Self::WrongSize { .. } => "wrong_size",
            Self::WrongHash { .. } => "wrong_hash",
            Self::Undecodable(_) => "undecodable",
            Self::BadMetadata(_) => "bad_metadata",
            Self::BadManifest(_) => "bad_manifest",
            Self::BadRecord { .. } => "bad_record",
            Self::Foreign => "foreign",
        }
    }
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Missing => write!(f, "missing"),
            Self::WrongSize { expected, found } => {
                write!(f, "expected {expected} bytes, found {found}")
            }
            Self::WrongHash { expected, found } => {
                write!(f, "expected SHA-256 {expected}, found {found}")
            }
            Self::Undecodable(why) => write!(f, "does not decode: {why}"),
            Self::BadMetadata(why) => write!(f, "unusable metadata: {why}"),
            Self::BadManifest(why) => write!(f, "unusable manifest: {why}"),
            Self::BadRecord { why, .. } => write!(f, "unusable: {why}"),
            Self::Foreign => write!(f, "does not belong to this data set"),
        }
    }
}

impl Problem {
    /// Returns what to do about it, in a data set.
    pub fn remedy(&self) -> Remedy {
        let (text, by_repair) = match (&self.fault, self.scene) {
            (Fault::Foreign, _) => (
                "move it elsewhere; nothing reads it, nothing here deletes it",
                false,
            ),
            (Fault::BadRecord { .. }, _) => (
                "nothing depends on it; delete it, and make it anew if it is wanted",
                false,
            ),
            (_, Some(_)) => (
                "dataset repair makes the scene again and replaces what is broken",
                true,
            ),
            (_, None) => ("dataset repair writes it again", true),
        };
        Remedy { text, by_repair }
    }
}

impl fmt::Display for Problem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.object, self.fault)
    }
}
