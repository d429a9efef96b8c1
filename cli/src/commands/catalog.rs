//! `picofarm catalog`: copies a catalog and restores it.

use std::path::{Path, PathBuf};

use picofarm_database::{Backup, BackupError, CatalogPlace, backup, restore};
use serde_json::json;

use crate::{
    args::Catalog,
    error::{CliError, Code, Result},
    output::Output,
};

/// Runs one of the commands.
///
/// # Errors
/// Fails if a file is missing, damaged, in the way or in use, or if the catalog is in Postgres.
pub async fn run(command: Catalog, output: Output) -> Result<()> {
    match command {
        Catalog::Backup { file, force, place } => {
            let catalog = sqlite(place.catalog, "pg_dump --format=custom --file FILE URL")?;
            let made = backup(&catalog, &file, force).await.map_err(refused)?;
            show(&made, &catalog, &file, output, "is a copy of");
        }
        Catalog::Restore { file, force, place } => {
            let catalog = sqlite(place.catalog, "pg_restore --clean --dbname URL FILE")?;
            let holder = format!("pid {}, picofarm catalog restore", std::process::id());
            let restored = restore(&file, &catalog, force, &holder).await;
            show(
                &restored.map_err(refused)?,
                &file,
                &catalog,
                output,
                "is restored from",
            );
        }
    }
    Ok(())
}

fn sqlite(place: CatalogPlace, command: &str) -> Result<PathBuf> {
    match place {
        CatalogPlace::Sqlite(path) => Ok(path),
        CatalogPlace::Postgres(_) => Err(CliError::input(format!(
            "--catalog {place}: a catalog in Postgres is copied by Postgres' own programs"
        ))
        .hint(format!(
            "`{command}`; pg_restore needs every coordinator stopped"
        ))),
    }
}

fn refused(error: BackupError) -> CliError {
    let code = match &error {
        BackupError::Missing(_) | BackupError::Exists(_) | BackupError::InUse(..) => Code::Input,
        BackupError::Write(..) | BackupError::Catalog(_) => Code::Resource,
    };
    CliError::new(code, error)
}

fn show(backup: &Backup, from: &Path, to: &Path, output: Output, relation: &str) {
    let document = json!({"file": to, "from": from, "bytes": backup.bytes,
        "schema": backup.schema, "jobs": backup.jobs});
    output.result(&document, || {
        format!(
            "{} {relation} {}: {} jobs, {} bytes, schema {}, checked",
            to.display(),
            from.display(),
            backup.jobs,
            backup.bytes,
            backup.schema
        )
    });
}
