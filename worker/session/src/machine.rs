//! The memory and cores available to this process. The limits of a container or batch job count,
//! and not the whole machine's.

mod control_groups;

use std::{
    fmt, fs,
    path::{Path, PathBuf},
};

/// Share of the memory that tasks may use. The rest is for the program itself, the store's caches,
/// and errors of estimates.
const SHARE: f64 = 0.75;
const MIB: u64 = 1 << 20;

/// The source of a memory limit.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum MemoryLimit {
    /// The whole machine's memory.
    Machine,
    /// The limit of a control group: a container's, a service's, or a job step's.
    ControlGroup(PathBuf),
    /// The job's memory under Slurm, with the name of its variable.
    Slurm(&'static str),
    /// The address space limit of this process (`ulimit -v`).
    AddressSpace,
    /// A command line argument.
    Argument,
}

impl fmt::Display for MemoryLimit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Machine => f.write_str("the machine's"),
            Self::ControlGroup(path) => {
                write!(f, "the limit of the control group {}", path.display())
            }
            Self::Slurm(variable) => write!(f, "given by Slurm ({variable})"),
            Self::AddressSpace => f.write_str("the limit of address space (ulimit -v)"),
            Self::Argument => f.write_str("given by --memory-gib"),
        }
    }
}

/// The available memory, and the source of this limit.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Memory {
    /// Size in bytes.
    pub bytes: u64,
    /// The limit that applies.
    pub limit: MemoryLimit,
}

impl Memory {
    /// Returns the memory of this process: the minimum of the machine's, its control groups', its
    /// Slurm job's and its own limit. Returns `None` if the system does not report it.
    pub fn here() -> Option<Self> {
        Self::below(Path::new("/"), &|name| std::env::var(name).ok())
    }

    /// Like [`Self::here`], for a file system at `root` and given variables. Pure except for
    /// reading files.
    fn below(root: &Path, variable: &dyn Fn(&str) -> Option<String>) -> Option<Self> {
        let all = [machine(root), slurm(variable), address_space(root)];
        let mut found: Vec<Self> = all.into_iter().flatten().collect();
        found.extend(control_groups::limit(root));
        // The first of equal ones is the machine itself.
        found.into_iter().min_by_key(|memory| memory.bytes)
    }

    /// Returns the share of it that tasks may use, in MiB.
    pub fn for_tasks_mib(&self) -> u64 {
        match self.limit {
            // An argument is meant for tasks alone.
            MemoryLimit::Argument => self.bytes / MIB,
            _ => (SHARE * self.bytes as f64) as u64 / MIB,
        }
    }

    /// Returns the memory for tasks, limited by an optional argument. The result never exceeds the
    /// available memory.
    pub fn for_tasks(asked_gib: Option<f64>) -> Option<Self> {
        Self::least(Self::here(), asked_gib)
    }

    fn least(here: Option<Self>, asked_gib: Option<f64>) -> Option<Self> {
        let asked = asked_gib.map(|gib| Self {
            bytes: (gib * (1u64 << 30) as f64) as u64,
            limit: MemoryLimit::Argument,
        });
        match (here, asked) {
            (Some(here), Some(asked)) if asked.bytes <= here.bytes => Some(asked),
            (None, asked) => asked,
            (here, _) => here,
        }
    }
}

impl fmt::Display for Memory {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "{:.1} GiB ({}); tasks may take {:.1} GiB",
            self.bytes as f64 / (1u64 << 30) as f64,
            self.limit,
            self.for_tasks_mib() as f64 / 1024.0
        )
    }
}

/// Returns the memory for tasks on this machine in MiB; 0 if the system does not report it.
pub fn memory_mib() -> u64 {
    Memory::here().map_or(0, |memory| memory.for_tasks_mib())
}

/// Returns the number of cores that this process may use: those it is bound to, limited by its
/// control group's CPU quota and by Slurm's allocation for its task.
pub fn cores() -> usize {
    // This includes affinity and the quotas of both versions of control groups.
    let here = std::thread::available_parallelism().map_or(1, usize::from);
    least_cores(here, &|name| std::env::var(name).ok())
}

fn least_cores(here: usize, variable: &dyn Fn(&str) -> Option<String>) -> usize {
    let of = |name| variable(name).and_then(|text| text.trim().parse::<usize>().ok());
    // A site that does not bind tasks to cores relies on each using only what it requested.
    let given = of("SLURM_CPUS_PER_TASK").or_else(|| of("SLURM_CPUS_ON_NODE"));
    match given {
        Some(given) if given > 0 => here.min(given),
        _ => here,
    }
}

