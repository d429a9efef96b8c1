//! Slurm: sbatch, squeue and scancel.

use std::time::Duration;

use tokio::process::Command;

use super::{
    decide::Allocation,
    scheduler::{Request, output_of},
};

/// Variables that Slurm's commands get. sbatch would pass all others on to the job, and Slurm keeps
/// them on the controller's disk.
const KEPT: [&str; 6] = ["HOME", "USER", "LOGNAME", "PATH", "LANG", "TZ"];

/// Slurm, with more options for sbatch.
pub struct Slurm {
    /// The user's options for sbatch.
    pub options: Vec<String>,
}

fn slurms(program: &str) -> Command {
    let mut command = Command::new(program);
    command.env_clear();
    command.envs(std::env::vars_os().filter(|(name, _)| {
        let name = name.to_string_lossy();
        KEPT.contains(&&*name) || name.starts_with("SLURM_") || name.starts_with("SBATCH_")
    }));
    command
}

impl Slurm {
    /// Submits one allocation.
    pub(super) async fn submit(&self, request: &Request) -> Result<String, String> {
        let mut sbatch = slurms("sbatch");
        sbatch.args([
            "--parsable",
            "--export=ALL",
            "--ntasks=1",
            "--no-requeue",
            &format!("--job-name={}", request.name),
            &format!("--cpus-per-task={}", request.cores),
            &format!("--mem={}M", request.memory_mib),
            &format!("--time={}", time(request.time_limit)),
            &format!("--output=picofarm-{}-%j.log", request.pool),
        ]);
        if request.gpus > 0 {
            sbatch.arg(format!("--gpus={}", request.gpus));
        }
        sbatch.args(&self.options);
        let said = output_of("sbatch", sbatch, &request.script).await?;
        // On a federation, the cluster's name follows after a semicolon.
        Ok(said.split(';').next().unwrap_or_default().to_owned())
    }

    /// Lists the allocations of a name.
    pub(super) async fn list(&self, request: &Request) -> Result<Vec<Allocation>, String> {
        let mut squeue = slurms("squeue");
        squeue.args([
            "--noheader",
            "--me",
            &format!("--name={}", request.name),
            "--states=PENDING,CONFIGURING,RUNNING,SUSPENDED",
            "--sort=i",
            "--format=%A|%T|%M|%r",
        ]);
        listed(&output_of("squeue", squeue, "").await?)
    }

    /// Cancels an allocation unless it has started.
    pub(super) async fn cancel(&self, id: &str) -> Result<(), String> {
        let mut scancel = slurms("scancel");
        scancel.args(["--state=PENDING", id]);
        output_of("scancel", scancel, "").await.map(drop)
    }
}

/// Reads the list of squeue.
fn listed(text: &str) -> Result<Vec<Allocation>, String> {
    let line = |line: &str| {
        let mut fields = line.trim().splitn(4, '|');
        let mut next = || fields.next().unwrap_or_default();
        let (id, state, time, reason) = (next(), next(), next(), next());
        let running_s = match state {
            "PENDING" => None,
            _ => Some(seconds(time).ok_or_else(|| {
                format!(
                    "squeue: {line:?}: expected id|state|time|reason, such as 12|RUNNING|1:23|None"
                )
            })?),
        };
        Ok(Allocation {
            id: id.to_owned(),
            running_s,
            reason: match running_s {
                Some(_) => String::new(),
                None => reason.to_owned(),
            },
        })
    };
    text.lines()
        .filter(|l| !l.trim().is_empty())
        .map(line)
        .collect()
}

/// Reads a duration of squeue, D-HH:MM:SS with the left parts optional, as seconds.
fn seconds(text: &str) -> Option<f64> {
    if text == "INVALID" {
        // The clocks of controller and node differ; the job has just started.
        return Some(0.0);
    }
    let (days, rest) = text.split_once('-').unwrap_or(("0", text));
    let mut total = 0_u64;
    for part in rest.split(':') {
        total = total.checked_mul(60)?.checked_add(part.parse().ok()?)?;
    }
    let days: u64 = days.parse().ok()?;
    Some(days.checked_mul(86_400)?.checked_add(total)? as f64)
}

/// Formats a duration for sbatch, D-HH:MM:SS.
fn time(limit: Duration) -> String {
    let s = limit.as_secs();
    format!(
        "{}-{:02}:{:02}:{:02}",
        s / 86_400,
        s / 3600 % 24,
        s / 60 % 60,
        s % 60
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_list_of_squeue_is_read_with_states_times_and_reasons() {
        let text = "7|RUNNING|1-02:03:04|None\n8|CONFIGURING|0:07|None\n9|PENDING|0:00|Priority\n";
        let all = listed(text).unwrap();
        let times: Vec<_> = all.iter().map(|a| (&*a.id, a.running_s)).collect();
        assert_eq!(
            times,
            [("7", Some(93_784.0)), ("8", Some(7.0)), ("9", None)]
        );
        assert_eq!(all[2].reason, "Priority");
        assert_eq!(listed("\n").unwrap(), []);
        let error = listed("7|RUNNING|soon|None").unwrap_err();
        assert!(error.contains("7|RUNNING|soon|None"), "{error}");
    }

    #[test]
    fn a_time_limit_is_written_as_sbatch_reads_it() {
        assert_eq!(time(Duration::from_secs(93_784)), "1-02:03:04");
        assert_eq!(time(Duration::from_secs(3600)), "0-01:00:00");
    }
}
