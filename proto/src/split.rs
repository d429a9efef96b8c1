//! Splits a data set into training, validation and test scenes. Pure.
//!
//! Each scene has a *rank*: a hash of (seed, scene index). The first version of a split sorts the
//! existing scenes by rank, cuts the list at the exact requested counts, and records the ranks at
//! the cuts. From then on a scene's side depends only on its own rank and those two cuts. No scene
//! changes sides when scenes are added, and their order has no effect. The counts are exact at the
//! size at which the split was made. If M scenes are added to N, the fraction p of them on a side
//! has standard deviation √(p(1−p)(1/M + 1/N)).
//!
//! The index is the scene's identity, not its task key. A reprocessed data set has the same scenes
//! under the same indices, so that one split fits both.

use std::collections::BTreeSet;

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use crate::spec::SpecError;

/// Format of the record.
pub const SPLIT_FORMAT: u32 = 1;

/// The sides, in the order of [`Parts`].
pub const SIDES: [&str; 3] = ["train", "validation", "test"];

/// The letters of [`SplitRecord::sides`], and [`ABSENT`].
const LETTERS: [u8; 3] = *b"012";
const ABSENT: u8 = b'.';

/// The requested split.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SplitSettings {
    /// Name of the split: letters, digits, `-` and `_`.
    #[serde(default = "default_name")]
    pub name: String,
    /// Seed of the hash (default 0).
    #[serde(default)]
    pub seed: u64,
    /// Sizes of training, validation and test set: `counts = [..]` or `fractions = [..]`.
    #[serde(flatten)]
    pub parts: Parts,
}

fn default_name() -> String {
    "default".into()
}

/// Sizes of training, validation and test set.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Parts {
    /// Numbers of scenes. Their sum is the number of scenes when the split is made.
    Counts([u64; 3]),
    /// Fractions of the scenes when the split is made, with sum 1. Rounded by largest remainders.
    Fractions([f64; 3]),
}

/// A scene's place in the order of the cuts: a hash, and the scene itself to break ties.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Rank {
    /// The hash, 16 hexadecimal digits.
    #[serde(with = "hex_u64")]
    pub hash: u64,
    /// The scene.
    pub scene: u64,
}

impl Rank {
    /// Returns the rank of a scene. The hash is the first eight bytes, little-endian, of
    /// SHA-256("split", seed, scene), with numbers as eight bytes, little-endian.
    pub fn of(seed: u64, scene: u64) -> Self {
        let mut hash = Sha256::new();
        hash.update(b"split");
        hash.update(seed.to_le_bytes());
        hash.update(scene.to_le_bytes());
        let digest = hash.finalize();
        let head = digest[..8].try_into().expect("a digest has 32 bytes");
        Self {
            hash: u64::from_le_bytes(head),
            scene,
        }
    }
}

/// A cut between two sides.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Cut {
    /// Every side before the cut is empty for good.
    Start,
    /// Ranks below this one are before the cut.
    At(Rank),
    /// Every side after the cut is empty for good.
    End,
}

/// A stored version of a split.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SplitRecord {
    /// [`SPLIT_FORMAT`].
    pub format: u32,
    /// The requested split.
    pub settings: SplitSettings,
    /// 1 for the first version; each further one extends its predecessor.
    pub version: u64,
    /// Number of scenes when the split was made. The counts of version 1 are exact.
    pub made_of: u64,
    /// The cuts between training and validation, and between validation and test.
    pub cuts: [Cut; 2],
    /// Scenes of training, validation and test set in this version.
    pub counts: [u64; 3],
    /// One character for each scene index: 0 training, 1 validation, 2 test, `.` not part of this
    /// version.
    pub sides: String,
    /// Python code that reads `sides`.
    pub decode: Vec<String>,
}

