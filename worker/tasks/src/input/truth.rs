//! Checks that scenes have the ground truth that a stage needs. Imports may lack some of it. The
//! placeholders stored instead are meaningless, but a network would learn them as if they were
//! true.

use picofarm_proto::spec::{TrainSettings, train::Target};

use crate::task::TaskError;

/// Maximum number of scenes that an error names.
const NAMED: usize = 5;

/// A quantity that a stage requires.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Need {
    /// z-depth as a network's target.
    Depth,
    /// z-depth from which two-bounce times are derived.
    DepthOfTimes,
    /// z-depth at which shadows are judged.
    DepthOfShadows,
    /// The pixels that each spot lights.
    Visibility,
    /// The pixels that are mirrors.
    Specular,
    /// Lengths of the beams, which are part of two-bounce times.
    Paths,
}

impl Need {
    /// Returns its name in a manifest's list of missing quantities.
    fn name(self) -> &'static str {
        match self {
            Self::Depth | Self::DepthOfTimes | Self::DepthOfShadows => "depth",
            Self::Visibility => "visibility",
            Self::Specular => "specular",
            Self::Paths => "spots.path",
        }
    }

    /// Returns the purpose of the quantity, and a remedy if it is missing.
    fn said(self) -> (&'static str, &'static str) {
        let own = "import these scenes with it, or keep them in a data set of their own";
        match self {
            Self::Depth => ("a \"tof\" network learns it and is judged by it", own),
            Self::DepthOfTimes => (
                "the shadow network is given two-bounce times that follow from it",
                "import these scenes with it, or take the times from what a \"tof\" model predicts",
            ),
            Self::DepthOfShadows => (
                "shadows are judged at it",
                "import these scenes with it, or remove demultiplex.depth",
            ),
            Self::Visibility => ("a \"shadow\" network learns it and is judged by it", own),
            Self::Specular => ("a \"specular\" network learns it and is judged by it", own),
            Self::Paths => (
                "the two-bounce times that the shadow network is given begin with the lengths of the beams",
                "import these scenes with the lengths, or with straight_beams (--straight-beams) if no mirror folds a beam",
            ),
        }
    }
}

/// Returns the quantities needed for two-bounce times of a shadow network, derived from the true
/// depth or from a model's.
pub(crate) fn of_times(timed: bool, from_truth: bool) -> Vec<Need> {
    match (timed, from_truth) {
        (false, _) => Vec::new(),
        (true, false) => vec![Need::Paths],
        (true, true) => vec![Need::DepthOfTimes, Need::Paths],
    }
}

/// Returns the quantities needed to train and evaluate a network with these settings. `from_truth`:
/// its two-bounce times are derived from the true depth.
pub(crate) fn of_training(settings: &TrainSettings, from_truth: bool) -> Vec<Need> {
    match settings.target {
        Target::Tof => vec![Need::Depth],
        Target::Specular => vec![Need::Specular],
        Target::Shadow => {
            let timed = settings.shadow.variant.is_timed();
            let mut needs = of_times(timed, from_truth);
            needs.insert(0, Need::Visibility);
            needs
        }
    }
}

/// Rejects scenes that lack a needed quantity. `missing` lists the missing quantities of each
/// scene.
///
/// # Errors
/// [`TaskError::User`] naming data set, quantity, the first scenes, and a remedy.
pub(crate) fn check(
    place: &str,
    needs: &[Need],
    missing: &[(u64, Vec<String>)],
) -> Result<(), TaskError> {
    for need in needs {
        let lacks = |names: &Vec<String>| names.iter().any(|name| name == need.name());
        let without = missing.iter().filter(|(_, names)| lacks(names));
        let without: Vec<u64> = without.map(|(scene, _)| *scene).collect();
        if without.is_empty() {
            continue;
        }
        let (why, remedy) = need.said();
        return Err(TaskError::User(format!(
            "source: {} of {place} lack {} ({}): their import did not have it, and {why}; {remedy}",
            match without.len() {
                1 => "1 scene".to_owned(),
                n => format!("{n} scenes"),
            },
            need.name(),
            named(&without),
        )));
    }
    Ok(())
}

fn named(scenes: &[u64]) -> String {
    let first: Vec<String> = scenes.iter().take(NAMED).map(u64::to_string).collect();
    let more = match scenes.len().saturating_sub(NAMED) {
        0 => String::new(),
        n => format!(" and {n} more"),
    };
    format!("scene {}{more}", first.join(", "))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scenes_without_what_is_needed_are_named_with_what_to_do() {
        let lacking = |names: &[&str]| names.iter().map(|n| (*n).to_owned()).collect::<Vec<_>>();
        let missing: Vec<(u64, Vec<String>)> = (0..8)
            .map(|scene| (scene, lacking(&["normal", "depth"])))
            .chain([(9, lacking(&["spots.path"]))])
            .collect();
        assert_eq!(
            check("a/b", &[Need::Visibility, Need::Specular], &missing).ok(),
            Some(())
        );
        let said = check("a/b", &[Need::Depth], &missing)
            .unwrap_err()
            .to_string();
        assert!(
            said.contains("8 scenes of a/b lack depth (scene 0, 1, 2, 3, 4 and 3 more)"),
            "{said}"
        );
        let times = of_times(true, false);
        let said = check("a/b", &times, &missing).unwrap_err().to_string();
        assert!(
            said.contains("1 scene of a/b lack spots.path (scene 9)"),
            "{said}"
        );
        assert!(said.contains("--straight-beams"), "{said}");
        assert_eq!(of_times(false, true), []);
    }
}
