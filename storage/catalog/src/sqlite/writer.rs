//! The one writer: takes commits from any number of callers, puts those that wait into one transaction, and
//! answers after it is durable. Measured elsewhere: one fsync shared by many callers is what makes SQLite fast.

use std::path::PathBuf;

use sqlx::{Connection, SqliteConnection};
use tokio::sync::{mpsc, oneshot};

use super::{apply, errors};
use crate::{CatalogError, Changes};

/// Commits that may wait; more callers wait for room.
const QUEUE: usize = 1024;
/// Commits in one transaction.
const GROUP: usize = 512;

type Reply = oneshot::Sender<Result<(), CatalogError>>;

enum Command {
    Commit(Box<Changes>, Reply),
    Close(oneshot::Sender<()>),
}

pub(super) struct Writer {
    commands: mpsc::Sender<Command>,
}

impl Writer {
    pub(super) fn start(path: PathBuf, connection: SqliteConnection) -> Self {
        let (commands, queue) = mpsc::channel(QUEUE);
        tokio::spawn(run(path, connection, queue));
        Self { commands }
    }

    pub(super) async fn commit(&self, changes: Changes) -> Result<(), CatalogError> {
        let (reply, answer) = oneshot::channel();
        self.commands
            .send(Command::Commit(Box::new(changes), reply))
            .await
            .map_err(|_| CatalogError::Closed)?;
        answer.await.map_err(|_| CatalogError::Closed)?
    }

    pub(super) async fn close(&self) {
        let (reply, answer) = oneshot::channel();
        // A writer that has stopped is closed.
        if self.commands.send(Command::Close(reply)).await.is_ok() {
            let _ = answer.await;
        }
    }
}

async fn run(path: PathBuf, mut connection: SqliteConnection, mut queue: mpsc::Receiver<Command>) {
    let mut keys = apply::Keys::default();
    let mut waiting = Vec::with_capacity(GROUP);
    let mut closing = None;
    while closing.is_none() && queue.recv_many(&mut waiting, GROUP).await > 0 {
        let mut group = Vec::with_capacity(waiting.len());
        for command in waiting.drain(..) {
            match command {
                Command::Commit(changes, reply) if closing.is_none() => {
                    group.push((*changes, reply));
                }
                Command::Commit(_, reply) => {
                    let _ = reply.send(Err(CatalogError::Closed));
                }
                Command::Close(reply) => closing = Some(reply),
            }
        }
        commit_group(&path, &mut connection, &mut keys, group).await;
    }
    if let Err(error) = connection.close().await {
        tracing::warn!(%error, "closing the catalog");
    }
    if let Some(reply) = closing {
        let _ = reply.send(());
    }
}

/// One transaction for all; where they cannot stand together, one for each, so that only the guilty one fails.
async fn commit_group(
    path: &std::path::Path,
    connection: &mut SqliteConnection,
    keys: &mut apply::Keys,
    mut group: Vec<(Changes, Reply)>,
) {
    if group.len() > 1 {
        let mut all = Changes::default();
        for (changes, _) in &group {
            all.append(changes.clone());
        }
        if apply::transaction(connection, keys, &all).await.is_ok() {
            for (_, reply) in group {
                let _ = reply.send(Ok(()));
            }
            return;
        }
    }
    for (changes, reply) in group.drain(..) {
        let result = apply::transaction(connection, keys, &changes)
            .await
            .map_err(|error| match error {
                apply::ApplyError::Conflict(what) => CatalogError::Conflict(what),
                apply::ApplyError::Sql(e) => errors::classify(path, e),
            });
        // A caller that went away has no use for the answer.
        let _ = reply.send(result);
    }
}
