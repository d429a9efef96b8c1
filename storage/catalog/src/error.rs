//! What can go wrong with a catalog, and what to do about it.

use std::{
    io,
    path::{Path, PathBuf},
};

/// A catalog that cannot be opened, read or written.
#[derive(Debug, thiserror::Error)]
pub enum CatalogError {
    /// Another coordinator has it.
    #[error(
        "catalog {} is held by another coordinator ({holder}); stop that one first, or give this one a catalog of its own",
        path.display()
    )]
    Held {
        /// The database file.
        path: PathBuf,
        /// Who has it, as it said itself.
        holder: String,
    },
    /// A later program wrote it.
    #[error(
        "catalog {place} has schema version {found}, but this program knows versions up to {known}; use a newer picofarm, or another catalog"
    )]
    Newer {
        /// The database.
        place: String,
        /// Its schema version.
        found: i64,
        /// The latest schema version of this program.
        known: i64,
    },
    /// A build of another state of the source wrote it: one of its steps has another text than this program's.
    #[error(
        "catalog {place}: schema step {step} is not the one of this picofarm: a development build whose steps were edited \
         later wrote it; open it with that build, or start with another catalog (finished results stay in their stores, and \
         workers adopt them when the same jobs are submitted again)"
    )]
    OtherSchema {
        /// The database.
        place: String,
        /// Version of the first step that differs.
        step: i64,
    },
    /// The folder or file cannot be used.
    #[error("catalog {}: {what}: {source}", path.display())]
    File {
        /// The database file.
        path: PathBuf,
        /// What was tried.
        what: &'static str,
        /// The system's answer.
        source: io::Error,
    },
    /// No room.
    #[error("catalog {}: the disk is full; free some space: a coordinator that runs goes on by itself, one that did not start must be started again; no finished work is lost", path.display())]
    Full {
        /// The database file.
        path: PathBuf,
    },
    /// Its file is not the one at its path any more.
    #[error("catalog {}: {what}", path.display())]
    Lost {
        /// The database file.
        path: PathBuf,
        /// What became of it, and what to do.
        what: String,
    },
    /// What was to be written cannot be: not now and not later, by its content. Nothing was written.
    #[error("catalog {place} refuses what was to be written: {what}")]
    Refused {
        /// The database.
        place: String,
        /// The database's words.
        what: String,
    },
    /// This program has no driver for it.
    #[error(
        "catalog {place}: this picofarm was built without Postgres; build it with `--features postgres`, or name a SQLite file"
    )]
    NotBuilt {
        /// The database, without its password.
        place: String,
    },
    /// No right to write.
    #[error("catalog {}: cannot be written (read-only file or folder); make it writable for this user or choose another path", path.display())]
    ReadOnly {
        /// The database file.
        path: PathBuf,
    },
    /// Not a database of ours.
    #[error("catalog {place}: {what}; choose another one or restore it from a backup")]
    Unusable {
        /// The database.
        place: String,
        /// What was found.
        what: String,
    },
    /// Something changed behind the caller's back.
    #[error("catalog conflict: {0}")]
    Conflict(String),
    /// Any other answer of the database.
    #[error("catalog {place}: {source}")]
    Database {
        /// The database.
        place: String,
        /// The database's answer.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// The database's server does not let us in.
    #[error("catalog {place}: {what}")]
    Server {
        /// The database, without its password.
        place: String,
        /// What it answered, and how to correct it.
        what: String,
    },
    /// This instance was thought lost, and others have taken over what it owned.
    #[error("this coordinator was out of touch with its catalog for too long; it begins anew")]
    Fenced,
    /// It was closed before.
    #[error("the catalog is closed")]
    Closed,
}

impl CatalogError {
    /// The same in a few words without names of files and hosts, for anyone.
    pub fn brief(&self) -> &'static str {
        match self {
            Self::Full { .. } => "the catalog's disk is full",
            Self::Lost { .. } => "the catalog's file was deleted or replaced",
            Self::ReadOnly { .. } => "the catalog cannot be written (read-only)",
            Self::Server { .. } => "the catalog's server cannot be used",
            Self::Held { .. } => "another program holds the catalog",
            Self::Unusable { .. } => "the catalog is damaged",
            Self::Newer { .. } | Self::OtherSchema { .. } => "another picofarm wrote the catalog",
            Self::Fenced => "the coordinator was out of touch with its catalog",
            _ => "the catalog failed",
        }
    }

    /// The error a person can act on, for a failure of the file system while doing `what`.
    pub fn file(path: &Path, what: &'static str, source: io::Error) -> Self {
        let path = path.to_owned();
        match source.kind() {
            io::ErrorKind::PermissionDenied | io::ErrorKind::ReadOnlyFilesystem => {
                Self::ReadOnly { path }
            }
            io::ErrorKind::StorageFull => Self::Full { path },
            _ => Self::File { path, what, source },
        }
    }
}
