//! What must hold after each event.

use super::*;

impl World {
    /// Checks the laws.
    pub(in crate::core::tests) async fn check(&self) {
        let catalog = &self.instances[0].catalog;
        for job in &self.jobs {
            let record = catalog.job(*job).await.unwrap().unwrap();
            for (ordinal, stage) in record.stages.iter().enumerate() {
                let (counts, count) = (stage.counts, record.job.spec.stages[ordinal].tasks());
                assert_eq!(counts.total, count, "each task stands in one range");
                let range = (ordinal as u32, 0)..(ordinal as u32, count);
                let known = self.committed.range(range).count() as u64;
                assert!(counts.done <= known, "done without an output");
                if record.job.state == JobState::Done {
                    assert_eq!(counts.done, count);
                }
            }
        }
        let mut outputs = BTreeSet::new();
        for (ordinal, stage) in spec(1).stages.iter().enumerate() {
            let set = ResultSet::of_stage(stage);
            let runs = catalog
                .output_runs(&set, u64::from(u32::MAX))
                .await
                .unwrap();
            outputs.extend(
                runs.iter()
                    .flat_map(|r| r.lo..r.hi)
                    .map(|t| (ordinal as u32, t)),
            );
        }
        let known: BTreeSet<(u32, u64)> = self.committed.keys().copied().collect();
        assert_eq!(outputs, known, "outputs are exactly what was accepted");
        self.check_shared();
    }

    /// Checks that a single instance has no shared output leased for two jobs. Instances do not
    /// know each other's leases, so the check needs a single one.
    pub(in crate::core::tests) fn check_shared(&self) {
        if let [instance] = &*self.instances {
            for stages in instance.core.stages.sets() {
                let mut seen = BTreeSet::new();
                for stage in stages {
                    for (range, _) in instance.core.stages[stage].held.leased() {
                        let mut to_do = (range.lo..range.hi).filter(|task| range.has_to_do(*task));
                        assert!(to_do.all(|task| seen.insert(task)), "under way twice");
                    }
                }
            }
        }
    }
}
