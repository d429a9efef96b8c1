//! Makes the core's decisions durable, and then sends its messages.

use std::time::Instant;

use picofarm_catalog::{CatalogError, Changes, Settled};

use super::Life;
use crate::{
    core::{SessionId, ToWorker},
    observe::trace,
};

impl Life<'_> {
    /// Commits a change set without the rows that the catalog rejects for their content. The tasks
    /// of those rows are handled by [`Core::refused`]; [`picofarm_catalog::culprits`] finds them.
    ///
    /// # Errors
    /// Returns the errors of a commit, or `error` if no row is at fault.
    async fn commit_the_rest(
        &mut self,
        changes: &mut Changes,
        say: &mut [(SessionId, ToWorker)],
        mut error: CatalogError,
    ) -> Result<Settled, CatalogError> {
        let catalog = &self.actor.catalog;
        // The first attempt rewords the rejected rows; the second leaves them out.
        for again in [false, true] {
            let culprits = picofarm_catalog::culprits(catalog.as_ref(), changes).await?;
            if culprits.is_empty() {
                break;
            }
            let now = self.actor.clock.now_ms();
            self.core.refused(changes, say, &culprits, again, now);
            match catalog.commit(changes).await {
                Err(refused @ CatalogError::Refused { .. }) => error = refused,
                settled => return settled,
            }
        }
        Err(error)
    }

    /// Makes the core's decisions durable, then sends its messages.
    pub(super) async fn flush(&mut self) -> Result<(), CatalogError> {
        let (mut changes, mut say) = self.core.take();
        // A span ends when the operation it measures is durable.
        let _grants = trace::grants(&mut say);
        let _commits = std::mem::take(&mut self.commits);
        let changed = !changes.is_empty();
        let began = Instant::now();
        let settled = match self.actor.catalog.commit(&changes).await {
            Err(error @ CatalogError::Refused { .. }) => {
                self.commit_the_rest(&mut changes, &mut say, error).await?
            }
            settled => settled?,
        };
        let mut tally = std::mem::take(&mut self.tally);
        tally.note(&changes, &say);
        self.actor.metrics.add(&tally);
        if changed {
            self.actor.metrics.committed(began.elapsed());
        }
        self.core.settled(&settled);
        let mut deaf = Vec::new();
        for (session, what) in say {
            let over = what == ToWorker::Replaced;
            let Some(sender) = self.sessions.get(session) else {
                continue;
            };
            if let Err(error) = sender.try_send(what) {
                tracing::warn!(session, %error, "the worker does not listen; its session ends");
                deaf.push(session);
            }
            if over {
                self.sessions.close(session);
            }
        }
        let heard = changed || !deaf.is_empty();
        for session in deaf {
            self.sessions.close(session);
            let now = self.now();
            self.core.closed(session, now);
        }
        if heard {
            self.actor.revision.send_modify(|n| *n += 1);
        }
        Ok(())
    }
}