impl SplitSettings {
    /// Checks every field.
    ///
    /// # Errors
    /// Returns a [`SpecError`] for the first invalid field.
    pub fn check(&self) -> Result<(), SpecError> {
        let fail = |field: &str, what: String| Err(SpecError::new(format!("split.{field}"), what));
        let plain = |c: char| c.is_ascii_alphanumeric() || "-_".contains(c);
        if self.name.is_empty() || self.name.len() > 64 || !self.name.chars().all(plain) {
            return fail(
                "name",
                format!(
                    "{:?} must be up to 64 letters, digits, '-' and '_'",
                    self.name
                ),
            );
        }
        match self.parts {
            Parts::Counts(c) => {
                let total = c.iter().try_fold(0u64, |sum, n| sum.checked_add(*n));
                match total {
                    Some(1..) => Ok(()),
                    _ => fail(
                        "counts",
                        format!("{c:?} must add up to the number of scenes"),
                    ),
                }
            }
            Parts::Fractions(f) => {
                let usable = f.iter().all(|f| (0.0..=1.0).contains(f));
                if usable && (f.iter().sum::<f64>() - 1.0).abs() <= 1e-9 {
                    return Ok(());
                }
                fail(
                    "fractions",
                    format!("{f:?} must be three shares of at least 0 that add up to 1"),
                )
            }
        }
    }

    /// Returns the first field in which `asked` differs: (field, ours, asked).
    pub fn difference(&self, asked: &Self) -> Option<(&'static str, String, String)> {
        if self.name != asked.name {
            return Some(("name", self.name.clone(), asked.name.clone()));
        }
        if self.seed != asked.seed {
            return Some(("seed", self.seed.to_string(), asked.seed.to_string()));
        }
        let shown = |parts: &Parts| match parts {
            Parts::Counts(c) => format!("counts {c:?}"),
            Parts::Fractions(f) => format!("fractions {f:?}"),
        };
        let (ours, theirs) = (shown(&self.parts), shown(&asked.parts));
        (self.parts != asked.parts).then_some(("parts", ours, theirs))
    }
}

impl Parts {
    /// Returns the sizes for `scenes` scenes.
    ///
    /// # Errors
    /// Returns an error if the counts have a different sum.
    pub fn counts(&self, scenes: u64) -> Result<[u64; 3], SpecError> {
        match *self {
            Self::Counts(counts) => {
                let total: u64 = counts.iter().sum();
                if total == scenes {
                    return Ok(counts);
                }
                Err(SpecError::new(
                    "split.counts",
                    format!(
                        "{counts:?} add up to {total}, but {scenes} scenes are published; name counts that add up to \
                         {scenes}, use fractions, or finish the data set first"
                    ),
                ))
            }
            Self::Fractions(shares) => {
                let exact = shares.map(|f| f * scenes as f64);
                let mut counts = exact.map(|x| x.floor() as u64);
                // The largest remainder comes first, and the earlier side if equal. A side with
                // fraction 0 never gets any scene.
                let mut order = [0, 1, 2];
                order.sort_by(|&a, &b| exact[b].fract().total_cmp(&exact[a].fract()));
                order.sort_by_key(|&side| shares[side] == 0.0);
                let missing = scenes.saturating_sub(counts.iter().sum());
                for side in order.into_iter().cycle().take(missing as usize) {
                    counts[side] += 1;
                }
                Ok(counts)
            }
        }
    }
}

impl SplitRecord {
    /// Returns the first version for the existing scenes.
    ///
    /// # Errors
    /// Returns an error for invalid settings, no scenes, or counts with a different sum.
    pub fn first(settings: &SplitSettings, scenes: &BTreeSet<u64>) -> Result<Self, SpecError> {
        settings.check()?;
        if scenes.is_empty() {
            return Err(SpecError::new(
                "split",
                "there are no published scenes to split; finish some first",
            ));
        }
        let made_of = scenes.len() as u64;
        let counts = settings.parts.counts(made_of)?;
        if let Parts::Fractions(shares) = settings.parts
            && let Some(side) = (0..3).find(|&s| shares[s] > 0.0 && counts[s] == 0)
        {
            return Err(SpecError::new(
                "split.fractions",
                format!(
                    "{} of {made_of} scenes is less than one, and a side that is empty when the split is made stays empty: \
                     {} would never get any; split once more scenes are published",
                    shares[side], SIDES[side]
                ),
            ));
        }
        let mut ranks: Vec<Rank> = scenes.iter().map(|s| Rank::of(settings.seed, *s)).collect();
        ranks.sort_unstable();
        let cut = |before: u64| match before {
            0 => Cut::Start,
            n if n == made_of => Cut::End,
            n => Cut::At(ranks[n as usize]),
        };
        let cuts = [cut(counts[0]), cut(counts[0] + counts[1])];
        Ok(Self::assemble(settings.clone(), 1, made_of, cuts, scenes))
    }

