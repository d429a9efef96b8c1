//! The parts of a URL.

use std::collections::BTreeMap;

/// The parameters of a URL or of a form; of equal names the last counts.
#[derive(Debug, Clone, Default)]
pub struct Query(BTreeMap<String, String>);

impl Query {
    /// Parses `name=value&…`.
    pub fn parse(text: &str) -> Self {
        let pairs = url::form_urlencoded::parse(text.as_bytes());
        Self(pairs.into_owned().collect())
    }

    /// Returns a parameter; empty if it is missing.
    pub fn text(&self, name: &str) -> &str {
        self.0.get(name).map_or("", String::as_str)
    }

    /// Parses a whole number; `None` if the parameter is missing.
    ///
    /// # Errors
    /// A message that names the parameter.
    pub fn number(&self, name: &str) -> Result<Option<u64>, String> {
        match self.text(name) {
            "" => Ok(None),
            text => match text.parse() {
                Ok(number) => Ok(Some(number)),
                Err(_) => Err(format!("{name}: expected a whole number, found {text:?}")),
            },
        }
    }

    /// Parses a whole number.
    ///
    /// # Errors
    /// A message that names the parameter, also if it is missing.
    pub fn required(&self, name: &str) -> Result<u64, String> {
        let missing = || format!("{name}: expected a whole number, found nothing");
        self.number(name)?.ok_or_else(missing)
    }
}

/// Encodes parameters; those with empty values are left out.
pub fn encode(pairs: &[(&str, &str)]) -> String {
    let mut text = url::form_urlencoded::Serializer::new(String::new());
    for (name, value) in pairs.iter().filter(|(_, value)| !value.is_empty()) {
        text.append_pair(name, value);
    }
    text.finish()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_encoded_is_parsed_again_and_wrong_numbers_name_their_parameter() {
        let text = encode(&[("set", "0/a b&c"), ("none", ""), ("scene", "7")]);
        let query = Query::parse(&text);
        assert_eq!(query.text("set"), "0/a b&c");
        assert_eq!(query.required("scene"), Ok(7));
        assert!(query.required("none").unwrap_err().starts_with("none:"));
        let wrong = Query::parse("scene=-1").number("scene").unwrap_err();
        assert!(wrong.contains("\"-1\""), "{wrong}");
    }
}
