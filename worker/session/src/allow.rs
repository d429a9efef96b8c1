//! Restricts the places that a worker may access: a task with places outside the store prefixes is
//! refused before anything is opened.

use std::path::{Component, Path, PathBuf};

use picofarm_files::Opener;
use picofarm_proto::spec::StageSpec;

use crate::AgentError;

/// The places where tasks may write output and read input. Without any prefix, all places are
/// allowed.
#[derive(Debug, Clone, Default)]
pub struct StorePrefixes(Vec<StorePath>);

/// Returns an opener for this machine's files inside the operator's prefixes.
pub fn opener(prefixes: &StorePrefixes) -> Opener {
    if prefixes.0.is_empty() {
        return Opener::anywhere();
    }
    let local = prefixes.0.iter().filter(|p| p.store.is_empty());
    Opener::anywhere().within(local.map(|p| p.parts.iter().collect::<PathBuf>()))
}

/// A place in a store, compared by path components.
#[derive(Debug, Clone, PartialEq, Eq)]
struct StorePath {
    /// Scheme and host; empty for this machine's files.
    store: String,
    parts: Vec<String>,
}

impl StorePrefixes {
    /// # Errors
    /// An unusable prefix.
    pub fn new(prefixes: &[String]) -> Result<Self, AgentError> {
        let parse = |prefix: &String| {
            StorePath::parse(prefix).map_err(|why| AgentError::Config {
                field: "store_prefix",
                what: format!(
                    "{prefix:?} {why}; expected an absolute path or a URL such as s3://bucket/folder"
                ),
            })
        };
        prefixes
            .iter()
            .map(parse)
            .collect::<Result<_, _>>()
            .map(Self)
    }

    /// Checks that task `index` of a stage accesses only allowed places.
    ///
    /// # Errors
    /// The reason, with the field.
    pub fn check(&self, stage: &StageSpec, index: u64) -> Result<(), String> {
        stage.check_places().map_err(|e| e.to_string())?;
        if self.0.is_empty() {
            return Ok(());
        }
        if let Some(source) = stage.task.reads() {
            self.allowed("source.store", &source.store)?;
            self.allowed("source.dataset", &below(&source.store, &source.dataset))?;
        }
        // Models are in the source's store, and are also written there.
        let results = stage.task.results();
        self.allowed(results.field, results.store)?;
        if let Some((store, dataset)) = stage.task.writes() {
            self.allowed("output.dataset", &below(store, dataset))?;
        }
        let mut inputs = stage.task.inputs(Some(index)).into_iter();
        inputs.try_for_each(|(field, path)| self.allowed(&field, path))
    }

    /// Checks whether the worker may access a place.
    ///
    /// # Errors
    /// The reason, with the field.
    pub(crate) fn may_use(&self, field: &str, place: &str) -> Result<(), String> {
        match self.0.is_empty() {
            true => Ok(()),
            false => self.allowed(field, place),
        }
    }

    /// Returns whether a path or URL is inside one of the prefixes.
    pub fn hold(&self, text: &str) -> bool {
        StorePath::parse(text).is_ok_and(|place| self.0.iter().any(|prefix| place.lies_in(prefix)))
    }

    fn allowed(&self, field: &str, text: &str) -> Result<(), String> {
        let place = StorePath::parse(text).map_err(|why| format!("{field}: {text:?} {why}"))?;
        if self.0.iter().any(|prefix| place.lies_in(prefix)) {
            return Ok(());
        }
        Err(format!(
            "{field}: this worker may not touch {text:?}, which lies outside its store prefixes; choose another place, or \
             start workers with a --store-prefix that holds it"
        ))
    }
}

/// Returns the path of a folder in a store. On this machine it may be a link.
fn below(store: &str, folder: &str) -> String {
    format!("{}/{folder}", store.trim_end_matches('/'))
}