fn machine(root: &Path) -> Option<Memory> {
    let text = fs::read_to_string(root.join("proc/meminfo")).ok()?;
    let line = text.lines().find_map(|l| l.strip_prefix("MemTotal:"))?;
    let kib: u64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(Memory {
        bytes: kib * 1024,
        limit: MemoryLimit::Machine,
    })
}

fn address_space(root: &Path) -> Option<Memory> {
    let text = fs::read_to_string(root.join("proc/self/limits")).ok()?;
    let line = text
        .lines()
        .find_map(|l| l.strip_prefix("Max address space"))?;
    // Soft limit, hard limit, unit.
    let bytes = line.split_whitespace().next()?.parse().ok()?;
    Some(Memory {
        bytes,
        limit: MemoryLimit::AddressSpace,
    })
}

fn slurm(variable: &dyn Fn(&str) -> Option<String>) -> Option<Memory> {
    let of = |name| variable(name).and_then(|text| megabytes(&text));
    // 0 means all of the node's memory.
    if let Some(bytes) = of("SLURM_MEM_PER_NODE").filter(|n| *n > 0) {
        return Some(Memory {
            bytes,
            limit: MemoryLimit::Slurm("SLURM_MEM_PER_NODE"),
        });
    }
    let number = |name| variable(name)?.trim().parse::<u64>().ok();
    let cpus = number("SLURM_CPUS_ON_NODE").or_else(|| number("SLURM_CPUS_PER_TASK"))?;
    let each = of("SLURM_MEM_PER_CPU").filter(|n| *n > 0)?;
    Some(Memory {
        bytes: each.saturating_mul(cpus),
        limit: MemoryLimit::Slurm("SLURM_MEM_PER_CPU"),
    })
}

/// Parses a size in Slurm's format: megabytes, or a number with a unit.
fn megabytes(text: &str) -> Option<u64> {
    let text = text.trim();
    let (number, unit) = match text.chars().last()? {
        'K' => (&text[..text.len() - 1], 1 << 10),
        'M' => (&text[..text.len() - 1], 1 << 20),
        'G' => (&text[..text.len() - 1], 1 << 30),
        'T' => (&text[..text.len() - 1], 1 << 40),
        _ => (text, 1u64 << 20),
    };
    number.parse::<u64>().ok()?.checked_mul(unit)
}

#[cfg(test)]
mod tests {
    use super::*;

    const MEMINFO: &str = "MemFree: 1 kB\nMemTotal:       32000000 kB\nMemAvailable: 2 kB\n";
    const MACHINE: u64 = 32_000_000 * 1024;

    struct Fake {
        folder: tempfile::TempDir,
        variables: Vec<(&'static str, &'static str)>,
    }

    impl Fake {
        fn new() -> Self {
            let fake = Self {
                folder: tempfile::tempdir().unwrap(),
                variables: vec![],
            };
            fake.file("proc/meminfo", MEMINFO)
        }

        fn file(self, path: &str, text: &str) -> Self {
            let path = self.folder.path().join(path);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, text).unwrap();
            self
        }

        fn with(mut self, name: &'static str, value: &'static str) -> Self {
            self.variables.push((name, value));
            self
        }

