//! Reports that no coordinator has acknowledged yet, in order of creation. After a reconnect all of
//! them are sent again; the coordinator recognizes repeated reports.

use std::collections::VecDeque;

use picofarm_proto::ids::LeaseRef;

use crate::message::Report;

/// The reports, and which of them were sent on the current connection.
#[derive(Debug, Default)]
pub(crate) struct Outbox {
    reports: VecDeque<Report>,
    /// The first `sent` reports have been sent.
    sent: usize,
}

impl Report {
    /// Returns the lease of a report.
    pub(crate) fn lease(&self) -> LeaseRef {
        match self {
            Report::Done(done) => done.lease,
            Report::Failed(failed) => failed.lease,
            Report::Release { lease, .. } => *lease,
        }
    }

    /// Returns whether an acknowledgement of (lease, index) may belong to this report. A release
    /// has no index and is answered with 0.
    fn answered_by(&self, lease: LeaseRef, index: u64) -> bool {
        let own = match self {
            Report::Done(done) => done.index,
            Report::Failed(failed) => failed.index,
            Report::Release { .. } => 0,
        };
        self.lease() == lease && own == index
    }
}

impl Outbox {
    /// Adds a report.
    pub(crate) fn push(&mut self, report: Report) {
        self.reports.push_back(report);
    }

    /// Returns the reports to send now, oldest first, and marks them as sent.
    pub(crate) fn unsent(&mut self) -> Vec<Report> {
        let unsent = self.reports.range(self.sent..).cloned().collect();
        self.sent = self.reports.len();
        unsent
    }

    /// Handles a lost connection: sent reports may not have arrived.
    pub(crate) fn rewind(&mut self) {
        self.sent = 0;
    }

    /// Removes the oldest sent report that (lease, index) answers. Returns `None` for a repeated
    /// acknowledgement.
    pub(crate) fn acknowledge(&mut self, lease: LeaseRef, index: u64) -> Option<Report> {
        let at = self
            .reports
            .iter()
            .take(self.sent)
            .position(|r| r.answered_by(lease, index))?;
        self.sent -= 1;
        self.reports.remove(at)
    }

    /// Returns whether there is a report about `lease`.
    pub(crate) fn mentions(&self, lease: LeaseRef) -> bool {
        self.reports.iter().any(|r| r.lease() == lease)
    }

    /// Returns the number of reports.
    pub(crate) fn len(&self) -> usize {
        self.reports.len()
    }

    /// Returns the number of reports of finished tasks.
    pub(crate) fn finished(&self) -> usize {
        let done = |r: &&Report| matches!(r, Report::Done(_));
        self.reports.iter().filter(done).count()
    }
}

#[cfg(test)]
mod tests {
    use picofarm_proto::ids::{Epoch, RangeId};
    use picofarm_proto::messages::{Failure, FailureKind};
    use uuid::Uuid;

    use super::*;

    fn lease(epoch: u64) -> LeaseRef {
        LeaseRef {
            range: RangeId::from_uuid(Uuid::nil()),
            epoch: Epoch(epoch),
        }
    }

    fn failed(epoch: u64, index: u64) -> Report {
        Report::Failed(Failure {
            lease: lease(epoch),
            index,
            kind: FailureKind::User,
            message: String::new(),
            milliseconds: 0,
            shared: 0,
        })
    }

    #[test]
    fn every_report_goes_out_again_after_a_lost_connection_until_it_is_acknowledged() {
        let mut outbox = Outbox::default();
        outbox.push(failed(1, 0));
        outbox.push(failed(1, 1));
        assert_eq!(outbox.unsent().len(), 2);
        assert_eq!(outbox.unsent().len(), 0);
        assert_eq!(outbox.acknowledge(lease(1), 0), Some(failed(1, 0)));
        outbox.rewind();
        outbox.push(failed(1, 2));
        assert_eq!(outbox.unsent(), [failed(1, 1), failed(1, 2)]);
        assert_eq!(outbox.len(), 2);
    }

    #[test]
    fn an_acknowledgement_of_another_epoch_or_of_an_unsent_report_takes_nothing() {
        let mut outbox = Outbox::default();
        outbox.push(failed(2, 5));
        assert_eq!(outbox.acknowledge(lease(2), 5), None, "not sent yet");
        outbox.unsent();
        assert_eq!(outbox.acknowledge(lease(1), 5), None);
        assert!(outbox.mentions(lease(2)) && !outbox.mentions(lease(1)));
    }

    #[test]
    fn a_release_is_acknowledged_after_the_report_on_task_zero_of_its_lease() {
        let mut outbox = Outbox::default();
        let release = Report::Release {
            lease: lease(1),
            reason: "bye".into(),
        };
        outbox.push(failed(1, 0));
        outbox.push(release.clone());
        outbox.unsent();
        assert_eq!(outbox.acknowledge(lease(1), 0), Some(failed(1, 0)));
        assert_eq!(outbox.acknowledge(lease(1), 0), Some(release));
    }
}
