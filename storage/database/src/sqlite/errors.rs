//! Messages for SQLite's result codes. Codes: <https://www.sqlite.org/rescode.html>.

use std::path::Path;

use picofarm_catalog::CatalogError;

const BUSY: i32 = 5;
const READONLY: i32 = 8;
const CORRUPT: i32 = 11;
const FULL: i32 = 13;
const CANTOPEN: i32 = 14;
const TOOBIG: i32 = 18;
const CONSTRAINT: i32 = 19;
/// Constraints on the content of a row, which fail in every state of the database: CHECK, NOT NULL,
/// a trigger's RAISE, and a value of the wrong type.
const CONTENT: [i32; 4] = [275, 1299, 1811, 3091];
const NOTADB: i32 = 26;
/// The index of the write-ahead log could not grow. SQLite returns this on a full disk, where one
/// might expect SQLITE_FULL.
const IOERR_SHMSIZE: i32 = 4874;

fn message_of(error: &sqlx::Error) -> String {
    error
        .as_database_error()
        .map_or_else(|| error.to_string(), |e| e.message().to_owned())
}

/// Returns an actionable error.
pub(super) fn classify(path: &Path, error: sqlx::Error) -> CatalogError {
    let path = path.to_owned();
    if let sqlx::Error::ColumnDecode { index, source } = &error {
        return CatalogError::Unusable {
            place: path.display().to_string(),
            what: format!("column {index} cannot be read ({source})"),
        };
    }
    if let sqlx::Error::Encode(_) = &error {
        return CatalogError::Refused {
            place: path.display().to_string(),
            what: error.to_string(),
        };
    }
    let refused = || CatalogError::Refused {
        place: path.display().to_string(),
        what: message_of(&error),
    };
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
        Some(TOOBIG) => refused(),
        Some(CONSTRAINT) if code.is_some_and(|code| CONTENT.contains(&code)) => refused(),
        Some(CONSTRAINT) => CatalogError::Conflict(error.to_string()),
        _ => CatalogError::Database {
            place: path.display().to_string(),
            source: error.into(),
        },
    }
}
