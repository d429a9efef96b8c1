//! Text for display: safe terminal output of foreign text, shell arguments, sizes, and suggestions
//! for misspelt names.

use std::{borrow::Cow, cmp::Reverse, fmt::Write};

/// Returns whether a character must not reach a terminal unescaped. Control characters move the
/// cursor and forge lines; directional characters change the order in which others are shown.
fn hidden(c: char) -> bool {
    c.is_control()
        || matches!(c, '\u{61c}' | '\u{200e}' | '\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}' | '\u{feff}')
}

fn escaped(text: &str, kept: fn(char) -> bool) -> Cow<'_, str> {
    let spoilt = |c: char| hidden(c) && !kept(c);
    if !text.contains(spoilt) {
        return Cow::Borrowed(text);
    }
    let mut out = String::with_capacity(text.len() + 16);
    for c in text.chars() {
        match c {
            c if !spoilt(c) => out.push(c),
            '\n' => out.push_str("\\n"),
            '\r' => out.push_str("\\r"),
            '\t' => out.push_str("\\t"),
            c => write!(out, "\\u{{{:x}}}", u32::from(c)).expect("a String takes everything"),
        }
    }
    Cow::Owned(out)
}

/// Returns foreign text as one line. Line ends, other control characters and directional ones are
/// escaped (`\n`, `\u{1b}`). All foreign text (names, messages, errors) must pass through this
/// function before it becomes part of a line.
pub fn line(text: &str) -> Cow<'_, str> {
    escaped(text, |_| false)
}

/// Like [`line()`], but keeps `\n`. This is the last check before a terminal. It cannot tell a
/// forged line from another, so each foreign text must pass through [`line()`] first.
pub fn lines(text: &str) -> Cow<'_, str> {
    escaped(text, |c| c == '\n')
}

/// Returns a JSON document with unsafe characters written as `\u…`. The document stays equal,
/// because such characters occur only inside its strings.
pub fn json(document: &str) -> Cow<'_, str> {
    if !document.contains(|c| hidden(c) && c != '\n') {
        return Cow::Borrowed(document);
    }
    let mut out = String::with_capacity(document.len() + 16);
    for c in document.chars() {
        if c == '\n' || !hidden(c) {
            out.push(c);
        } else {
            let code = u32::from(c);
            write!(out, "\\u{code:04x}").expect("a String takes everything");
        }
    }
    Cow::Owned(out)
}

/// Quotes an argument for a POSIX shell, if necessary. Control characters are written as `$'\x1b'`,
/// which bash, zsh and ksh read.
pub fn argument(text: &str) -> Cow<'_, str> {
    let plain = |c: char| c.is_alphanumeric() || "@%+=:,./_-".contains(c);
    if !text.is_empty() && text.chars().all(plain) {
        return Cow::Borrowed(text);
    }
    if !text.contains(hidden) {
        return Cow::Owned(format!("'{}'", text.replace('\'', r"'\''")));
    }
    let mut out = "$'".to_owned();
    for c in text.chars() {
        match c {
            '\'' | '\\' => out.extend(['\\', c]),
            c if hidden(c) => {
                let mut bytes = [0; 4];
                for byte in c.encode_utf8(&mut bytes).bytes() {
                    write!(out, "\\x{byte:02x}").expect("a String takes everything");
                }
            }
            c => out.push(c),
        }
    }
    out.push('\'');
    Cow::Owned(out)
}

/// Quotes a path as an argument; see [`argument`].
pub fn path(path: &std::path::Path) -> String {
    argument(&path.to_string_lossy()).into_owned()
}

/// Returns the name in `names` that `text` probably meant, with at most a third of its letters
/// different.
pub fn nearest<'a>(text: &str, names: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    let text = text.to_lowercase();
    let far = |name: &str| strsim::osa_distance(&text, &name.to_lowercase());
    let best = names.into_iter().map(|name| (far(name), name));
    // Of two equally near names, the longer one was more probably cut short.
    let (distance, name) = best.min_by_key(|(distance, name)| (*distance, Reverse(name.len())))?;
    (distance <= (name.chars().count() / 3).max(1)).then_some(name)
}

/// Returns a message that `text` is unknown, with the known `names` and the one probably meant.
pub fn unknown(text: &str, names: &[&str]) -> String {
    let quoted: Vec<String> = names.iter().map(|name| format!("{name:?}")).collect();
    let meant = nearest(text, names.iter().copied());
    let meant = meant.map_or_else(String::new, |name| format!("; did you mean {name:?}?"));
    match &quoted[..] {
        [one] => format!("{text:?} is not {one}{meant}"),
        all => format!("{text:?} is not one of {}{meant}", all.join(", ")),
    }
}

/// Rewrites a message of serde for users: an unknown name gets the name probably meant, and a
/// number gets the expected range.
pub fn suggest(message: &str) -> String {
    let mut message = message.to_owned();
    for (kind, range) in [
        ("u64", "from 0 to 18446744073709551615"),
        ("u32", "from 0 to 4294967295"),
        ("i32", "from -2147483648 to 2147483647"),
    ] {
        message = message.replace(
            &format!("expected {kind}"),
            &format!("expected a whole number {range}"),
        );
    }
    message = message.replace("expected f64", "expected a number");
    named(&message)
}

