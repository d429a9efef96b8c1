//! A batch system made of one shell script, for `autoalloc command`.

use std::{fs, path::PathBuf, process::Command};

use crate::farm::Farm;

/// Submits, lists and cancels allocations, in the folder of its first argument. The file `places`
/// has the number of allocations that may run at once, and `most` the largest number that waited or
/// ran. It refuses while there is a file `closed`.
const SCRIPT: &str = r#"
set -eu
cd "$1"
start() {
  date +%s >"$1.started"
  PICOFARM_ALLOCATION=$1 setsid sh -c 'trap : TERM; bash "$0.sh" >"$0.stderr" 2>&1; : >"$0.ended"' "$1" </dev/null >/dev/null 2>&1 9>&- &
  echo $! >"$1.group"
}
each() { # each ID STATE of what has not ended
  for script in [0-9]*.sh; do
    id=${script%.sh}
    if [ ! -e "$script" ] || [ -e "$id.ended" ]; then continue; fi
    if [ -e "$id.started" ]; then echo "$id running $(($(date +%s) - $(cat "$id.started")))"; else echo "$id pending"; fi
  done
}
case $2 in
submit)
  if [ -e closed ]; then echo "the queue is closed for maintenance" >&2; exit 1; fi
  id=$(($(cat last) + 1))
  echo $id >last
  cat >"$id.new" && mv "$id.new" "$id.sh"
  now=$(each | wc -l)
  if [ "$now" -gt "$(cat most)" ]; then echo "$now" >most; fi
  echo "$id"
  ;;
list)
  exec 9>lock
  flock 9
  each | while read -r id state _; do
    if [ "$state" = pending ] && [ "$(each | grep -c running)" -lt "$(cat places)" ]; then start "$id"; fi
  done
  each
  ;;
cancel) if [ ! -e "$3.started" ]; then : >"$3.ended"; fi ;;
esac
"#;

/// Options of a pool of at most two workers that end soon.
pub const POOL: [&str; 14] = [
    "--max-workers",
    "2",
    "--time-limit",
    "10m",
    "--cores",
    "1",
    "--memory-gib",
    "2",
    "--idle",
    "2s",
    "--every",
    "1s",
    "--log",
    "info",
];

/// The batch system, with everything that it runs. It ends on drop.
pub struct Batch {
    dir: PathBuf,
}

impl Batch {
    /// Makes a batch system in which `places` allocations run at once.
    ///
    /// # Panics
    /// If its folder cannot be written.
    pub fn new(farm: &Farm, places: usize) -> Self {
        let dir = farm.scratch.join("batch");
        fs::create_dir(&dir).expect("the test's folder is writable");
        let batch = Self { dir };
        batch.write("batch", SCRIPT);
        batch.write("last", "0");
        batch.write("most", "0");
        batch.write("places", &places.to_string());
        batch
    }

    /// Writes a file that the script reads.
    ///
    /// # Panics
    /// If it cannot be written.
    pub fn write(&self, name: &str, text: &str) {
        fs::write(self.dir.join(name), text).expect("the test's folder is writable");
    }

    /// Deletes such a file.
    ///
    /// # Panics
    /// If it does not exist.
    pub fn delete(&self, name: &str) {
        fs::remove_file(self.dir.join(name)).expect("it exists");
    }

    /// Reads a number of the script.
    ///
    /// # Panics
    /// If there is none.
    pub fn number(&self, name: &str) -> u64 {
        let text = fs::read_to_string(self.dir.join(name)).expect("the script writes it");
        text.trim().parse().expect("it is a number")
    }

    /// Returns the shell command for one of `submit`, `list` and `cancel ID`.
    pub fn command(&self, what: &str) -> String {
        format!("sh {0}/batch {0} {what}", self.dir.display())
    }

    /// Returns the allocations that wait or run, a line each.
    ///
    /// # Panics
    /// If the script fails.
    pub fn list(&self) -> Vec<String> {
        let listed = Command::new("sh")
            .args(["-c", &self.command("list")])
            .output();
        let text = String::from_utf8(listed.expect("there is a shell").stdout);
        text.expect("a list is text")
            .lines()
            .map(str::to_owned)
            .collect()
    }

    /// Returns the numbers of the allocations that run.
    pub fn running(&self) -> Vec<String> {
        let listed = self.list();
        let running = listed.iter().filter(|line| line.contains(" running "));
        let id = |line: &String| line.split(' ').next().map(str::to_owned);
        running.filter_map(id).collect()
    }

    /// Sends a signal (`KILL`, `TERM`) to all processes of an allocation. After `KILL`, the
    /// allocation has ended, as after the loss of its node.
    ///
    /// # Panics
    /// If the allocation never started.
    pub fn signal(&self, id: &str, signal: &str) {
        let group = self.number(&format!("{id}.group"));
        // Fails where the group has ended.
        let _ = Command::new("sh")
            .args(["-c", &format!("kill -s {signal} -- -{group} 2>/dev/null")])
            .status();
        if signal == "KILL" {
            self.write(&format!("{id}.ended"), "");
        }
    }

    /// Returns the allocations that have ended for the batch system but still have processes.
    ///
    /// # Panics
    /// If the folder cannot be listed.
    pub fn orphans(&self) -> Vec<String> {
        let lives = |id: &String| {
            let group = self.number(&format!("{id}.group"));
            let found = Command::new("sh")
                .args(["-c", &format!("kill -s 0 -- -{group} 2>/dev/null")])
                .status();
            found.expect("there is a shell").success()
        };
        let files = fs::read_dir(&self.dir).expect("the test's folder can be listed");
        let names = files.map(|file| file.expect("it can be read").path());
        let groups = names.filter(|path| path.extension().is_some_and(|e| e == "group"));
        let ids = groups.filter_map(|path| Some(path.file_stem()?.to_str()?.to_owned()));
        ids.filter(|id| self.dir.join(format!("{id}.ended")).exists() && lives(id))
            .collect()
    }

    /// Returns the arguments of `autoalloc command` for this batch system.
    pub fn args(&self, more: &[&str]) -> Vec<String> {
        let own = [
            ("--submit", self.command("submit")),
            ("--list", self.command("list")),
            ("--cancel", self.command("cancel $PICOFARM_ALLOCATION")),
        ];
        let mut args: Vec<String> = ["autoalloc", "command"].map(String::from).to_vec();
        args.extend(
            own.into_iter()
                .flat_map(|(name, value)| [name.to_owned(), value]),
        );
        args.extend(more.iter().map(|s| (*s).to_owned()));
        args
    }
}

impl Drop for Batch {
    fn drop(&mut self) {
        let Ok(files) = fs::read_dir(&self.dir) else {
            return;
        };
        for file in files
            .flatten()
            .filter(|f| f.path().extension().is_some_and(|e| e == "group"))
        {
            if let Ok(group) = fs::read_to_string(file.path()) {
                // Fails where the group has ended.
                let _ = Command::new("sh")
                    .args(["-c", &format!("kill -9 -{} 2>/dev/null", group.trim())])
                    .status();
            }
        }
    }
}