        fn found(&self) -> Memory {
            let of = |name: &str| {
                let found = self.variables.iter().find(|(n, _)| *n == name);
                found.map(|(_, value)| (*value).to_owned())
            };
            Memory::below(self.folder.path(), &of).unwrap()
        }
    }

    const V2: &str =
        "30 23 0:26 / /sys/fs/cgroup rw,nosuid shared:4 - cgroup2 cgroup2 rw,nsdelegate\n";
    const V1: &str =
        "30 23 0:26 / /sys/fs/cgroup/memory rw,nosuid shared:4 - cgroup cgroup rw,memory\n";

    #[test]
    fn without_limits_it_is_the_machines() {
        let found = Fake::new().found();
        assert_eq!((found.bytes, found.limit), (MACHINE, MemoryLimit::Machine));
        let nothing = tempfile::tempdir().unwrap();
        assert_eq!(Memory::below(nothing.path(), &|_| None), None);
    }

    #[test]
    fn the_least_limit_on_the_way_up_counts() {
        let fake = Fake::new()
            .file("proc/self/cgroup", "0::/system.slice/slurm/step_0/task_3\n")
            .file("proc/self/mountinfo", V2)
            .file(
                "sys/fs/cgroup/system.slice/slurm/step_0/task_3/memory.max",
                "max\n",
            )
            .file(
                "sys/fs/cgroup/system.slice/slurm/step_0/memory.max",
                "8589934592\n",
            )
            .file(
                "sys/fs/cgroup/system.slice/slurm/memory.max",
                "17179869184\n",
            );
        let found = fake.found();
        assert_eq!(found.bytes, 8 << 30);
        let path = "/sys/fs/cgroup/system.slice/slurm/step_0".into();
        assert_eq!(found.limit, MemoryLimit::ControlGroup(path));
        assert_eq!(found.for_tasks_mib(), 6 << 10);
    }

    #[test]
    fn a_container_that_sees_only_its_own_group_finds_its_limit() {
        // With its own namespace …
        let own = Fake::new()
            .file("proc/self/cgroup", "0::/\n")
            .file("proc/self/mountinfo", V2)
            .file("sys/fs/cgroup/memory.max", "1073741824\n");
        assert_eq!(own.found().bytes, 1 << 30);
        // … and without one, so that its group's path is the host's.
        let mount = V1.replace("0:26 / ", "0:26 /docker/abc ");
        let host = Fake::new()
            .file("proc/self/cgroup", "5:cpuset:/\n4:memory:/docker/abc\n")
            .file("proc/self/mountinfo", &mount)
            .file("sys/fs/cgroup/memory/memory.limit_in_bytes", "2147483648\n");
        assert_eq!(host.found().bytes, 2 << 30);
        let outside = Fake::new()
            .file("proc/self/cgroup", "0::/../../other\n")
            .file("proc/self/mountinfo", V2)
            .file("sys/fs/cgroup/memory.max", "1073741824\n");
        assert_eq!(outside.found().bytes, 1 << 30);
    }

    #[test]
    fn what_version_1_says_without_a_limit_is_none() {
        let fake = Fake::new()
            .file("proc/self/cgroup", "4:cpu,memory:/a/b\n0::/\n")
            .file("proc/self/mountinfo", V1)
            .file(
                "sys/fs/cgroup/memory/a/b/memory.limit_in_bytes",
                "9223372036854771712\n",
            );
        assert_eq!(fake.found().limit, MemoryLimit::Machine);
        let fake = fake.file(
            "sys/fs/cgroup/memory/a/memory.limit_in_bytes",
            "4294967296\n",
        );
        assert_eq!(fake.found().bytes, 4 << 30);
    }

    #[test]
    fn slurm_says_megabytes_for_the_node_or_for_each_core() {
        let node = Fake::new().with("SLURM_MEM_PER_NODE", "16384").found();
        assert_eq!(node.bytes, 16 << 30);
        assert_eq!(node.limit, MemoryLimit::Slurm("SLURM_MEM_PER_NODE"));
        let each = Fake::new()
            .with("SLURM_MEM_PER_CPU", "2G")
            .with("SLURM_CPUS_ON_NODE", "4");
        assert_eq!(each.found().bytes, 8 << 30);
        let all = Fake::new().with("SLURM_MEM_PER_NODE", "0").found();
        assert_eq!(all.limit, MemoryLimit::Machine);
        let odd = Fake::new().with("SLURM_MEM_PER_NODE", "much").found();
        assert_eq!(odd.limit, MemoryLimit::Machine);
    }

    #[test]
    fn a_limit_of_address_space_counts() {
        let limits = "Limit                     Soft Limit           Hard Limit           Units\n\
                      Max address space         4294967296           unlimited            bytes\n";
        let found = Fake::new().file("proc/self/limits", limits).found();
        assert_eq!(
            (found.bytes, found.limit),
            (4 << 30, MemoryLimit::AddressSpace)
        );
        let free = limits.replace("4294967296", "unlimited ");
        let found = Fake::new().file("proc/self/limits", &free).found();
        assert_eq!(found.limit, MemoryLimit::Machine);
    }

    #[test]
    fn an_argument_never_gives_more_than_there_is() {
        let here = || {
            Some(Memory {
                bytes: 8 << 30,
                limit: MemoryLimit::Machine,
            })
        };
        let of = |gib| Memory::least(here(), gib).unwrap();
        assert_eq!(of(None).for_tasks_mib(), 6 << 10);
        assert_eq!(of(Some(2.0)).for_tasks_mib(), 2 << 10);
        assert_eq!(of(Some(64.0)).limit, MemoryLimit::Machine);
        assert_eq!(Memory::least(None, Some(1.0)).unwrap().bytes, 1 << 30);
        assert_eq!(Memory::least(None, None), None);
    }

    #[test]
    fn slurm_bounds_the_cores_of_a_task() {
        let of = |name: &'static str| move |asked: &str| (asked == name).then(|| "3".to_owned());
        assert_eq!(least_cores(8, &of("SLURM_CPUS_PER_TASK")), 3);
        assert_eq!(least_cores(2, &of("SLURM_CPUS_ON_NODE")), 2);
        assert_eq!(least_cores(8, &of("OTHER")), 8);
    }
}
