//! `picofarm job explain`.

use picofarm_proto::show;

use crate::{
    client::Explained,
    output::{
        bytes,
        describe::{clock, counts, describe_event, state},
        duration,
    },
};

/// Formats the explanation of a job's state as text.
pub fn describe(explained: &Explained) -> String {
    let status = &explained.job;
    let mut text = format!(
        "job {} \"{}\": {}\n  {}\n",
        status.id,
        show::line(&status.name),
        state(status),
        counts(status)
    );
    for reason in &explained.reasons {
        text += &format!("  - {}\n", show::line(&reason.words));
    }
    let Some(task) = &explained.task else {
        return text;
    };
    text += &format!("task {}: {}\n", task.index, show::line(&task.words));
    if task.failures + task.crashes + task.interruptions > 0 {
        text += &format!(
            "  {} of {} failures, {} of {} lost workers and {} of {} interruptions before it is given up; the last: {}\n",
            task.failures,
            task.max_failures,
            task.crashes,
            task.max_crashes,
            task.interruptions,
            task.max_interruptions,
            show::line(&task.last_error)
        );
    }
    for why in &task.reruns {
        text += &format!("  run again because {}\n", show::line(why));
    }
    if let Some(output) = &task.output {
        text += &format!(
            "  output: manifest {}, {} in {}\n",
            show::line(&output.manifest_sha256),
            bytes(output.bytes),
            duration(output.seconds)
        );
        if let Some(made) = &output.made {
            text += &format!(
                "  committed {} by {} under job {}\n",
                clock(made.at_ms),
                show::line(&made.worker),
                made.job
            );
        }
    }
    if !task.events.is_empty() {
        text += "  history:\n";
    }
    for event in &task.events {
        text += &format!("    {}", describe_event(event));
    }
    text
}
