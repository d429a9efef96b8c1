//! The queries about owners and the audit log, for one database: `rights_queries!(SqliteConnection, SqliteRow)` makes a
//! module `rights_query` beside `query` (see [`crate::sql`]).

macro_rules! rights_queries {
    ($connection:ty, $row:ty) => {
        pub(crate) mod rights_query {
            use picofarm_proto::{
                ids::JobId,
                model::{Act, AuditEntry, Outcome},
            };
            use sqlx::{Connection as _, Row};
            use uuid::Uuid;

            use super::query::uint;
            use picofarm_catalog::{AuditQuery, NewAudit, Owner};
            use crate::{sql::bad};

            type Connection = $connection;
            type DbRow = $row;
            type Result<T> = std::result::Result<T, sqlx::Error>;

            pub(crate) async fn owner(c: &mut Connection, job: JobId) -> Result<Option<Owner>> {
                let row = sqlx::query("SELECT username, project FROM job WHERE id = $1")
                    .bind(job.uuid())
                    .fetch_optional(c)
                    .await?;
                row.map(|row| {
                    Ok(Owner {
                        user: row.try_get("username")?,
                        project: row.try_get("project")?,
                    })
                })
                .transpose()
            }

            /// Appends lines in one transaction.
            pub(crate) async fn audit(c: &mut Connection, lines: &[NewAudit]) -> Result<()> {
                let mut tx = c.begin().await?;
                for line in lines {
                    sqlx::query(
                        "INSERT INTO audit (at_ms, who, act, job, outcome, detail) VALUES ($1, $2, $3, $4, $5, $6)",
                    )
                    .bind(line.at_ms)
                    .bind(&line.who)
                    .bind(line.act.name())
                    .bind(line.job.map(JobId::uuid))
                    .bind(line.outcome.name())
                    .bind(&line.detail)
                    .execute(&mut *tx)
                    .await?;
                }
                tx.commit().await
            }

            pub(crate) async fn audited(c: &mut Connection, query: &AuditQuery) -> Result<Vec<AuditEntry>> {
                let rows = sqlx::query(
                    "SELECT * FROM audit WHERE sequence < $1 AND (CAST($2 AS TEXT) IS NULL OR who = $2) \
                     AND ($3 IS NULL OR job = $3) ORDER BY sequence DESC LIMIT $4",
                )
                .bind(query.before.and_then(|n| i64::try_from(n).ok()).unwrap_or(i64::MAX))
                .bind(&query.who)
                .bind(query.job.map(JobId::uuid))
                .bind(i64::from(query.limit))
                .fetch_all(c)
                .await?;
                rows.iter().map(entry).collect()
            }

            fn entry(row: &DbRow) -> Result<AuditEntry> {
                let (act, outcome): (String, String) = (row.try_get("act")?, row.try_get("outcome")?);
                let job: Option<Uuid> = row.try_get("job")?;
                Ok(AuditEntry {
                    sequence: uint(row, "sequence")?,
                    at_ms: row.try_get("at_ms")?,
                    who: row.try_get("who")?,
                    act: Act::named(&act).ok_or_else(|| bad("act", act))?,
                    job: job.map(JobId::from_uuid),
                    outcome: Outcome::named(&outcome).ok_or_else(|| bad("outcome", outcome))?,
                    detail: row.try_get("detail")?,
                })
            }

            pub(crate) async fn forget_audit(c: &mut Connection, before_ms: i64) -> Result<u64> {
                let gone = sqlx::query("DELETE FROM audit WHERE at_ms < $1")
                    .bind(before_ms)
                    .execute(c)
                    .await?;
                Ok(gone.rows_affected())
            }
        }
    };
}

pub(crate) use rights_queries;
