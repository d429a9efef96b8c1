//! Queries about owners and the audit log, for one database: `rights_queries!(SqliteConnection,
//! SqliteRow)` generates a module `rights_query`, which uses the module `query` (see
//! [`crate::sql`]).

macro_rules! rights_queries {
    ($connection:ty, $row:ty) => {
        pub(crate) mod rights_query {
            use picofarm_proto::{ids::JobId, messages::{Act, AuditEntry, Outcome}};
            use sqlx::{Connection as _, QueryBuilder, Row};
            use uuid::Uuid;

            use super::query::uint;
            use picofarm_catalog::{AuditQuery, NewAudit, OwnedPlace, Owner, ResultSet};
            use crate::sql::bad;

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

            /// Returns the owned places that are equal to this one, inside it, or around it.
            pub(crate) async fn owned_near(c: &mut Connection, place: &str) -> Result<Vec<OwnedPlace>> {
                // A place ends with a slash, so every place inside it sorts before the same text
                // with the next character.
                let after = format!("{}0", place.trim_end_matches('/'));
                let mut query = QueryBuilder::<<$connection as sqlx::Connection>::Database>::new(
                    "SELECT * FROM owned_place WHERE ((place >= ",
                );
                query.push_bind(place).push(" AND place < ").push_bind(after).push(") OR place IN (");
                let mut around = query.separated(", ");
                for (at, _) in place.match_indices('/') {
                    around.push_bind(&place[..=at]);
                }
                query.push(
                    ")) AND (NOT EXISTS (SELECT 1 FROM job WHERE job.id = owned_place.job) \
                       OR EXISTS (SELECT 1 FROM job WHERE job.id = owned_place.job AND (job.state = 0 \
                         OR EXISTS (SELECT 1 FROM stage WHERE stage.job = job.key AND (stage.done > 0 \
                           OR EXISTS (SELECT 1 FROM task_range WHERE task_range.stage = stage.key \
                             AND task_range.state IN (2, 3))))))) ORDER BY place",
                );
                let rows = query.build().fetch_all(c).await?;
                rows.iter().map(owned_place).collect()
            }

            pub(crate) async fn largest_stage(c: &mut Connection, set: &ResultSet, user: &str) -> Result<u64> {
                let row = sqlx::query(
                    "SELECT COALESCE(MAX(stage.tasks), 0) AS tasks FROM stage JOIN job ON job.key = stage.job \
                     JOIN result_set ON result_set.key = stage.result_set \
                     WHERE store = $1 AND dataset = $2 AND stage_key = $3 AND job.username = $4",
                )
                .bind(&set.store)
                .bind(&set.dataset)
                .bind(&set.stage_key.0[..])
                .bind(user)
                .fetch_one(c)
                .await?;
                uint(&row, "tasks")
            }

            fn owned_place(row: &DbRow) -> Result<OwnedPlace> {
                Ok(OwnedPlace {
                    place: row.try_get("place")?,
                    record: row.try_get("record")?,
                    owner: Owner {
                        user: row.try_get("username")?,
                        project: row.try_get("project")?,
                    },
                    job: JobId::from_uuid(row.try_get("job")?),
                })
            }

            /// Returns the job's places that no other user owns, which its submitter will own.
            /// Returns `None` if another user owns a place that the submitter is not permitted to
            /// write into.
            pub(crate) async fn free_places<'a>(
                c: &mut Connection,
                places: &'a [OwnedPlace],
                permitted: &[String],
            ) -> Result<Option<Vec<&'a OwnedPlace>>> {
                let mut free = Vec::new();
                for mine in places {
                    let near = owned_near(&mut *c, &mine.place).await?;
                    let others = near.iter().filter(|o| o.record == mine.record && o.owner.user != mine.owner.user);
                    let mut others = others.peekable();
                    if others.peek().is_none() {
                        free.push(mine);
                    } else if others.any(|other| !permitted.contains(&other.place)) {
                        return Ok(None);
                    }
                }
                Ok(Some(free))
            }

            /// Records the submitter as the owner of these places.
            pub(crate) async fn take_places(c: &mut Connection, places: &[&OwnedPlace]) -> Result<()> {
                for mine in places {
                    // If the place still has another owner, it belongs to a job that left no
                    // results.
                    sqlx::query("DELETE FROM owned_place WHERE place = $1 AND record = $2 AND username <> $3")
                        .bind(&mine.place)
                        .bind(mine.record)
                        .bind(&mine.owner.user)
                        .execute(&mut *c)
                        .await?;
                    sqlx::query(
                        "INSERT INTO owned_place (place, record, username, project, job) VALUES ($1, $2, $3, $4, $5) \
                         ON CONFLICT (place, record) DO UPDATE SET project = excluded.project, job = excluded.job",
                    )
                    .bind(&mine.place)
                    .bind(mine.record)
                    .bind(&mine.owner.user)
                    .bind(&mine.owner.project)
                    .bind(mine.job.uuid())
                    .execute(&mut *c)
                    .await?;
                }
                Ok(())
            }

            /// Appends entries in one transaction.
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
