//! Methods of storing a histogram image: the profiles, candidates that were tried for them, and
//! foreign formats.

use picofarm_dataset::{CodedImage, DatasetSpec, Profile, TransientCodec};

use super::{foreign::Foreign, sample::Sample, variant::Variant};
use picofarm_cli::error::{CliError, Result};

/// A method and its displayed name.
pub struct Method {
    pub name: String,
    pub kind: Kind,
    way: Way,
}

/// Category of a method.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Kind {
    /// A profile of data sets.
    Profile,
    /// Tried for the default profile, with its Δ; readable by zarr-python and tensorstore.
    Candidate,
    /// Like `Candidate`, but a plain reader needs more than a formula to obtain values, or cannot
    /// open it at all.
    Unreadable,
    /// Another format.
    Other,
}

enum Way {
    Profile(Box<TransientCodec>),
    Variant(Variant),
    Foreign(Foreign),
}

/// An image encoded by a method.
pub enum Coded {
    Profile(CodedImage),
    /// Encoded chunks, and the values outside the code's range: (flat index, value).
    Chunks(Vec<Vec<u8>>, Vec<(u64, f32)>),
}

/// Size of an entry of an overflow list, in bytes: index and value.
const ENTRY: usize = 12;

impl Coded {
    pub fn bytes(&self) -> usize {
        let (bytes, exact) = match self {
            Self::Profile(image) => (image.shard.len(), image.overflow.len()),
            Self::Chunks(chunks, exact) => (chunks.iter().map(Vec::len).sum(), exact.len()),
        };
        bytes + exact * ENTRY
    }
}

impl Method {
    pub fn encode(&self, sample: &Sample) -> Result<Coded> {
        match &self.way {
            Way::Profile(codec) => {
                let coded = codec.encode(&sample.h, sample.scale);
                coded.map(Coded::Profile).map_err(CliError::input)
            }
            Way::Variant(variant) => {
                let (chunks, exact) = variant.encode(sample)?;
                Ok(Coded::Chunks(chunks, exact))
            }
            Way::Foreign(foreign) => Ok(Coded::Chunks(foreign.encode(sample)?, vec![])),
        }
    }

    /// Decodes into `target`, which has the image's size.
    pub fn decode(&self, coded: &Coded, sample: &Sample, target: &mut [f32]) -> Result<()> {
        match (&self.way, coded) {
            (Way::Profile(codec), Coded::Profile(image)) => {
                codec.decode(image, target).map_err(CliError::input)
            }
            (Way::Variant(variant), Coded::Chunks(chunks, exact)) => {
                variant.decode(chunks, sample, target)?;
                for (at, h) in exact {
                    target[*at as usize] = *h;
                }
                Ok(())
            }
            (Way::Foreign(foreign), Coded::Chunks(chunks, _)) => {
                foreign.decode(chunks, sample, target)
            }
            _ => unreachable!("a way decodes what it coded"),
        }
    }
}

/// Returns all methods for images like those of `spec`. `only` selects the methods with names that
/// contain one of the texts.
pub fn all(spec: &DatasetSpec, only: &[String]) -> Result<Vec<Method>> {
    let mut methods = Vec::new();
    for name in Profile::NAMES.into_iter().filter(|n| *n != "counts-u16") {
        let profile = Profile::parse(name).map_err(CliError::input)?;
        let spec = DatasetSpec {
            profile,
            per_spot: false,
            wavelengths_nm: picofarm_dataset::Wavelengths::NONE,
            two_bounce: false,
            subsets: picofarm_dataset::Subsets::NONE,
            ..*spec
        };
        let codec = TransientCodec::new(&spec).map_err(CliError::input)?;
        methods.push(Method {
            name: name.into(),
            kind: Kind::Profile,
            way: Way::Profile(Box::new(codec)),
        });
    }
    methods.extend(Variant::all().into_iter().map(|(name, variant)| Method {
        name: name.into(),
        kind: match variant.opens_plainly() {
            true => Kind::Candidate,
            false => Kind::Unreadable,
        },
        way: Way::Variant(variant),
    }));
    methods.extend(Foreign::all().into_iter().map(|(name, foreign)| Method {
        name: name.into(),
        kind: Kind::Other,
        way: Way::Foreign(foreign),
    }));
    if !only.is_empty() {
        methods.retain(|m| only.iter().any(|text| m.name.contains(text.as_str())));
    }
    if methods.is_empty() {
        let what = format!("--only {}: no such way of storing", only.join(","));
        return Err(CliError::input(what).hint("leave --only out to see all names"));
    }
    Ok(methods)
}
