//! SQLite's result codes in words. Codes: <https://www.sqlite.org/rescode.html>.

use std::path::Path;

use crate::CatalogError;

const BUSY: i32 = 5;
const READONLY: i32 = 8;
const CORRUPT: i32 = 11;
const FULL: i32 = 13;
const CANTOPEN: i32 = 14;
const CONSTRAINT: i32 = 19;
const NOTADB: i32 = 26;
/// The log's index could not grow; seen on a full disk where SQLITE_FULL might be expected.
const IOERR_SHMSIZE: i32 = 4874;

/// The error a person can act on.
pub(super) fn classify(path: &Path, error: sqlx::Error) -> CatalogError {
    let path = path.to_owned();
    if let sqlx::Error::ColumnDecode { index, source } = &error {
        return CatalogError::Unusable {
            place: path.display().to_string(),
            what: format!("column {index} cannot be read ({source})"),
        };
    }
    let code = error
        .as_database_error()
        .and_then(|e| e.code())
        .and_then(|code| code.parse::<i32>().ok());
    if code == Some(IOERR_SHMSIZE) {
        return CatalogError::Full { path };
    }
    // The low byte is the primary code.
    match code.map(|code| code & 0xff) {
        Some(FULL) => CatalogError::Full { path },
        Some(READONLY) => CatalogError::ReadOnly { path },
        Some(CANTOPEN) => CatalogError::Unusable {
            place: path.display().to_string(),
            what: "the file cannot be opened (is it a folder, or not this user's?)".into(),
        },
        Some(NOTADB) => CatalogError::Unusable {
            place: path.display().to_string(),
            what: "the file is not a SQLite database".into(),
        },
        Some(CORRUPT) => CatalogError::Unusable {
            place: path.display().to_string(),
            what: "the database is damaged".into(),
        },
        Some(BUSY) => CatalogError::Held {
            path,
            holder: "a program that is not a coordinator, such as the sqlite3 shell".into(),
        },
        Some(CONSTRAINT) => CatalogError::Conflict(error.to_string()),
        _ => CatalogError::Database {
            place: path.display().to_string(),
            source: error,
        },
    }
}
