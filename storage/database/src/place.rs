//! The location of a catalog: a SQLite file or a Postgres database.

use std::{convert::Infallible, fmt, path::PathBuf, str::FromStr, sync::Arc};

#[cfg(feature = "postgres")]
use crate::PostgresCatalog;
use crate::SqliteCatalog;
use async_trait::async_trait;
use picofarm_catalog::{Catalog, CatalogError, CatalogSource};

/// The location of a catalog. Its texts never show the password of a URL.
#[derive(Clone, PartialEq, Eq)]
pub enum CatalogPlace {
    /// A SQLite file, used by one coordinator.
    Sqlite(PathBuf),
    /// The URL of a Postgres database, shared by several coordinators.
    Postgres(String),
}

#[async_trait]
impl CatalogSource for CatalogPlace {
    /// # Errors
    /// The errors of [`SqliteCatalog`]'s and `PostgresCatalog`'s `open`; [`CatalogError::NotBuilt`]
    /// for Postgres if the feature `postgres` is disabled.
    async fn open(&self, holder: &str) -> Result<Arc<dyn Catalog>, CatalogError> {
        Ok(match self {
            Self::Sqlite(path) => Arc::new(SqliteCatalog::open(path, holder).await?),
            #[cfg(feature = "postgres")]
            Self::Postgres(url) => Arc::new(PostgresCatalog::open(url, holder).await?),
            #[cfg(not(feature = "postgres"))]
            Self::Postgres(_) => {
                let place = self.to_string();
                return Err(CatalogError::NotBuilt { place });
            }
        })
    }
}

impl FromStr for CatalogPlace {
    type Err = Infallible;

    /// Parses a text with the scheme `postgres` or `postgresql` as a URL, and any other text as a
    /// path.
    fn from_str(text: &str) -> Result<Self, Infallible> {
        let postgres = ["postgres://", "postgresql://"];
        Ok(if postgres.iter().any(|scheme| text.starts_with(scheme)) {
            Self::Postgres(text.to_owned())
        } else {
            Self::Sqlite(text.into())
        })
    }
}

impl From<PathBuf> for CatalogPlace {
    fn from(path: PathBuf) -> Self {
        Self::Sqlite(path)
    }
}

impl fmt::Display for CatalogPlace {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Sqlite(path) => path.display().fmt(f),
            Self::Postgres(url) => {
                // User and password are between the scheme and the last @ before the path.
                let (scheme, rest) = url.split_once("://").unwrap_or(("postgres", url));
                let (address, path) = rest.split_at(rest.find(['/', '?']).unwrap_or(rest.len()));
                let address = match address.rsplit_once('@') {
                    Some((user, host)) => {
                        let user = user.split(':').next().unwrap_or_default();
                        format!("{user}@{host}")
                    }
                    None => address.to_owned(),
                };
                let database = path.split('?').next().unwrap_or_default();
                write!(f, "{scheme}://{address}{database}")
            }
        }
    }
}

impl fmt::Debug for CatalogPlace {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "CatalogPlace({self})")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[cfg(not(feature = "postgres"))]
    #[tokio::test]
    async fn a_program_without_postgres_says_so_and_how_to_have_it() {
        let place: CatalogPlace = "postgres://me:secret@host/farm".parse().unwrap();
        let Err(error) = place.open("a test").await else {
            panic!("there is no Postgres in this program");
        };
        let said = error.to_string();
        assert!(
            said.contains("--features postgres") && !said.contains("secret"),
            "{said}"
        );
    }

    #[test]
    fn a_url_is_shown_without_its_password() {
        for (url, shown) in [
            (
                "postgres://me:secret@db.example:5432/farm?sslmode=require",
                "postgres://me@db.example:5432/farm",
            ),
            (
                "postgres:///farm?host=/run&password=secret",
                "postgres:///farm",
            ),
            ("postgres://host", "postgres://host"),
        ] {
            let place: CatalogPlace = url.parse().unwrap();
            assert!(!format!("{place:?}{place}").contains("secret"), "{place}");
            assert_eq!(place.to_string(), shown);
        }
        let place: CatalogPlace = "data/catalog.sqlite".parse().unwrap();
        assert_eq!(place, CatalogPlace::Sqlite("data/catalog.sqlite".into()));
    }
}
