//! Paths and locations typed by users: `..` and `.` are resolved as in a shell. (Jobs on the wire
//! must not contain them, because each machine would resolve them to another folder.)

use std::path::Path;

use picofarm_tasks::absolute;

/// Parses the folder or URL of a store, of a data set or of something in one. Resolves `..`; the
/// rest stays as typed.
///
/// # Errors
/// Returns a message about why the text is not a location.
pub fn parse(text: &str) -> Result<String, String> {
    picofarm_store::check_location(text).map_err(|e| e.to_string())?;
    let mut parts = text.trim_end_matches('/').split('/');
    let relative = parts.clone().next_back() == Some(".") || parts.any(|part| part == "..");
    match relative && !text.contains("://") {
        true => absolute(Path::new("."), text).map(|path| path.display().to_string()),
        false => Ok(text.to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_climbs_is_resolved_and_the_rest_stays_as_typed() {
        let here = std::env::current_dir().unwrap().canonicalize().unwrap();
        let above = here.parent().unwrap();
        for (typed, meant) in [
            ("..", above.to_owned()),
            ("../rooms", above.join("rooms")),
            ("no-such/../rooms", here.join("rooms")),
            (".", here.clone()),
            ("../../../../../../../../../../../../..", "/".into()),
        ] {
            assert_eq!(Path::new(&parse(typed).unwrap()), meant, "{typed}");
        }
        for typed in [
            "rooms",
            "./rooms",
            "/data/rooms/",
            "s3://lab/rooms",
            "file:///a b",
            "a..b/c",
        ] {
            assert_eq!(parse(typed).unwrap(), typed);
        }
    }

    #[test]
    fn a_mistyped_url_is_no_folder() {
        for (typed, meant) in [
            ("s3:/lab/rooms", "s3://lab/rooms"),
            ("s3:lab/rooms", "s3://lab/rooms"),
            ("gs:///lab", "gs://"),
            ("file:/data", "file:///data"),
            ("S3://lab/rooms", "s3://"),
            ("https://lab/rooms", "s3://"),
            ("", "expected a path"),
            ("s3://lab/../rooms", "s3://lab/../rooms"),
        ] {
            let error = parse(typed).unwrap_err();
            assert!(error.contains(meant), "{typed}: {error}");
        }
    }
}
