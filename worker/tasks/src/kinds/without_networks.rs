//! Substitutes for the task kinds that need networks, in a build without them. Such a worker does
//! not offer these kinds, and such a program cannot submit them.

use picofarm_proto::spec::{
    EvaluateShardTask, EvaluateTask, InferTask, PromoteTask, ReportTask, TrainTask,
    kinds::PythonTask,
};

use crate::task::{Context, Control, Output, RunTask, Task, TaskError, not_built};

macro_rules! absent {
    ($($task:ident),*) => {$(
        impl RunTask for $task {
            fn code_version() -> String {
                String::new()
            }

            fn run(&self, _: &Context, task: &Task, _: &Control) -> Result<Output, TaskError> {
                Err(TaskError::User(not_built(task.spec.task.kind())))
            }
        }
    )*};
}

absent!(
    TrainTask,
    EvaluateShardTask,
    EvaluateTask,
    PromoteTask,
    InferTask,
    ReportTask,
    PythonTask
);
