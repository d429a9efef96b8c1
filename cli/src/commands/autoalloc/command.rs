//! Any batch system, by three shell commands of the user.

use tokio::process::Command;

use super::{
    decide::Allocation,
    scheduler::{Request, output_of},
};

/// The commands.
pub struct Commands {
    /// Submits one allocation and prints its id.
    pub submit: String,
    /// Lists the allocations.
    pub list: String,
    /// Cancels one that waits.
    pub cancel: String,
}

fn shell(command: &str, request: &Request) -> Command {
    let mut shell = Command::new("sh");
    shell
        .args(["-c", command])
        .env("PICOFARM_POOL", &request.name)
        .env("PICOFARM_CORES", request.cores.to_string())
        .env("PICOFARM_MEMORY_MIB", request.memory_mib.to_string())
        .env("PICOFARM_GPUS", request.gpus.to_string())
        .env(
            "PICOFARM_TIME_LIMIT_S",
            request.time_limit.as_secs().to_string(),
        )
        // A scheduler may pass its environment on, to disks and processes of others.
        .env_remove("PICOFARM_TOKEN");
    shell
}

impl Commands {
    /// Submits one allocation.
    pub(super) async fn submit(&self, request: &Request) -> Result<String, String> {
        let command = shell(&self.submit, request);
        output_of("--submit", command, &request.script).await
    }

    /// Lists the allocations.
    pub(super) async fn list(&self, request: &Request) -> Result<Vec<Allocation>, String> {
        listed(&output_of("--list", shell(&self.list, request), "").await?)
    }

    /// Cancels one that waits.
    pub(super) async fn cancel(&self, request: &Request, id: &str) -> Result<(), String> {
        let mut command = shell(&self.cancel, request);
        command.env("PICOFARM_ALLOCATION", id);
        output_of("--cancel", command, "").await.map(drop)
    }
}

/// Reads a list: "ID pending" or "ID running SECONDS" on each line.
fn listed(text: &str) -> Result<Vec<Allocation>, String> {
    let line = |line: &str| {
        let words: Vec<&str> = line.split_whitespace().collect();
        let seconds = |text: &str| text.parse().ok().filter(|s: &f64| *s >= 0.0);
        let (id, running_s) = match words[..] {
            [id, "pending"] => (id, None),
            [id, "running", s] if seconds(s).is_some() => (id, seconds(s)),
            _ => {
                return Err(format!(
                    "--list: {line:?}: expected ID pending, or ID running SECONDS"
                ));
            }
        };
        Ok(Allocation {
            id: id.to_owned(),
            running_s,
            reason: String::new(),
        })
    };
    text.lines()
        .filter(|l| !l.trim().is_empty())
        .map(line)
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_list_has_states_and_a_wrong_line_is_named() {
        let all = listed("a.1 pending\n\n b2 running 12.5\n").unwrap();
        assert_eq!((&*all[0].id, all[0].running_s), ("a.1", None));
        assert_eq!((&*all[1].id, all[1].running_s), ("b2", Some(12.5)));
        for wrong in ["b2 running", "b2 running -1", "b2 queued", "b2"] {
            let error = listed(wrong).unwrap_err();
            assert!(
                error.contains(wrong) && error.contains("ID pending"),
                "{error}"
            );
        }
    }
}