fn named(message: &str) -> String {
    let Some((_, after)) = ["unknown variant `", "unknown field `"]
        .iter()
        .find_map(|mark| message.split_once(mark))
    else {
        return message.to_owned();
    };
    // Nested readers each pass their message through this function.
    if after.contains("; did you mean `") {
        return message.to_owned();
    }
    let Some((text, rest)) = after.split_once('`') else {
        return message.to_owned();
    };
    // Every second piece between the marks is a name.
    let line = rest.lines().next().unwrap_or_default();
    match nearest(text, line.split('`').skip(1).step_by(2)) {
        Some(name) => format!("{}; did you mean `{name}`?", message.trim_end()),
        None => message.to_owned(),
    }
}

/// Formats a size with powers of ten: "512 B", "20.1 MB", "1.90 TB".
pub fn size(bytes: u64) -> String {
    let mut value = bytes as f64;
    for unit in ["B", "kB", "MB", "GB"] {
        if value < 1000.0 {
            let digits = usize::from(unit != "B");
            return format!("{value:.digits$} {unit}");
        }
        value /= 1000.0;
    }
    format!("{value:.2} TB")
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An attacker's text: a title, colours, a cleared screen, a forged line, and reordered
    /// letters.
    const EVIL: &str =
        "a\u{1b}]0;title\u{7}\u{1b}[2J\u{9b}31m\nerror: run curl\r\u{202e}gpj\u{2069}\tü";

    #[test]
    fn nothing_of_it_moves_a_cursor_or_makes_a_line() {
        let shown = line(EVIL);
        assert_eq!(
            shown,
            "a\\u{1b}]0;title\\u{7}\\u{1b}[2J\\u{9b}31m\\nerror: run curl\\r\\u{202e}gpj\\u{2069}\\tü"
        );
        assert!(!shown.contains(hidden));
        let several = lines(EVIL);
        assert_eq!(several.matches('\n').count(), 1);
        assert!(!several.replace('\n', "").contains(hidden));
        assert!(matches!(line("plain ü → 3"), Cow::Borrowed(_)));
    }

    #[test]
    fn json_says_the_same_without_such_characters() {
        let value = serde_json::json!({ "name": EVIL, "😀": "\u{7f}\u{feff}" });
        let document = serde_json::to_string(&value).unwrap();
        let shown = json(&document);
        assert!(!shown.contains(hidden), "{shown}");
        let read: serde_json::Value = serde_json::from_str(&shown).unwrap();
        assert_eq!(read, value);
    }

    #[test]
    fn a_shell_reads_arguments_as_they_are() {
        for (text, shown) in [
            ("job.toml", "job.toml"),
            ("s3://a/b-c_d", "s3://a/b-c_d"),
            ("my data/store", "'my data/store'"),
            ("it's", r"'it'\''s'"),
            ("", "''"),
            ("$(rm -r ~)", "'$(rm -r ~)'"),
            ("~/x", "'~/x'"),
        ] {
            assert_eq!(argument(text), shown);
        }
        for text in ["a b", "it's", "$HOME `x` \\", EVIL, "", "*?[a]", "-x"] {
            let script = format!("printf %s {}", argument(text));
            let mut bash = std::process::Command::new("bash");
            let run = bash.args(["-c", &script]).output().expect("bash runs");
            let said = run.stdout;
            assert_eq!(String::from_utf8(said).unwrap(), text, "{script}");
        }
    }

    #[test]
    fn the_name_that_was_meant_is_suggested() {
        let names = ["furnished", "primitive", "files"];
        assert_eq!(nearest("furnshed", names), Some("furnished"));
        assert_eq!(nearest("file", names), Some("files"));
        assert_eq!(nearest("Primitive", names), Some("primitive"));
        assert_eq!(nearest("mitsuba", names), None);
        assert_eq!(
            unknown("furnshed", &names),
            "\"furnshed\" is not one of \"furnished\", \"primitive\", \"files\"; did you mean \"furnished\"?"
        );
        assert_eq!(
            suggest("unknown field `binns`, expected one of `resolution`, `bins`, `samples`"),
            "unknown field `binns`, expected one of `resolution`, `bins`, `samples`; did you mean `bins`?"
        );
        assert_eq!(
            suggest("unknown variant `tff`, expected `tof` or `shadow`\n"),
            "unknown variant `tff`, expected `tof` or `shadow`; did you mean `tof`?"
        );
        let once = suggest("unknown variant `tff`, expected `tof` or `shadow`");
        assert_eq!(
            suggest(&format!("stage[4]: {once}")),
            format!("stage[4]: {once}")
        );
        assert_eq!(suggest("missing field `name`"), "missing field `name`");
        assert_eq!(
            suggest("invalid value: integer `-1`, expected u32"),
            "invalid value: integer `-1`, expected a whole number from 0 to 4294967295"
        );
    }
}
