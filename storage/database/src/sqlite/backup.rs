//! Copies a catalog in SQLite to a file and back. `VACUUM INTO` reads one consistent state, also
//! while a coordinator writes, and makes one file without a write-ahead log. A copy gets its name
//! only after it was checked and is durable.

use std::{
    fs::{self, File},
    io,
    os::unix::fs::{MetadataExt, chown},
    path::{Path, PathBuf},
    time::Duration,
};

use sqlx::{ConnectOptions, Connection, Row, SqliteConnection, sqlite::SqliteConnectOptions};
use tempfile::NamedTempFile;

use super::errors;
use crate::{lock::CatalogLock, migrations};
use picofarm_catalog::CatalogError;

/// A copy of a catalog.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Backup {
    /// Size of the file, bytes.
    pub bytes: u64,
    /// The last step of its schema.
    pub schema: i64,
    /// Number of its jobs.
    pub jobs: u64,
}

/// A reason for which a catalog was not backed up or restored. Nothing was changed.
#[derive(Debug, thiserror::Error)]
pub enum BackupError {
    /// There is no file to copy.
    #[error("{}: there is no such file", .0.display())]
    Missing(PathBuf),
    /// The destination exists.
    #[error("{} exists already; choose another name, or replace it with --force", .0.display())]
    Exists(PathBuf),
    /// The destination is the source, or a database in use.
    #[error("{}: {}", .0.display(), .1)]
    InUse(PathBuf, &'static str),
    /// The copy cannot be written.
    #[error("{}: {}: {}", .0.display(), .1, .2)]
    Write(PathBuf, &'static str, io::Error),
    /// One of the two databases cannot be used.
    #[error(transparent)]
    Catalog(#[from] CatalogError),
}

type Result<T> = std::result::Result<T, BackupError>;

/// Copies the catalog at `catalog` to `file`. A coordinator may run meanwhile.
///
/// # Errors
/// See [`BackupError`].
pub async fn backup(catalog: &Path, file: &Path, replace: bool) -> Result<Backup> {
    check_names(catalog, file, replace)?;
    if side_file(file, "-wal").exists() {
        let what = "is a catalog that is open or was not closed; choose another name";
        return Err(BackupError::InUse(file.to_owned(), what));
    }
    let (copy, backup) = copy(catalog, file).await?;
    publish(copy, file, replace)?;
    Ok(backup)
}

/// Makes `catalog` a copy of the backup `file`. `holder` describes this process to people.
///
/// # Errors
/// See [`BackupError`]; [`CatalogError::Held`] if a coordinator uses the catalog.
pub async fn restore(file: &Path, catalog: &Path, replace: bool, holder: &str) -> Result<Backup> {
    check_names(file, catalog, replace)?;
    let folder = folder_of(catalog);
    fs::create_dir_all(folder).map_err(|e| write(catalog, "creating its folder", e))?;
    let _lock = CatalogLock::take(catalog, holder)?;
    let (copy, backup) = copy(file, catalog).await?;
    if catalog.exists() {
        keep_access(catalog, copy.path())?;
        drop_log(catalog).await?;
    }
    publish(copy, catalog, replace)?;
    Ok(backup)
}

fn check_names(from: &Path, to: &Path, replace: bool) -> Result<()> {
    let canonical = from.canonicalize();
    let canonical = canonical.map_err(|_| BackupError::Missing(from.to_owned()))?;
    if to.canonicalize().is_ok_and(|to| to == canonical) {
        let what = "is both the catalog and its copy; name two files";
        return Err(BackupError::InUse(to.to_owned(), what));
    }
    match to.exists() && !replace {
        true => Err(BackupError::Exists(to.to_owned())),
        false => Ok(()),
    }
}

fn write(path: &Path, what: &'static str, error: io::Error) -> BackupError {
    BackupError::Write(path.to_owned(), what, error)
}

fn folder_of(path: &Path) -> &Path {
    match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    }
}

fn side_file(path: &Path, suffix: &str) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(suffix);
    name.into()
}

/// Copies a checked database into a new file in the folder of `to`, and checks the copy.
async fn copy(from: &Path, to: &Path) -> Result<(NamedTempFile, Backup)> {
    let mut source = open(from, true).await?;
    check(&mut source, from).await?;
    let file = tempfile::Builder::new()
        .prefix(".picofarm-")
        .suffix(".partial")
        .tempfile_in(folder_of(to))
        .map_err(|e| write(to, "creating a file in its folder", e))?;
    let name = file.path().to_str().ok_or_else(|| {
        let what = "its folder has a name that is not UTF-8; choose another folder";
        BackupError::InUse(to.to_owned(), what)
    })?;
    let copied = sqlx::query("VACUUM INTO ?").bind(name);
    let copied = copied.execute(&mut source).await;
    copied.map_err(|e| errors::classify(from, e))?;
    close(source, from).await?;
    let mut copy = open(file.path(), true).await?;
    let backup = check(&mut copy, to).await?;
    close(copy, to).await?;
    Ok((file, backup))
}

async fn open(path: &Path, read_only: bool) -> Result<SqliteConnection> {
    let options = SqliteConnectOptions::new()
        .filename(path)
        .read_only(read_only)
        .pragma("temp_store", "MEMORY")
        .busy_timeout(Duration::from_secs(10))
        .disable_statement_logging();
    let opened = SqliteConnection::connect_with(&options).await;
    Ok(opened.map_err(|e| errors::classify(path, e))?)
}

async fn close(connection: SqliteConnection, path: &Path) -> Result<()> {
    let closed = connection.close().await;
    Ok(closed.map_err(|e| errors::classify(path, e))?)
}

/// Checks that a database is a sound catalog whose schema this program knows.
async fn check(c: &mut SqliteConnection, path: &Path) -> Result<Backup> {
    let failed = |e| errors::classify(path, e);
    let unusable = |what: String| CatalogError::Unusable {
        place: path.display().to_string(),
        what,
    };
    let schema = check_schema(c, path).await?;
    let verdict: Vec<String> = sqlx::query_scalar("PRAGMA integrity_check(3)")
        .fetch_all(&mut *c)
        .await
        .map_err(failed)?;
    if verdict != ["ok"] {
        let what = format!("the database is damaged ({})", verdict.join("; "));
        return Err(unusable(what).into());
    }
    let orphans = sqlx::query("PRAGMA foreign_key_check");
    let orphans = orphans.fetch_optional(&mut *c).await.map_err(failed)?;
    if orphans.is_some() {
        return Err(unusable("the database is damaged (rows refer to missing rows)".into()).into());
    }
    let counts = "SELECT (SELECT count(*) FROM job), page_count * page_size \
                  FROM pragma_page_count, pragma_page_size";
    let (jobs, bytes): (i64, i64) = sqlx::query_as(counts).fetch_one(c).await.map_err(failed)?;
    Ok(Backup {
        bytes: bytes.unsigned_abs(),
        schema,
        jobs: jobs.unsigned_abs(),
    })
}

/// Returns the last step of a catalog's schema, if all its steps are this program's.
async fn check_schema(c: &mut SqliteConnection, path: &Path) -> Result<i64> {
    let failed = |e| errors::classify(path, e);
    let place = || path.display().to_string();
    let tables = "SELECT count(*) FROM sqlite_master WHERE name = '_sqlx_migrations'";
    let tables: i64 = sqlx::query_scalar(tables)
        .fetch_one(&mut *c)
        .await
        .map_err(failed)?;
    let steps = "SELECT version, checksum FROM _sqlx_migrations ORDER BY version";
    let steps = match tables {
        0 => Vec::new(),
        _ => sqlx::query(steps).fetch_all(c).await.map_err(failed)?,
    };
    let mut last = None;
    for step in &steps {
        let version: i64 = step.try_get(0).map_err(failed)?;
        let checksum: Vec<u8> = step.try_get(1).map_err(failed)?;
        let known = &migrations::SQLITE;
        let Some(ours) = known.iter().find(|m| m.version == version) else {
            return Err(CatalogError::Newer {
                place: place(),
                found: version,
                known: migrations::latest(known),
            }
            .into());
        };
        let former = version == 1 && migrations::SQLITE_FORMER.matches(&checksum);
        if *ours.checksum != *checksum && !former {
            let place = place();
            return Err(CatalogError::OtherSchema {
                place,
                step: version,
            }
            .into());
        }
        last = Some(version);
    }
    let what = "the file is a SQLite database, but no catalog of picofarm".to_owned();
    let unusable = || CatalogError::Unusable {
        place: place(),
        what,
    };
    Ok(last.ok_or_else(unusable)?)
}

/// Gives a copy the mode and the owner of the catalog that it replaces.
fn keep_access(catalog: &Path, copy: &Path) -> Result<()> {
    let failed = |e| write(catalog, "keeping its owner and mode", e);
    let former = fs::metadata(catalog).map_err(failed)?;
    let now = fs::metadata(copy).map_err(failed)?;
    if (former.uid(), former.gid()) != (now.uid(), now.gid()) {
        chown(copy, Some(former.uid()), Some(former.gid())).map_err(failed)?;
    }
    fs::set_permissions(copy, former.permissions()).map_err(failed)
}

/// Moves the log of a closed catalog that is about to be replaced into its file, so that the log
/// never meets the new file.
async fn drop_log(catalog: &Path) -> Result<()> {
    let folded = async {
        let mut c = open(catalog, false).await?;
        let fold = sqlx::query("PRAGMA wal_checkpoint(TRUNCATE)");
        let folded = fold.execute(&mut c).await;
        folded.map_err(|e| errors::classify(catalog, e))?;
        close(c, catalog).await
    };
    if let Err(error) = folded.await {
        tracing::warn!(%error, "the log of the replaced catalog is lost with it");
    }
    for suffix in ["-wal", "-shm"] {
        match fs::remove_file(side_file(catalog, suffix)) {
            Err(e) if e.kind() != io::ErrorKind::NotFound => {
                return Err(write(catalog, "removing its log", e));
            }
            _ => {}
        }
    }
    Ok(())
}

/// Gives a copy its name.
fn publish(copy: NamedTempFile, to: &Path, replace: bool) -> Result<()> {
    let failed = |e| write(to, "writing it", e);
    copy.as_file().sync_all().map_err(failed)?;
    let named = match replace {
        true => copy.persist(to),
        false => copy.persist_noclobber(to),
    };
    match named {
        Ok(_) => {}
        Err(e) if e.error.kind() == io::ErrorKind::AlreadyExists => {
            return Err(BackupError::Exists(to.to_owned()));
        }
        Err(e) => return Err(failed(e.error)),
    }
    let folder = File::open(folder_of(to));
    folder.and_then(|folder| folder.sync_all()).map_err(failed)
}
