//! Verification: reads a scene's objects and compares them with its manifest.

use picofarm_proto::spec::{SourceSettings, TaskSpec, kinds::VerifyTask};
use picofarm_store::VerifyMode;

use crate::{
    input::source_manifest,
    stores::manifest_sha256,
    task::{Context, Control, Output, RunTask, Task, TaskError},
};

/// Maximum number of problems in a message.
const NAMED: usize = 3;

impl RunTask for VerifyTask {
    fn code_version() -> String {
        Self::VERSION.to_owned()
    }

    fn run(&self, context: &Context, task: &Task, control: &Control) -> Result<Output, TaskError> {
        let (
            stores,
            SourceSettings {
                store,
                dataset: folder,
            },
        ) = (&context.stores, &self.source);
        let dataset = stores.open_source(store, folder, control)?;
        stores.fits(TaskSpec::Verify(self.clone()), Some(dataset.spec()))?;
        let manifest = source_manifest(stores, &dataset, task.index, control)?;
        let mode = match self.verify.fast {
            true => VerifyMode::Fast,
            false => VerifyMode::Full,
        };
        let scenes = [task.index];
        let report = stores.wait(control, dataset.verify_only(&scenes, mode))?;
        control.at(1.0);
        if report.is_sound() {
            return Ok(Output {
                manifest_sha256: manifest_sha256(&manifest),
                bytes: 0,
                adopted: false,
            });
        }
        let mut named: Vec<String> = report.problems.iter().map(ToString::to_string).collect();
        let more = named.len().saturating_sub(NAMED);
        named.truncate(NAMED);
        let more = if more > 0 {
            format!("; and {more} more")
        } else {
            String::new()
        };
        Err(TaskError::User(format!(
            "source: scene {} is damaged: {}{more}; make it again with `picofarm dataset repair {}`, then retry the job",
            task.index,
            named.join("; "),
            dataset.place(),
        )))
    }
}
