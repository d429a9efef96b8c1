//! Removes possible secrets in URLs from error messages about the command line, which repeat its
//! arguments.

use clap::error::{ContextKind, ContextValue};

/// Removes the user part and the query of every URL in an error.
pub(super) fn hidden(mut error: clap::Error) -> clap::Error {
    let context: Vec<(ContextKind, ContextValue)> = error
        .context()
        .map(|(kind, value)| (kind, value.clone()))
        .collect();
    for (kind, value) in context {
        let value = match value {
            ContextValue::String(text) => ContextValue::String(without_secrets(&text)),
            ContextValue::Strings(texts) => {
                ContextValue::Strings(texts.iter().map(|t| without_secrets(t)).collect())
            }
            other => other,
        };
        error.insert(kind, value);
    }
    error
}

/// Removes the parts of a URL before the `@` and after the `?`.
pub fn without_secrets(text: &str) -> String {
    let Some((scheme, rest)) = text.split_once("://") else {
        return text.to_owned();
    };
    let (place, query) = match rest.find(['?', '#']) {
        Some(at) => (&rest[..at], "?…"),
        None => (rest, ""),
    };
    let place = match place.rsplit_once('@') {
        Some((_, place)) => format!("…@{place}"),
        None => place.to_owned(),
    };
    format!("{scheme}://{place}{query}")
}

#[cfg(test)]
mod tests {
    use super::super::parse;

    #[test]
    fn an_error_about_a_url_does_not_repeat_its_secrets() {
        for (given, kept) in [
            (
                &["doctor", "--store", "s3://key:hush@bucket/x"][..],
                "s3://…@bucket/x",
            ),
            (
                &["doctor", "--store=s3://bucket/x?token=hush"],
                "s3://bucket/x?…",
            ),
            (
                &["doctor", "--store", "s3://key:hu/hush@bucket/x"],
                "…@bucket/x",
            ),
            (
                &["worker", "postgres://me:hush@host/farm"],
                "postgres://…@host/farm",
            ),
            (
                &["worker", "--coordinatr=http://me:hush@host"],
                "--coordinatr",
            ),
            (&["http://me:hush@host"], "http://…@host"),
        ] {
            let words = ["picofarm"].iter().chain(given).map(Into::into);
            let said = match parse(words, "0") {
                Ok(_) => panic!("{given:?} is refused"),
                Err(e) => e.to_string(),
            };
            assert!(!said.contains("hush") && said.contains(kept), "{said}");
        }
    }
}
