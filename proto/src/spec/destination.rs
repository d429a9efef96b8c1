//! The place to which a stage's tasks write, in a comparable form. A coordinator uses it to decide
//! who owns a folder.

use std::borrow::Cow;

use super::places::OutputSettings;

/// The place to which the tasks of a kind write.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Destination<'a> {
    /// A folder with its content.
    Folder(Place<'a>),
    /// A named record in a data set, which may be another user's.
    Record(Place<'a>),
    /// Only objects named by their content, so that nobody can replace another user's.
    Shared,
}

/// A folder in a store.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Place<'a> {
    /// The field of the job file that names the folder.
    pub field: &'static str,
    /// The store.
    pub store: &'a str,
    /// The folder in the store; empty means the store itself.
    pub folder: Cow<'a, str>,
}

impl<'a> Destination<'a> {
    /// Returns a folder of a store.
    pub(super) fn folder(
        field: &'static str,
        store: &'a str,
        folder: impl Into<Cow<'a, str>>,
    ) -> Self {
        Self::Folder(Place {
            field,
            store,
            folder: folder.into(),
        })
    }

    /// Returns the data set of an output.
    pub(super) fn output(output: &'a OutputSettings) -> Self {
        Self::folder("output.dataset", &output.store, &*output.dataset)
    }

    /// Returns the place that a user owns, if any.
    pub fn place(&self) -> Option<&Place<'a>> {
        match self {
            Self::Folder(place) | Self::Record(place) => Some(place),
            Self::Shared => None,
        }
    }
}

impl Place<'_> {
    /// Returns the normal form, which is equal for equal places: a path or URL with a final slash.
    /// A place is inside another one if its text begins with the other's. Links are not followed.
    pub fn normal(&self) -> String {
        let (root, path) = match self.store.split_once("://") {
            None => (String::new(), Cow::Borrowed(self.store)),
            Some((scheme, rest)) if scheme.eq_ignore_ascii_case("file") => {
                let path = rest.find('/').map_or("", |at| &rest[at..]);
                (String::new(), unescaped(path))
            }
            Some((scheme, rest)) => {
                let (host, path) = rest.split_once('/').unwrap_or((rest, ""));
                let root = format!(
                    "{}://{}",
                    scheme.to_ascii_lowercase(),
                    host.to_ascii_lowercase()
                );
                (root, unescaped(path))
            }
        };
        let parts = path.split('/').chain(self.folder.split('/'));
        let mut normal = root + "/";
        for part in parts.filter(|part| !matches!(*part, "" | ".")) {
            normal += part;
            normal.push('/');
        }
        normal
    }
}

/// Returns a URL's path with its percent escapes decoded.
fn unescaped(path: &str) -> Cow<'_, str> {
    if !path.contains('%') {
        return path.into();
    }
    let bytes = path.as_bytes();
    let mut plain = Vec::with_capacity(bytes.len());
    let mut at = 0;
    while at < bytes.len() {
        let escaped = bytes.get(at + 1..at + 3).filter(|_| bytes[at] == b'%');
        let byte = escaped
            .and_then(|digits| std::str::from_utf8(digits).ok())
            .and_then(|digits| u8::from_str_radix(digits, 16).ok());
        match byte {
            Some(byte) => {
                plain.push(byte);
                at += 3;
            }
            None => {
                plain.push(bytes[at]);
                at += 1;
            }
        }
    }
    String::from_utf8_lossy(&plain).into_owned().into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_place_has_one_form_however_it_is_written() {
        let normal = |store, folder: &'static str| {
            Place {
                field: "output.dataset",
                store,
                folder: folder.into(),
            }
            .normal()
        };
        for store in [
            "/data/store",
            "/data//store/",
            "/data/./store",
            "file:///data/store",
            "FILE://localhost/data/st%6Fre",
        ] {
            assert_eq!(normal(store, "rooms"), "/data/store/rooms/", "{store}");
        }
        assert_eq!(normal("/data/store/rooms", ""), "/data/store/rooms/");
        assert_eq!(normal("/a%20b", ""), "/a%20b/");
        assert_eq!(normal("s3://lab", "rooms"), "s3://lab/rooms/");
        assert_eq!(normal("S3://Lab/a/", "rooms"), "s3://lab/a/rooms/");
        assert!(normal("/data", "rooms2").starts_with(&normal("/data", "")));
        assert!(!normal("/data", "rooms2").starts_with(&normal("/data", "rooms")));
    }
}
