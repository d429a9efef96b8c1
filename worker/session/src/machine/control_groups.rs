//! The memory limit of control groups.

use std::{
    fs,
    path::{Path, PathBuf},
};

use super::{Memory, MemoryLimit};

/// Control groups of version 1 report about 2^63 if there is no limit; all real limits are below
/// this.
const NO_LIMIT: u64 = 1 << 60;

/// Returns the smallest limit of this process's control groups, of both versions: its own and their
/// ancestors.
pub(super) fn limit(root: &Path) -> Option<Memory> {
    let read = |path: &str| fs::read_to_string(root.join(path)).unwrap_or_default();
    let (groups, mounts) = (read("proc/self/cgroup"), read("proc/self/mountinfo"));
    let mut least: Option<Memory> = None;
    for (mount, file) in [
        (Mount::find(&mounts, "cgroup2", ""), "memory.max"),
        (
            Mount::find(&mounts, "cgroup", "memory"),
            "memory.limit_in_bytes",
        ),
    ] {
        let Some(mount) = mount else { continue };
        let mut folder = mount.folder(&own_group(&groups, mount.controller));
        loop {
            let below_root = folder.strip_prefix("/").unwrap_or(&folder);
            let text = fs::read_to_string(root.join(below_root).join(file));
            let bytes = text.ok().and_then(|text| text.trim().parse::<u64>().ok());
            if let Some(bytes) = bytes.filter(|n| *n < NO_LIMIT)
                && least.as_ref().is_none_or(|least| bytes < least.bytes)
            {
                least = Some(Memory {
                    bytes,
                    limit: MemoryLimit::ControlGroup(folder.clone()),
                });
            }
            if folder == mount.point || !folder.pop() {
                break;
            }
        }
    }
    least
}

/// Returns the path of this process's control group in a controller's hierarchy; without a name, in
/// that of version 2.
fn own_group(groups: &str, controller: &str) -> String {
    let found = groups.lines().find_map(|line| {
        let mut parts = line.splitn(3, ':');
        let (number, names, path) = (parts.next()?, parts.next()?, parts.next()?);
        let ours = match controller {
            "" => number == "0" && names.is_empty(),
            name => names.split(',').any(|n| n == name),
        };
        ours.then(|| path.to_owned())
    });
    found.unwrap_or_else(|| "/".into())
}

/// The mount point of a hierarchy of control groups.
struct Mount<'a> {
    controller: &'a str,
    /// The mounted part of the hierarchy.
    part: String,
    point: PathBuf,
}

impl<'a> Mount<'a> {
    /// Finds it in `/proc/self/mountinfo` by file system type and option.
    fn find(mounts: &str, kind: &str, controller: &'a str) -> Option<Self> {
        mounts.lines().find_map(|line| {
            let (place, rest) = line.split_once(" - ")?;
            let mut place = place.split(' ').skip(3);
            let (part, point) = (place.next()?, place.next()?);
            let mut rest = rest.split(' ');
            let (found, options) = (rest.next()?, rest.nth(1)?);
            let ours = found == kind
                && (controller.is_empty() || options.split(',').any(|o| o == controller));
            ours.then(|| Self {
                controller,
                part: part.to_owned(),
                point: PathBuf::from(point),
            })
        })
    }

    /// Returns the folder of a group. A container may only see the hierarchy below its own group,
    /// and may be given a path outside it. In that case the visible root is its own group.
    fn folder(&self, group: &str) -> PathBuf {
        let inside = match &*self.part {
            "/" => Some(group),
            part => group.strip_prefix(part),
        };
        let inside = inside.unwrap_or("").trim_matches('/');
        match inside.is_empty() || inside.split('/').any(|p| p == "..") {
            true => self.point.clone(),
            false => self.point.join(inside),
        }
    }
}
