//! The GPUs that a process uses.

use std::{fmt, str::FromStr};

/// Most GPUs of one process.
const MOST: u32 = 256;

/// The GPUs that a process uses: a number, or names (`cuda:0,cuda:2`).
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Gpus {
    /// This many: the first that drivers list, all of one runtime, without software devices.
    Count(u32),
    /// These GPUs, each as a runtime and a number.
    Named(Vec<String>),
}

impl Default for Gpus {
    fn default() -> Self {
        Self::Count(0)
    }
}

impl Gpus {
    /// Returns the GPUs with these names; an empty list means none.
    pub fn named(names: Vec<String>) -> Self {
        match names.is_empty() {
            true => Self::default(),
            false => Self::Named(names),
        }
    }
}

impl FromStr for Gpus {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        if let Ok(count) = text.parse() {
            return match count <= MOST {
                true => Ok(Self::Count(count)),
                false => Err(format!("{count} is not in 0..={MOST}")),
            };
        }
        let mut names: Vec<String> = Vec::new();
        for name in text.split(',').map(str::trim) {
            let whole = name.split_once(':').is_some_and(|(runtime, number)| {
                !runtime.is_empty()
                    && runtime.bytes().all(|b| b.is_ascii_lowercase())
                    && number.parse::<u16>().is_ok_and(|n| n.to_string() == number)
            });
            if !whole {
                return Err(format!(
                    "{name:?} is neither a number of graphics processors nor the name of one, e.g. cuda:0 \
                     (`picofarm model devices` lists them)"
                ));
            }
            if names.iter().any(|other| other == name) {
                return Err(format!("{name} is named twice"));
            }
            names.push(name.to_owned());
        }
        Ok(Self::Named(names))
    }
}

impl fmt::Display for Gpus {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Count(count) => write!(f, "{count}"),
            Self::Named(names) => f.write_str(&names.join(",")),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::Gpus;

    #[test]
    fn a_number_or_names_are_read_and_written_alike() {
        let names = |of: &[&str]| Gpus::Named(of.iter().map(|n| (*n).into()).collect());
        for (text, gpus) in [
            ("0", Gpus::Count(0)),
            ("8", Gpus::Count(8)),
            ("cuda:0", names(&["cuda:0"])),
            ("wgpu:1,cuda:10", names(&["wgpu:1", "cuda:10"])),
        ] {
            assert_eq!(text.parse(), Ok(gpus.clone()));
            assert_eq!(gpus.to_string(), text);
        }
    }

    #[test]
    fn anything_else_is_refused() {
        for text in [
            "",
            "-1",
            "257",
            "gpu",
            "cuda:",
            ":0",
            "cuda:x",
            "cuda:00",
            "cuda:0,",
            "cuda:0,cuda:0",
            "CUDA:0",
            "cuda 0",
            "cuda:99999999",
        ] {
            assert!(text.parse::<Gpus>().is_err(), "{text:?}");
        }
    }
}