impl StorePath {
    fn parse(text: &str) -> Result<Self, String> {
        let (store, path) = match text.split_once("://") {
            Some(("file", path)) if path.contains('%') => {
                return Err("has a part that is not plain".into());
            }
            Some(("file", path)) if path.starts_with('/') => return Self::local(Path::new(path)),
            Some(("file", _)) => return Err("needs three slashes after file:".into()),
            Some((scheme, rest)) => {
                let (host, path) = rest.split_once('/').unwrap_or((rest, ""));
                (format!("{scheme}://{host}"), path)
            }
            None if text.starts_with('/') => return Self::local(Path::new(text)),
            None => return Err("is relative".into()),
        };
        let parts: Vec<String> = path
            .split('/')
            .filter(|p| !p.is_empty())
            .map(str::to_owned)
            .collect();
        if parts
            .iter()
            .any(|p| p == ".." || p == "." || p.contains('%'))
        {
            return Err("has a part that is not plain".into());
        }
        Ok(Self { store, parts })
    }

    /// Returns the real path of a file: links in its existing part are followed, so that none leads
    /// out of a prefix.
    fn local(path: &Path) -> Result<Self, String> {
        let up = |c: Component<'_>| matches!(c, Component::ParentDir);
        if path.components().any(up) {
            return Err("has a part `..`".into());
        }
        let mut there = path;
        let mut rest = Vec::new();
        let real = loop {
            match there.canonicalize() {
                Ok(real) => break real,
                Err(_) => match (there.parent(), there.file_name()) {
                    (Some(parent), Some(name)) => {
                        rest.push(name.to_owned());
                        there = parent;
                    }
                    _ => break PathBuf::from("/"),
                },
            }
        };
        let whole = real.components().map(|c| c.as_os_str().to_owned());
        let parts = whole.chain(rest.into_iter().rev());
        let text =
            |part: std::ffi::OsString| part.into_string().map_err(|_| "is not UTF-8".to_owned());
        Ok(Self {
            store: String::new(),
            parts: parts.map(text).collect::<Result<_, _>>()?,
        })
    }

    fn lies_in(&self, prefix: &Self) -> bool {
        self.store == prefix.store && self.parts.starts_with(&prefix.parts)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn allows(prefixes: &[&str], text: &str) -> bool {
        let prefixes: Vec<String> = prefixes.iter().map(|p| (*p).to_owned()).collect();
        let prefixes = StorePrefixes::new(&prefixes).unwrap();
        prefixes.allowed("output.store", text).is_ok()
    }

    #[test]
    fn only_what_lies_in_a_prefix_is_allowed() {
        for text in ["/data/a", "/data/a/b", "file:///data/a/b"] {
            assert!(allows(&["/other", "/data/a"], text), "{text}");
            assert!(allows(&["file:///data/a/"], text), "{text}");
        }
        for text in [
            "/data",
            "/data/ab",
            "/",
            "data/a",
            "/data/a/../b",
            "file:///etc",
            "s3://data/a",
            "file://data/a",
        ] {
            assert!(!allows(&["/data/a"], text), "{text}");
        }
        assert!(allows(&["s3://lab/sets"], "s3://lab/sets/rooms"));
        for text in [
            "s3://lab/setsx",
            "s3://lab",
            "s3://lab/sets/../x",
            "s3://lab/sets/%2e%2e/x",
            "/lab/sets",
        ] {
            assert!(!allows(&["s3://lab/sets"], text), "{text}");
        }
    }

    #[test]
    fn a_link_does_not_lead_out_of_a_prefix() {
        let folder = tempfile::tempdir().unwrap();
        let mine = folder.path().join("mine");
        let other = folder.path().join("other");
        std::fs::create_dir_all(&mine).unwrap();
        std::fs::create_dir_all(&other).unwrap();
        std::os::unix::fs::symlink(&other, mine.join("out")).unwrap();
        let prefix = mine.display().to_string();
        assert!(allows(
            &[&prefix],
            &mine.join("new/set").display().to_string()
        ));
        assert!(!allows(
            &[&prefix],
            &mine.join("out/set").display().to_string()
        ));
    }

    #[test]
    fn a_prefix_that_means_nothing_is_named() {
        for bad in ["data", "", "/data/../etc", "file://data"] {
            let said = StorePrefixes::new(&[bad.to_owned()])
                .unwrap_err()
                .to_string();
            assert!(
                said.contains("store_prefix") && said.contains(&format!("{bad:?}")),
                "{said}"
            );
        }
    }
}
