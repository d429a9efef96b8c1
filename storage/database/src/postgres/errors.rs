//! Actionable error messages for Postgres.

use std::time::Duration;

use sqlx::{Connection, PgConnection, postgres::PgConnectOptions};

use picofarm_catalog::CatalogError;

/// Returns the location of the database, without its password.
pub(super) fn place(options: &PgConnectOptions) -> String {
    let database = options.get_database().unwrap_or("");
    match options.get_socket() {
        Some(socket) => format!("postgres:///{database} at {}", socket.display()),
        None => format!(
            "postgres://{}@{}:{}/{database}",
            options.get_username(),
            options.get_host(),
            options.get_port()
        ),
    }
}

/// Returns the error for an invalid URL. The URL may contain a password, so it is not repeated.
pub(super) fn bad_url(_: &str, error: &sqlx::Error) -> CatalogError {
    CatalogError::Server {
        place: "postgres://…".into(),
        what: format!(
            "the URL cannot be read ({error}); expected postgres://user:password@host:5432/database"
        ),
    }
}

/// Returns the reason why no connection was made. A pool retries while a port refuses, and finally
/// reports only a timeout, so one direct attempt determines the reason.
pub(super) async fn unconnected(
    place: &str,
    options: &PgConnectOptions,
    error: sqlx::Error,
) -> CatalogError {
    const PROBE: Duration = Duration::from_secs(3);
    if matches!(error, sqlx::Error::PoolTimedOut) {
        let probe = PgConnection::connect_with(options);
        if let Ok(Err(cause)) = tokio::time::timeout(PROBE, probe).await {
            return classify(place, cause);
        }
    }
    classify(place, error)
}

/// Returns an actionable error. Codes: Postgres, appendix A.
pub(super) fn classify(place: &str, error: sqlx::Error) -> CatalogError {
    let place = place.to_owned();
    let server = |what: String| CatalogError::Server {
        place: place.clone(),
        what,
    };
    match &error {
        sqlx::Error::ColumnDecode { index, source } => {
            return CatalogError::Unusable {
                place,
                what: format!("column {index} cannot be read ({source})"),
            };
        }
        sqlx::Error::Io(e) => {
            return server(format!(
                "the server cannot be reached ({e}); is it running, and is the address right?"
            ));
        }
        sqlx::Error::PoolTimedOut => {
            return server("no connection came about in time; is the server overloaded, or its limit of connections reached?".into());
        }
        sqlx::Error::PoolClosed => return CatalogError::Closed,
        sqlx::Error::Encode(_) => {
            return CatalogError::Refused {
                place,
                what: error.to_string(),
            };
        }
        _ => {}
    }
    let code = error
        .as_database_error()
        .and_then(|e| e.code())
        .map(|code| code.into_owned());
    let said = error
        .as_database_error()
        .map(|e| e.message().to_owned())
        .unwrap_or_default();
    match code.as_deref() {
        Some("28P01" | "28000") => server(format!(
            "{said}; check user and password (PGPASSWORD or the URL) and the server's pg_hba.conf"
        )),
        Some("3D000") => server(format!("{said}; create it with `createdb`")),
        Some("42501") => server(format!(
            "{said}; the user must own the database, or be granted CREATE on its schema"
        )),
        Some("53300") => server(format!(
            "{said}; raise max_connections, or run fewer programs on it"
        )),
        Some("53100") => server(format!(
            "the server's disk is full ({said}); free some space: no finished work is lost"
        )),
        Some("57P01" | "57P02" | "57P03") => {
            server(format!("{said}; the server is stopping or starting"))
        }
        // Errors of the content: data exceptions, program limits, NOT NULL and CHECK.
        Some(code) if code.starts_with("22") || code.starts_with("54") => {
            CatalogError::Refused { place, what: said }
        }
        Some("23502" | "23514") => CatalogError::Refused { place, what: said },
        Some("23505" | "23503" | "40001" | "40P01") => {
            CatalogError::Conflict(format!("{said} ({})", code.unwrap_or_default()))
        }
        _ => CatalogError::Database {
            place,
            source: error.into(),
        },
    }
}