    /// Returns the next version, with the scenes of this one and the existing ones; `None` if none
    /// is new. No scene changes sides.
    ///
    /// # Errors
    /// Returns an error if the settings differ from those of this version.
    pub fn extended(
        &self,
        settings: &SplitSettings,
        scenes: &BTreeSet<u64>,
    ) -> Result<Option<Self>, SpecError> {
        if let Some((field, stored, asked)) = self.settings.difference(settings) {
            return Err(SpecError::new(
                format!("split.{field}"),
                format!(
                    "the split {:?} was made with {stored}, but {asked} was asked for; give another name to a split \
                     with other settings",
                    self.settings.name
                ),
            ));
        }
        let mut all: BTreeSet<u64> = SIDES.iter().flat_map(|side| self.scenes(side)).collect();
        let before = all.len();
        all.extend(scenes);
        if all.len() == before {
            return Ok(None);
        }
        let (version, made_of) = (self.version + 1, self.made_of);
        Ok(Some(Self::assemble(
            settings.clone(),
            version,
            made_of,
            self.cuts,
            &all,
        )))
    }

    fn assemble(
        settings: SplitSettings,
        version: u64,
        made_of: u64,
        cuts: [Cut; 2],
        scenes: &BTreeSet<u64>,
    ) -> Self {
        let room = scenes.last().map_or(0, |last| last + 1);
        let mut sides = vec![ABSENT; room as usize];
        let mut counts = [0; 3];
        for scene in scenes {
            let side = side(settings.seed, &cuts, *scene);
            sides[*scene as usize] = LETTERS[side];
            counts[side] += 1;
        }
        let decode = [
            "record = json.load(open('v1.json'))  # this file",
            "side = numpy.frombuffer(record['sides'].encode(), dtype='uint8') - ord('0')  # 254 = not part of it",
            "train, validation, test = (numpy.flatnonzero(side == k) for k in range(3))  # scene indices",
        ];
        Self {
            format: SPLIT_FORMAT,
            settings,
            version,
            made_of,
            cuts,
            counts,
            sides: String::from_utf8(sides).expect("letters"),
            decode: decode.map(String::from).to_vec(),
        }
    }

    /// Returns the scenes of `train`, `validation` or `test`, ascending; none for another name.
    pub fn scenes(&self, side: &str) -> Vec<u64> {
        let letter = SIDES.iter().position(|s| *s == side).map(|s| LETTERS[s]);
        let letters = self.sides.bytes().zip(0..);
        letters
            .filter(|(l, _)| Some(*l) == letter)
            .map(|(_, scene)| scene)
            .collect()
    }

    /// Returns the bytes of the stored form.
    pub fn to_bytes(&self) -> Vec<u8> {
        let mut bytes = serde_json::to_vec_pretty(self).expect("a record is plain data");
        bytes.push(b'\n');
        bytes
    }

    /// Parses a stored record.
    ///
    /// # Errors
    /// Returns a description of the fault.
    pub fn parse(bytes: &[u8]) -> Result<Self, String> {
        let record: Self =
            serde_json::from_slice(bytes).map_err(|e| format!("not a record of a split: {e}"))?;
        if record.format > SPLIT_FORMAT {
            return Err(format!(
                "written in format {}, this program knows formats up to {SPLIT_FORMAT}: use a newer one",
                record.format
            ));
        }
        let count = |letter| record.sides.bytes().filter(|l| *l == letter).count() as u64;
        if record.counts != LETTERS.map(count) {
            return Err("its counts are not those of its sides".into());
        }
        Ok(record)
    }
}

/// Returns the side of a scene: 0, 1 or 2.
fn side(seed: u64, cuts: &[Cut; 2], scene: u64) -> usize {
    let rank = Rank::of(seed, scene);
    let passed = |cut: &&Cut| match cut {
        Cut::Start => true,
        Cut::At(first) => rank >= *first,
        Cut::End => false,
    };
    cuts.iter().filter(passed).count()
}

/// Hashes as text, because JavaScript and many other languages have no 64-bit integers.
mod hex_u64 {
    use serde::{Deserialize, Deserializer, Serializer, de::Error};

    pub fn serialize<S: Serializer>(value: &u64, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(&format!("{value:016x}"))
    }

    pub fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<u64, D::Error> {
        let text = String::deserialize(deserializer)?;
        u64::from_str_radix(&text, 16).map_err(D::Error::custom)
    }
}
