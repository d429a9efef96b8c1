//! Databases for tests: each test its own, on the server that PICOFARM_TEST_POSTGRES names.

use sqlx::{Connection, PgConnection};
use uuid::Uuid;

/// The variable that holds the URL of a server on which tests may create databases.
pub const VARIABLE: &str = "PICOFARM_TEST_POSTGRES";

/// The URL of a new, empty Postgres database; `None`, with a word on stderr, where no server is named.
///
/// # Panics
/// When a server is named and no database can be made on it.
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

/// Lets a house's time run out, as if its process had been stopped for too long.
///
/// # Panics
/// When the database cannot be written.
pub async fn lose_house(url: &str, house: picofarm_proto::ids::HouseId) {
    let mut connection = PgConnection::connect(url)
        .await
        .expect("the test database answers");
    sqlx::query("UPDATE house SET until = clock_timestamp() - interval '1 second' WHERE id = $1")
        .bind(house.uuid())
        .execute(&mut connection)
        .await
        .expect("the house is there");
}
