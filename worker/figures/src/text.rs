//! Escapes untrusted text.

use std::fmt::{self, Display, Write};

/// Displays text with HTML escaped; control and directional characters become U+FFFD.
pub struct Safe<T>(pub T);

impl<T: Display> Display for Safe<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(Escape(f), "{}", self.0)
    }
}

struct Escape<'a, 'b>(&'a mut fmt::Formatter<'b>);

impl Write for Escape<'_, '_> {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        for c in text.chars() {
            match c {
                '&' => self.0.write_str("&amp;")?,
                '<' => self.0.write_str("&lt;")?,
                '>' => self.0.write_str("&gt;")?,
                '"' => self.0.write_str("&quot;")?,
                '\'' => self.0.write_str("&#39;")?,
                '\n' | '\t' => self.0.write_char(c)?,
                // Directional characters would change the visible order of the text.
                '\u{61c}'
                | '\u{200e}'
                | '\u{200f}'
                | '\u{2028}'..='\u{202e}'
                | '\u{2066}'..='\u{2069}' => {
                    self.0.write_char('\u{fffd}')?;
                }
                c if c.is_control() => self.0.write_char('\u{fffd}')?,
                c => self.0.write_char(c)?,
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::Safe;

    #[test]
    fn controls_and_directional_characters_do_not_reach_a_page() {
        let evil = "a\u{1b}]0;t\u{7}\u{9b}31m\u{202e}b\u{2069}<i>";
        let safe = Safe(evil).to_string();
        assert_eq!(
            safe,
            "a\u{fffd}]0;t\u{fffd}\u{fffd}31m\u{fffd}b\u{fffd}&lt;i&gt;"
        );
    }

    proptest! {
        #[test]
        fn nothing_that_is_escaped_opens_a_tag_or_ends_an_attribute(text in "\\PC*[<>&\"']\\PC*") {
            // These characters become U+FFFD.
            prop_assume!(!text.contains(['\u{2028}', '\u{2029}']));
            let safe = Safe(&text).to_string();
            prop_assert!(!safe.contains(['<', '>', '"', '\'']));
            let back = safe.replace("&lt;", "<").replace("&gt;", ">").replace("&quot;", "\"");
            prop_assert_eq!(back.replace("&#39;", "'").replace("&amp;", "&"), text);
        }
    }
}
