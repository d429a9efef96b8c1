//! Errors of a catalog.

use std::{
    io,
    path::{Path, PathBuf},
};

/// A failure to open, read or write a catalog.
#[derive(Debug, thiserror::Error)]
pub enum CatalogError {
    /// Another coordinator has the catalog open.
    #[error(
        "catalog {} is held by another coordinator ({holder}); stop that one first, or give this one a catalog of its own",
        path.display()
    )]
    Held {
        /// The database file.
        path: PathBuf,
        /// The other coordinator, as it described itself.
        holder: String,
    },
    /// A later version of the program wrote the catalog.
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
    /// A development build from another state of the source wrote the catalog: the text of one of
    /// its schema steps differs from this program's.
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
        /// The operation that failed.
        what: &'static str,
        /// The operating system's error.
        source: io::Error,
    },
    /// The disk is full.
    #[error("catalog {}: the disk is full; free some space: a coordinator that runs goes on by itself, one that did not start must be started again; no finished work is lost", path.display())]
    Full {
        /// The database file.
        path: PathBuf,
    },
    /// The open file is no longer the one at its path.
    #[error("catalog {}: {what}", path.display())]
    Lost {
        /// The database file.
        path: PathBuf,
        /// What happened to the file, and what to do.
        what: String,
    },
    /// The database rejects the content of a write, now and on every retry. Nothing was written.
    #[error("catalog {place} refuses what was to be written: {what}")]
    Refused {
        /// The database.
        place: String,
        /// The database's error message.
        what: String,
    },
    /// This program has no driver for the database.
    #[error(
        "catalog {place}: this picofarm was built without Postgres; build it with `--features postgres`, or name a SQLite file"
    )]
    NotBuilt {
        /// The database, without its password.
        place: String,
    },
    /// The file or its folder is not writable.
    #[error("catalog {}: cannot be written (read-only file or folder); make it writable for this user or choose another path", path.display())]
    ReadOnly {
        /// The database file.
        path: PathBuf,
    },
    /// The database is not a picofarm catalog.
    #[error("catalog {place}: {what}; choose another one or restore it from a backup")]
    Unusable {
        /// The database.
        place: String,
        /// A description of the content found.
        what: String,
    },
    /// The database has changed since the caller read it.
    #[error("catalog conflict: {0}")]
    Conflict(String),
    /// Any other error of the database.
    #[error("catalog {place}: {source}")]
    Database {
        /// The database.
        place: String,
        /// The database's error.
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// The database server rejects the connection.
    #[error("catalog {place}: {what}")]
    Server {
        /// The database, without its password.
        place: String,
        /// The server's answer, and how to correct the problem.
        what: String,
    },
    /// This instance was considered lost, and other instances have taken over its ranges.
    #[error("this coordinator was out of touch with its catalog for too long; it begins anew")]
    Fenced,
    /// The catalog was closed before.
    #[error("the catalog is closed")]
    Closed,
}

impl CatalogError {
    /// Returns a short description for any reader, without names of files and hosts.
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

    /// Returns an actionable error for a file system failure during the operation `what`.
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
