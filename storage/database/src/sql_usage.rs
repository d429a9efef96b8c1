//! Queries about usage, for one database: `usage_queries!(SqliteConnection, SqliteRow)` generates a
//! module `usage_query`, which uses the module `query` (see [`crate::sql`]).

/// The text of a usage query, for the expression to sum by.
macro_rules! usage_by {
    ($name:literal) => {
        concat!(
            "SELECT ",
            $name,
            " AS name, CAST(SUM(tasks) AS BIGINT) AS tasks, CAST(SUM(failures) AS BIGINT) AS failures, \
             CAST(SUM(core_ms) AS BIGINT) AS core_ms, CAST(SUM(bytes) AS BIGINT) AS bytes \
             FROM usage AS job WHERE day >= $1 AND day < $2 AND ",
            crate::seen::seen!("$3", "$4", "$5"),
            " GROUP BY 1 ORDER BY 1"
        )
    };
}
pub(crate) use usage_by;

macro_rules! usage_queries {
    ($connection:ty, $row:ty) => {
        pub(crate) mod usage_query {
            use picofarm_proto::messages::{Usage, UsageBy, UsageRow};
            use sqlx::Row;
            use uuid::Uuid;

            use super::query::uint;
            use crate::{sql::int, sql_usage::usage_by};
            use picofarm_catalog::UsageQuery;

            type Connection = $connection;
            type DbRow = $row;
            type Result<T> = std::result::Result<T, sqlx::Error>;

            /// Sums stop growing beyond this, so that impossible reports make none overflow.
            const MOST: u64 = 1 << 53;

            /// Adds what tasks of the job with this key consumed on a day.
            pub(crate) async fn add(
                c: &mut Connection,
                instance: Uuid,
                (day, job): (i64, i64),
                usage: &Usage,
            ) -> Result<()> {
                sqlx::query(
                    "INSERT INTO usage (day, username, project, instance, tasks, failures, core_ms, bytes) \
                     SELECT $1, username, project, $3, $4, $5, $6, $7 FROM job WHERE key = $2 \
                     ON CONFLICT (day, username, project, instance) DO UPDATE SET tasks = usage.tasks + excluded.tasks, \
                     failures = usage.failures + excluded.failures, \
                     core_ms = CASE WHEN usage.core_ms < $8 THEN usage.core_ms + excluded.core_ms ELSE usage.core_ms END, \
                     bytes = CASE WHEN usage.bytes < $8 THEN usage.bytes + excluded.bytes ELSE usage.bytes END",
                )
                .bind(day)
                .bind(job)
                .bind(instance)
                .bind(int(usage.tasks))
                .bind(int(usage.failures))
                .bind(int(usage.core_ms.min(MOST)))
                .bind(int(usage.bytes.min(MOST)))
                .bind(int(MOST))
                .execute(c)
                .await?;
                Ok(())
            }

            pub(crate) async fn usage(c: &mut Connection, query: &UsageQuery) -> Result<Vec<UsageRow>> {
                let [all, user, projects] = crate::seen::columns(&query.sight);
                let text = match query.by {
                    UsageBy::User => usage_by!("username"),
                    UsageBy::Project => usage_by!("project"),
                    UsageBy::Day => usage_by!("CAST(day AS TEXT)"),
                };
                let rows = sqlx::query(text)
                    .bind(query.since_day)
                    .bind(query.until_day)
                    .bind(all)
                    .bind(user)
                    .bind(projects)
                    .fetch_all(c)
                    .await?;
                rows.iter().map(row).collect()
            }

            fn row(row: &DbRow) -> Result<UsageRow> {
                Ok(UsageRow {
                    name: row.try_get("name")?,
                    usage: Usage {
                        tasks: uint(row, "tasks")?,
                        failures: uint(row, "failures")?,
                        core_ms: uint(row, "core_ms")?,
                        bytes: uint(row, "bytes")?,
                    },
                })
            }
        }
    };
}

pub(crate) use usage_queries;
