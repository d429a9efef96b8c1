//! Who may see a job, as a condition of SQL.

use std::borrow::Cow;

use picofarm_catalog::Sight;

/// What [`seen!`] compares the columns of a job with.
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

/// The condition that a job may be seen, given the names of three arguments ([`columns`]). Both databases
/// understand it: neither has arrays and `replace` is in both.
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
