//! The SQL condition that a reader may see a job.

use std::borrow::Cow;

use picofarm_catalog::Sight;

/// Returns the values that [`seen!`] compares a job's columns with.
pub(crate) fn columns(sight: &Sight) -> [Cow<'static, str>; 3] {
    match sight {
        Sight::All => ["all".into(), "".into(), "".into()],
        Sight::Of { user, projects } => [
            "some".into(),
            user.clone().into(),
            format!(",{},", projects.join(",")).into(),
        ],
    }
}

/// The condition that a job is visible, given the names of three arguments ([`columns`]). Both
/// databases understand it: it uses `replace` and no arrays, which SQLite does not have.
macro_rules! seen {
    ($all:literal, $user:literal, $projects:literal) => {
        concat!(
            "(",
            $all,
            " = 'all' OR job.username = ",
            $user,
            " OR (job.project <> '' AND replace(",
            $projects,
            ", ',' || job.project || ',', '') <> ",
            $projects,
            "))"
        )
    };
}
pub(crate) use seen;
