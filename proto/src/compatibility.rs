//! Decides which workers a coordinator serves, so that a farm can be upgraded one process at a
//! time.
//!
//! A coordinator serves workers of its own minor version and of the previous one, or of any earlier
//! minor version from 1.0 on. Coordinators are upgraded first. Results stay the same, because a
//! worker gets only tasks of kinds with the version that it runs, and refuses a stage with unknown
//! settings.

/// Version of the worker protocol.
pub const PROTOCOL: u32 = 2;

/// The oldest protocol version that a coordinator still speaks: that of the previous minor version.
pub const OLDEST_PROTOCOL: u32 = 2;

/// A program's version: major, minor, patch.
type Version = (u64, u64, u64);

fn parse(version: &str) -> Option<Version> {
    let numbers = version.split(['-', '+']).next()?;
    let mut parts = numbers.split('.').map(|part| part.parse().ok());
    let version = (parts.next()??, parts.next()??, parts.next()??);
    parts.next().is_none().then_some(version)
}

/// Checks whether a coordinator of version `ours` serves a worker of version `theirs` that speaks
/// `protocol`.
///
/// # Errors
/// Returns the reason why not, and which of the two must be upgraded.
pub fn serves(ours: &str, theirs: &str, protocol: u32) -> Result<(), String> {
    let unreadable = || format!("expected a version such as {ours:?}");
    let (our_major, our_minor, _) = parse(ours).ok_or_else(unreadable)?;
    let (major, minor, _) = parse(theirs).ok_or_else(unreadable)?;
    if (major, minor) > (our_major, our_minor) || protocol > PROTOCOL {
        return Err("the worker is newer; upgrade the coordinator first, then its workers".into());
    }
    let oldest_minor = match our_major {
        0 => our_minor.saturating_sub(1),
        _ => 0,
    };
    if major < our_major || minor < oldest_minor || protocol < OLDEST_PROTOCOL {
        return Err(format!(
            "the worker is too old: workers from {our_major}.{oldest_minor} and protocol {OLDEST_PROTOCOL} on are served; \
             upgrade the worker"
        ));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_previous_minor_version_is_served_and_no_later_one() {
        let outcome = |ours, theirs| match serves(ours, theirs, PROTOCOL) {
            Ok(()) => "served",
            Err(why) if why.contains("upgrade the coordinator") => "newer",
            Err(why) if why.contains("upgrade the worker") => "older",
            Err(_) => "unreadable",
        };
        for (ours, theirs, expected) in [
            ("0.3.1", "0.3.1", "served"),
            ("0.3.1", "0.3.9", "served"),
            ("0.3.1", "0.2.0", "served"),
            ("0.3.0-rc.1", "0.2.7+build", "served"),
            ("0.3.1", "0.1.9", "older"),
            ("0.3.1", "0.4.0", "newer"),
            ("0.1.0", "0.0.9", "served"),
            ("1.0.0", "0.9.0", "older"),
            ("1.4.0", "1.0.0", "served"),
            ("1.4.0", "1.5.0", "newer"),
            ("1.4.0", "2.0.0", "newer"),
            ("2.0.0", "1.9.0", "older"),
            ("0.3.1", "0.3", "unreadable"),
            ("0.3.1", "next", "unreadable"),
        ] {
            assert_eq!(outcome(ours, theirs), expected, "{theirs} at {ours}");
        }
    }

    #[test]
    fn the_protocol_counts_as_well() {
        let newer = serves("0.3.0", "0.3.0", PROTOCOL + 1).unwrap_err();
        assert!(newer.contains("upgrade the coordinator"), "{newer}");
        let older = serves("0.3.0", "0.2.0", OLDEST_PROTOCOL - 1).unwrap_err();
        assert!(older.contains("upgrade the worker"), "{older}");
    }
}
