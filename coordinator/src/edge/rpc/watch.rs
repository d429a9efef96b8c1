//! Reports a job's status after each change.

use std::time::Duration;

use picofarm_proto::{ids::JobId, messages::JobState, wire};
use prost::Message;
use tokio::sync::mpsc;
use tonic::Status;

use super::link::Link;
use crate::{
    auth::Caller,
    memory::{Account, Charge},
};

/// Shortest interval between two reports to a watcher.
const DEBOUNCE: Duration = Duration::from_millis(250);
/// Longest interval between two reads of a watched job.
const LOOK: Duration = Duration::from_secs(5);

/// A message to a watcher, with its charge.
pub(super) type Watched = Result<(wire::WatchJobResponse, Charge), Status>;

/// Watches until the caller's token is revoked.
pub(super) async fn watch_while_allowed(
    link: Link,
    caller: Caller,
    account: Account,
    id: JobId,
    sender: mpsc::Sender<Watched>,
) {
    let revoked = tokio::select! {
        () = watch(link, account, id, sender.clone()) => return,
        status = caller.revoked() => status,
    };
    let _ = sender.send(Err(revoked)).await;
}

/// Reports at once and after each change, until the job ends or nobody listens.
async fn watch(mut link: Link, account: Account, id: JobId, sender: mpsc::Sender<Watched>) {
    let mut last = None;
    loop {
        link.revision.mark_unchanged();
        let status = match link.status(&account, id).await {
            Ok(status) => status,
            Err(error) => {
                let _ = sender.send(Err(error)).await;
                return;
            }
        };
        let over = status.state != JobState::Active;
        if last.as_ref() != Some(&status) {
            let job = Some(status.clone().into());
            let response = wire::WatchJobResponse { job };
            // The charge covers this response, and the last one, with which it is compared.
            let bytes = 2 * response.encoded_len() as u64;
            let charged = account.charge("the job's status", bytes).await;
            let over = charged.is_err();
            let heard = charged.map(|charge| (response, charge));
            if sender.send(heard).await.is_err() || over {
                return;
            }
            last = Some(status);
        }
        if over {
            return;
        }
        tokio::select! {
            () = tokio::time::sleep(DEBOUNCE) => {}
            () = sender.closed() => return,
            () = link.stop.cancelled() => return,
        }
        tokio::select! {
            changed = link.revision.changed() => if changed.is_err() { return },
            // Another coordinator may have changed the job.
            () = tokio::time::sleep(LOOK) => {}
            () = sender.closed() => return,
            () = link.stop.cancelled() => return,
        }
    }
}
