//! Databases for tests. Each test gets its own, on the server that PICOFARM_TEST_POSTGRES names.

use sqlx::{Connection, PgConnection, SqliteConnection};
use uuid::Uuid;

use crate::CatalogPlace;

/// The environment variable with the URL of a server on which tests may create databases.
pub const VARIABLE: &str = "PICOFARM_TEST_POSTGRES";

/// Returns the URL of a new, empty Postgres database. If no server is configured, prints a note to
/// stderr and returns `None`.
///
/// # Panics
/// If a server is configured but no database can be created on it.
pub async fn postgres() -> Option<String> {
    let Ok(server) = std::env::var(VARIABLE) else {
        eprintln!("SKIPPED: {VARIABLE} names no Postgres server; tests/run starts one");
        return None;
    };
    let name = format!("t{}", Uuid::new_v4().simple());
    let mut connection = PgConnection::connect(&server)
        .await
        .expect("the test server answers");
    sqlx::query(sqlx::AssertSqlSafe(format!("CREATE DATABASE {name}")))
        .execute(&mut connection)
        .await
        .expect("the test server makes databases");
    let (base, options) = server.split_once('?').unwrap_or((&server, ""));
    let base = base
        .rsplit_once('/')
        .map_or(base, |(address, _database)| address);
    Some(format!("{base}/{name}?{options}"))
}

/// Expires an instance, as if its process had been stopped for too long.
///
/// # Panics
/// If the database cannot be written.
pub async fn lose_instance(url: &str, instance: picofarm_proto::ids::InstanceId) {
    let mut connection = PgConnection::connect(url)
        .await
        .expect("the test database answers");
    sqlx::query(
        "UPDATE instance SET until = clock_timestamp() - interval '1 second' WHERE id = $1",
    )
    .bind(instance.uuid())
    .execute(&mut connection)
    .await
    .expect("the instance is there");
}

/// Blocks all other writes to a SQLite catalog until the value is dropped, as a slow disk would.
///
/// # Panics
/// If the file cannot be opened or another writer blocks it for too long.
pub async fn hold_writes(path: &std::path::Path) -> SqliteConnection {
    let options = sqlx::sqlite::SqliteConnectOptions::new().filename(path);
    let options = options.busy_timeout(std::time::Duration::from_secs(10));
    let mut connection = SqliteConnection::connect_with(&options)
        .await
        .expect("the catalog can be opened");
    sqlx::query("BEGIN IMMEDIATE")
        .execute(&mut connection)
        .await
        .expect("nobody writes for ever");
    connection
}

/// Makes a database reject rows because of their content, like an unforeseen limit of the database:
/// outputs of 666 bytes; error messages, history events and stores that begin with `poison`; and
/// workers of that name.
///
/// # Panics
/// If the database cannot be changed.
pub async fn refuse_poison(place: &CatalogPlace) {
    let rules = [
        ("output", "bytes = 666"),
        ("exception", "last_error LIKE 'poison%'"),
        ("event", "message LIKE 'poison%'"),
        ("worker", "name = 'poison'"),
        ("result_set", "store LIKE '/poison%'"),
    ];
    match place {
        CatalogPlace::Postgres(url) => {
            let mut c = PgConnection::connect(url).await.expect("it answers");
            for (table, rule) in rules {
                let text = format!("ALTER TABLE {table} ADD CHECK (NOT ({rule}))");
                let added = sqlx::query(sqlx::AssertSqlSafe(text)).execute(&mut c).await;
                added.expect("the table is there");
            }
        }
        CatalogPlace::Sqlite(path) => {
            let url = format!("sqlite://{}", path.display());
            let mut c = SqliteConnection::connect(&url).await.expect("it opens");
            for (table, rule) in rules {
                let text = format!(
                    "CREATE TRIGGER no_poison_{table} BEFORE INSERT ON {table} WHEN NEW.{rule} \
                     BEGIN SELECT RAISE(ABORT, 'the test refuses this'); END"
                );
                let added = sqlx::query(sqlx::AssertSqlSafe(text)).execute(&mut c).await;
                added.expect("the table is there");
            }
        }
    }
}
