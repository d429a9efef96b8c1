//! The steps that bring a database's schema up to date. They are listed here, and not found by a macro in their folder: that
//! macro connects the whole of SQLx to the compiler, which is most of what SQLx costs a build.

use std::sync::LazyLock;

use sqlx::{
    SqlSafeStr,
    migrate::{Migration, MigrationType, Migrator},
};

/// A step's version, its name and its statements.
type Step = (i64, &'static str, &'static str);

macro_rules! steps {
    ($engine:literal: $($version:literal $name:literal),*) => {
        &[$((
            $version,
            $name,
            include_str!(concat!("../migrations/", $engine, "/000", $version, "_", $name, ".sql")),
        )),*]
    };
}

const SQLITE_STEPS: &[Step] =
    steps!("sqlite": 1 "init", 2 "stages", 3 "listing", 4 "rights", 8 "interruptions");
#[cfg(feature = "postgres")]
const POSTGRES_STEPS: &[Step] =
    steps!("postgres": 1 "init", 2 "stages", 3 "listing", 4 "rights", 8 "interruptions");

/// For SQLite.
pub(crate) static SQLITE: LazyLock<Migrator> = LazyLock::new(|| migrator(SQLITE_STEPS));
/// For Postgres.
#[cfg(feature = "postgres")]
pub(crate) static POSTGRES: LazyLock<Migrator> = LazyLock::new(|| migrator(POSTGRES_STEPS));

/// Each step in a transaction of its own.
fn migrator(steps: &[Step]) -> Migrator {
    let steps = steps.iter().map(|&(version, name, statements)| {
        let statements = statements.into_sql_str();
        Migration::new(
            version,
            name.into(),
            MigrationType::Simple,
            statements,
            false,
        )
    });
    Migrator::with_migrations(steps.collect())
}

/// The latest version that a program knows.
pub(crate) fn latest(migrator: &Migrator) -> i64 {
    migrator.iter().map(|m| m.version).max().unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_step_in_the_folders_is_listed() {
        let listed = [
            ("sqlite", SQLITE_STEPS),
            #[cfg(feature = "postgres")]
            ("postgres", POSTGRES_STEPS),
        ];
        for (engine, steps) in listed {
            let folder = std::path::Path::new(&std::env::var("CARGO_MANIFEST_DIR").unwrap())
                .join("migrations")
                .join(engine);
            let mut files: Vec<String> = std::fs::read_dir(folder)
                .unwrap()
                .map(|f| f.unwrap().file_name().into_string().unwrap())
                .collect();
            files.sort();
            let names: Vec<String> = steps
                .iter()
                .map(|(version, name, _)| format!("{version:04}_{name}.sql"))
                .collect();
            assert_eq!(files, names);
        }
    }
}
