//! Hints: an instance that has changed something wakes the others by NOTIFY, at most a few times a
//! second.

use std::{
    sync::Mutex,
    time::{Duration, Instant},
};

use sqlx::{PgPool, postgres::PgListener};

/// The minimum time between two hints to the others.
const HINTS: Duration = Duration::from_millis(100);
/// The NOTIFY channel of the hints.
const CHANNEL: &str = "picofarm";

/// Sender and receiver of hints.
pub(super) struct Hints {
    pool: PgPool,
    heard: tokio::sync::Mutex<Option<PgListener>>,
    sent: Mutex<Option<Instant>>,
}

impl Hints {
    /// Starts listening.
    pub(super) async fn new(pool: PgPool) -> Result<Self, sqlx::Error> {
        let listener = listen(&pool).await?;
        Ok(Self {
            pool,
            heard: tokio::sync::Mutex::new(Some(listener)),
            sent: Mutex::new(None),
        })
    }

    /// Wakes the other instances, unless they have just been woken.
    pub(super) async fn give(&self) {
        {
            let mut sent_at = self.sent.lock().expect("no panic while locked");
            if sent_at.is_some_and(|at| at.elapsed() < HINTS) {
                return;
            }
            *sent_at = Some(Instant::now());
        }
        let sent = sqlx::query("SELECT pg_notify($1, '')")
            .bind(CHANNEL)
            .execute(&self.pool)
            .await;
        if let Err(error) = sent {
            tracing::debug!(%error, "no hint sent; the others ask by themselves");
        }
    }

    /// Waits for a hint from another instance.
    pub(super) async fn heard(&self) {
        let mut hints = self.heard.lock().await;
        loop {
            if let Some(listener) = hints.as_mut() {
                match listener.recv().await {
                    Ok(_) => return,
                    Err(error) => tracing::debug!(%error, "no more hints; trying again"),
                }
                *hints = None;
            }
            tokio::time::sleep(Duration::from_secs(2)).await;
            *hints = listen(&self.pool).await.ok();
        }
    }

    /// Stops listening, so that the pool can be closed.
    pub(super) fn end(&self) {
        if let Ok(mut hints) = self.heard.try_lock() {
            hints.take();
        }
    }
}

async fn listen(pool: &PgPool) -> Result<PgListener, sqlx::Error> {
    let mut listener = PgListener::connect_with(pool).await?;
    listener.listen(CHANNEL).await?;
    Ok(listener)
}
