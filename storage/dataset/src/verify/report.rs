//! What a check of a data set says.

use std::fmt;

/// Called with the number of scenes checked, and of all.
pub type Watch<'a> = &'a (dyn Fn(u64, u64) + Sync);

/// How thoroughly to check.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum VerifyMode {
    /// Metadata, manifests, and each object's presence and size. No object is read.
    Fast,
    /// Also each object's SHA-256, and that it decodes.
    Full,
}

/// What is wrong with an object.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Fault {
    /// Its scene is published, but it is not there.
    Missing,
    /// Its size differs from the manifest's.
    WrongSize {
        /// The manifest's.
        expected: u64,
        /// The store's.
        found: u64,
    },
    /// Its SHA-256 differs from the manifest's (a manifest's own: from the snapshot's).
    WrongHash {
        /// The manifest's.
        expected: String,
        /// That of the stored bytes.
        found: String,
    },
    /// It does not decode, or its content contradicts the manifest; the reason.
    Undecodable(String),
    /// Not the metadata the specification asks for; how they differ.
    BadMetadata(String),
    /// The manifest cannot be used; why.
    BadManifest(String),
    /// A snapshot or recipe cannot be used; why.
    BadRecord(String),
    /// Nothing of this data set has this key.
    Foreign,
}

/// An object with a fault.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Problem {
    /// Full key.
    pub object: String,
    /// The scene it belongs to.
    pub scene: Option<u64>,
    /// The fault.
    pub fault: Fault,
}

/// What [`Dataset::verify`](crate::Dataset::verify) found.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Verification {
    /// Published scenes that were checked.
    pub scenes: u64,
    /// Objects of published scenes that were checked.
    pub objects: u64,
    /// Their bytes.
    pub bytes: u64,
    /// What is wrong, ordered by key.
    pub problems: Vec<Problem>,
    /// Objects of scenes without a (usable) manifest: being written now, left by a killed worker and adopted when the
    /// scene is published, or of a scene whose manifest was deleted. Ordered by key.
    pub unpublished: Vec<String>,
    /// Scenes without a manifest of which objects are there, ascending; see [`Self::unpublished`].
    pub unfinished: Vec<u64>,
}

impl Verification {
    /// Whether nothing is wrong.
    pub fn is_sound(&self) -> bool {
        self.problems.is_empty()
    }
}

impl Fault {
    /// A word for programs.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Missing => "missing",
            Self::WrongSize { .. } => "wrong_size",
            Self::WrongHash { .. } => "wrong_hash",
            Self::Undecodable(_) => "undecodable",
            Self::BadMetadata(_) => "bad_metadata",
            Self::BadManifest(_) => "bad_manifest",
            Self::BadRecord(_) => "bad_record",
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
            Self::BadRecord(why) => write!(f, "unusable: {why}"),
            Self::Foreign => write!(f, "does not belong to this data set"),
        }
    }
}

impl Problem {
    /// Whether `dataset repair` puts it right.
    pub fn repairable(&self) -> bool {
        !matches!(self.fault, Fault::Foreign | Fault::BadRecord(_))
    }

    /// How it is repaired.
    pub fn hint(&self) -> &'static str {
        match (&self.fault, self.scene) {
            (Fault::Foreign, _) => "move it elsewhere; nothing reads it, nothing here deletes it",
            (Fault::BadRecord(_), _) => {
                "nothing depends on it; delete it, and make it anew if it is wanted"
            }
            (_, Some(_)) => "dataset repair makes the scene again and replaces what is broken",
            (_, None) => "dataset repair writes it again",
        }
    }
}

impl fmt::Display for Problem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}: {}", self.object, self.fault)
    }
}
