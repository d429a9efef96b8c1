//! What the actor leaves to others: reading jobs that it has heard of, and asking a store who is right.

use picofarm_catalog::{Gone, Recorded, ResultSet};
use picofarm_proto::{ids::JobId, model::Finished};

use super::{Submissions, look};
use crate::{
    actor::{Aside, Command, Dispute},
    core::SessionId,
    stored::Found,
};

impl Aside for Submissions {
    fn learn(&self, job: JobId) {
        let it = self.clone();
        tokio::spawn(async move {
            if let Err(why) = Self::learn(&it, job).await {
                tracing::warn!(%job, ?why, "the job could not be read; it is tried again");
            }
        });
    }

    fn judge(&self, session: SessionId, report: &Finished, dispute: Dispute) -> bool {
        if !self.stores.any() {
            return false;
        }
        let (it, report) = (self.clone(), report.clone());
        tokio::spawn(async move {
            let note = it.judged(&report, dispute).await;
            let command = Command::Judged(session, report, note);
            // An actor that is gone needs no answer.
            let _ = it.commands.send(command).await;
        });
        true
    }
}

impl Submissions {
    /// If the store holds what is reported, drops what is recorded instead, and says so.
    async fn judged(&self, report: &Finished, dispute: Dispute) -> Option<String> {
        let mut manifest = [0; 32];
        hex::decode_to_slice(&report.manifest_sha256, &mut manifest).ok()?;
        let (catalog, stage) = (self.catalog.clone(), dispute.stage);
        let read = self.lanes.read(move || async move {
            let record = catalog.job(stage.job).await.ok()??;
            let spec = record.job.spec.stages.get(stage.stage as usize)?;
            Some((spec.clone(), ResultSet::of(spec)))
        });
        let (spec, set) = read.await?;
        let output = Recorded {
            task: report.index,
            manifest,
            checked: false,
        };
        let outputs = [output];
        let asked = self.stores.look(&spec, &set, &outputs, look::deadline());
        let (found, _) = asked.await;
        if found.get(&report.index) != Some(&Found::Equal) {
            return None;
        }
        let gone = Gone {
            set,
            task: report.index,
            manifest: dispute.recorded,
        };
        let place = format!("{} in {}", gone.set.dataset, gone.set.store);
        self.catalog.drop_output(&gone).await.ok()?.then(|| {
            format!(
                "task {} was recorded with manifest {}, which is not what {place} holds; it holds what was reported now, {}, \
                 and that counts. Who reported the first result?",
                gone.task,
                hex::encode(gone.manifest),
                report.manifest_sha256
            )
        })
    }
}
