//! Rendezvous of the processes of a distributed training: objects in the store, below the model.

use picofarm_members::{Call, Members, Rendezvous};
use picofarm_results::Models;

use super::TrainingRun;
use crate::{
    errors::model_error,
    stores::Stores,
    task::{Control, TaskError},
};

/// The calls of a training.
pub(super) struct Board<'a> {
    stores: &'a Stores,
    models: &'a Models,
    name: &'a str,
    key: &'a str,
    control: &'a Control,
}

impl<'a> Board<'a> {
    pub(super) fn new(
        stores: &'a Stores,
        training: &'a TrainingRun<'_>,
        control: &'a Control,
    ) -> Self {
        Self {
            stores,
            models: &training.models,
            name: &training.task.train.model,
            key: &training.key,
            control,
        }
    }

    /// Returns this process as a member of the training.
    pub(super) fn members(
        &'a self,
        peers: &str,
        stopped: &'a dyn Fn() -> bool,
    ) -> Result<Members<'a>, TaskError> {
        let machine = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
        Members::new(self, peers, self.key, machine.trim(), stopped).map_err(model_error)
    }
}

impl Rendezvous for Board<'_> {
    fn newest(&self) -> Result<Option<(u64, Call)>, String> {
        let newest = async || self.models.newest_call(self.name, self.key).await;
        let found = self
            .stores
            .patiently(self.control, newest)
            .map_err(|e| e.to_string())?;
        Ok(found.map(|(number, content)| {
            // An unreadable call counts as abandoned and is followed by another.
            let nobody = Call {
                address: String::new(),
                secret: String::new(),
                machine: String::new(),
            };
            (number, serde_json::from_slice(&content).unwrap_or(nobody))
        }))
    }

    fn make(&self, number: u64, call: &Call) -> Result<bool, String> {
        let content = serde_json::to_vec(call).expect("plain data");
        let make = async || {
            let content = content.clone().into();
            self.models
                .make_call(self.name, self.key, number, content)
                .await
        };
        self.stores
            .patiently(self.control, make)
            .map_err(|e| e.to_string())
    }
}
