//! Runs the slow work of the actor: reading jobs, and checking disputed results against a store.

use picofarm_catalog::{Gone, Recorded, ResultSet};
use picofarm_proto::{ids::JobId, messages::Finished, spec::StageSpec};

use super::{result_reader::ResultState, service::Submissions, store_checks::plan_deadline};
use crate::{
    actor::{Command, Dispute, Ruling, SlowWork},
    core::{Reported, SessionId},
};

impl SlowWork for Submissions {
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
            let ruling = it.judged(&report, dispute).await.unwrap_or(Ruling::Unknown);
            let command = Command::Judged(session, report, ruling);
            // If the actor is gone, it needs no answer.
            let _ = it.commands.send(command).await;
        });
        true
    }

    fn replace(&self, session: SessionId, report: &Finished, dispute: Dispute) {
        let (it, report) = (self.clone(), report.clone());
        tokio::spawn(async move {
            let ruling = match it.replaced(&report, dispute).await {
                Some(note) => Ruling::Overruled(note),
                None => Ruling::Stands,
            };
            let command = Command::Judged(session, report, ruling);
            // If the actor is gone, it needs no answer.
            let _ = it.commands.send(command).await;
        });
    }

    fn can_check_stores(&self) -> bool {
        self.stores.any()
    }

    fn verify(&self, store: String, reports: Vec<Reported>) {
        let it = self.clone();
        tokio::spawn(async move {
            let (reports, blind) = it.verified(&store, reports).await;
            let command = Command::Verified {
                store,
                reports,
                blind,
            };
            // If the actor is gone, it needs no answer.
            let _ = it.commands.send(command).await;
        });
    }
}

impl Submissions {
    /// Drops the recorded result in favour of a report on which two workers agree. Returns the
    /// message.
    async fn replaced(&self, report: &Finished, dispute: Dispute) -> Option<String> {
        let (catalog, stage) = (self.catalog.clone(), dispute.stage);
        let read = self.lanes.read(move || async move {
            let record = catalog.job(stage.job).await.ok()??;
            let spec = record.job.spec.stages.get(stage.stage as usize)?;
            Some(ResultSet::of_stage(spec))
        });
        let gone = Gone {
            set: read.await?,
            task: report.index,
            manifest: dispute.recorded,
        };
        self.catalog.drop_output(&gone).await.ok()?.then(|| {
            format!(
                "task {} was recorded with manifest {}; two other workers agree on {}, which counts.",
                gone.task,
                hex::encode(gone.manifest),
                report.manifest_sha256
            )
        })
    }

    /// Drops the recorded result if the store contains the reported one. Returns `None` if this
    /// cannot be determined.
    async fn judged(&self, report: &Finished, dispute: Dispute) -> Option<Ruling> {
        let mut manifest = [0; 32];
        hex::decode_to_slice(&report.manifest_sha256, &mut manifest).ok()?;
        let (catalog, stage) = (self.catalog.clone(), dispute.stage);
        let read = self.lanes.read(move || async move {
            let record = catalog.job(stage.job).await.ok()??;
            let spec = record.job.spec.stages.get(stage.stage as usize)?;
            Some((spec.clone(), ResultSet::of_stage(spec)))
        });
        let (spec, set) = read.await?;
        if !self.holds(&spec, &set, report.index, manifest).await? {
            let stands = self
                .holds(&spec, &set, report.index, dispute.recorded)
                .await?;
            return stands.then_some(Ruling::Stands);
        }
        let gone = Gone {
            set,
            task: report.index,
            manifest: dispute.recorded,
        };
        let place = format!("{} in {}", gone.set.dataset, gone.set.store);
        self.catalog.drop_output(&gone).await.ok()?.then(|| {
            Ruling::Overruled(format!(
                "task {} was recorded with manifest {}, which is not what {place} holds; it holds what was reported now, {}, \
                 and that counts.",
                gone.task,
                hex::encode(gone.manifest),
                report.manifest_sha256
            ))
        })
    }

    /// Returns whether the store contains this result; `None` if this cannot be determined.
    async fn holds(
        &self,
        spec: &StageSpec,
        set: &ResultSet,
        task: u64,
        manifest: [u8; 32],
    ) -> Option<bool> {
        let output = Recorded {
            task,
            manifest,
            checked: false,
        };
        let outputs = [output];
        let asked = self
            .stores
            .check(spec, &set.store, &outputs, plan_deadline());
        let (found, _) = asked.await;
        match found.get(&task)? {
            ResultState::Equal => Some(true),
            ResultState::Gone | ResultState::Differs => Some(false),
            ResultState::NoFolder | ResultState::NoStore => None,
        }
    }
}
