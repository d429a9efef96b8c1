//! Sums of small oblivious trees (as in CatBoost, Prokhorenkova et al., NeurIPS 2018): all nodes of
//! a level ask one question, so that a tree is a table over the answers.

/// Most levels of a tree.
pub const LEVELS: usize = 6;
/// Unit of the values of leaves.
pub const UNIT: f32 = 1.0 / 4096.0;
/// The first bytes of a file of forests.
const MAGIC: &[u8; 8] = b"pf-trees";

/// A tree: the answers to its questions, most significant first, are the index of its leaf.
#[derive(Debug, Clone, PartialEq)]
pub struct Tree {
    /// Feature and border of each level: whether the feature exceeds that border.
    pub questions: [(u8, u8); LEVELS],
    /// Log odds in units of [`UNIT`].
    pub leaves: Vec<i16>,
}

/// A sum of trees over features that are cut at borders.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Forest {
    /// Ascending borders of each feature, at most 255.
    pub borders: Vec<Vec<f32>>,
    /// Log odds before any tree.
    pub base: f32,
    /// The trees.
    pub trees: Vec<Tree>,
}

impl Forest {
    /// How many borders of a feature a value exceeds.
    #[inline]
    pub fn cut(borders: &[f32], value: f32) -> u8 {
        borders.partition_point(|b| *b < value) as u8
    }

    /// Log odds of items whose features are cut: `[feature][item]`.
    pub fn log_odds(&self, cut: &[Vec<u8>], items: usize) -> Vec<f32> {
        const BLOCK: usize = 1024;
        let mut sums = vec![0i32; items];
        let mut index = [0u8; BLOCK];
        for (n, sums) in sums.chunks_mut(BLOCK).enumerate() {
            let start = n * BLOCK;
            for tree in &self.trees {
                let index = &mut index[..sums.len()];
                index.fill(0);
                for (feature, border) in tree.questions {
                    let values = &cut[usize::from(feature)][start..][..sums.len()];
                    for (i, v) in index.iter_mut().zip(values) {
                        *i = (*i << 1) | u8::from(*v > border);
                    }
                }
                for (sum, i) in sums.iter_mut().zip(index) {
                    *sum += i32::from(tree.leaves[usize::from(*i)]);
                }
            }
        }
        sums.into_iter()
            .map(|s| self.base + s as f32 * UNIT)
            .collect()
    }

    /// Forests as bytes: little-endian, each with its borders and trees.
    pub fn write(forests: &[Self]) -> Vec<u8> {
        let mut bytes = MAGIC.to_vec();
        bytes.push(forests.len() as u8);
        for f in forests {
            bytes.push(f.borders.len() as u8);
            for borders in &f.borders {
                bytes.push(borders.len() as u8);
                bytes.extend(borders.iter().flat_map(|b| b.to_le_bytes()));
            }
            bytes.extend(f.base.to_le_bytes());
            bytes.extend((f.trees.len() as u16).to_le_bytes());
            for tree in &f.trees {
                bytes.extend(tree.questions.iter().flat_map(|(a, b)| [*a, *b]));
                bytes.extend(tree.leaves.iter().flat_map(|l| l.to_le_bytes()));
            }
        }
        bytes
    }

    /// Forests from bytes. Returns `None` if they are not what [`Self::write`] gives.
    pub fn read(bytes: &[u8]) -> Option<Vec<Self>> {
        let mut rest = bytes.strip_prefix(MAGIC)?;
        let count = take::<1>(&mut rest)?[0];
        let mut forests = Vec::new();
        for _ in 0..count {
            let mut f = Self::default();
            for _ in 0..take::<1>(&mut rest)?[0] {
                let many = take::<1>(&mut rest)?[0];
                let all = (0..many).map(|_| take::<4>(&mut rest).map(f32::from_le_bytes));
                f.borders.push(all.collect::<Option<_>>()?);
            }
            f.base = f32::from_le_bytes(take::<4>(&mut rest)?);
            let trees = u16::from_le_bytes(take::<2>(&mut rest)?);
            for _ in 0..trees {
                let mut questions = [(0, 0); LEVELS];
                for q in &mut questions {
                    let [feature, border] = take::<2>(&mut rest)?;
                    if usize::from(feature) >= f.borders.len() {
                        return None;
                    }
                    *q = (feature, border);
                }
                let leaves = (0..1 << LEVELS).map(|_| take::<2>(&mut rest).map(i16::from_le_bytes));
                f.trees.push(Tree {
                    questions,
                    leaves: leaves.collect::<Option<_>>()?,
                });
            }
            forests.push(f);
        }
        rest.is_empty().then_some(forests)
    }
}

fn take<const N: usize>(rest: &mut &[u8]) -> Option<[u8; N]> {
    let (head, tail) = rest.split_first_chunk::<N>()?;
    *rest = tail;
    Some(*head)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn forest() -> Forest {
        let mut questions = [(0, 0); LEVELS];
        questions[0] = (1, 1);
        Forest {
            borders: vec![vec![0.0], vec![-1.0, 2.0]],
            base: 0.5,
            trees: vec![Tree {
                questions,
                leaves: (0..1 << LEVELS)
                    .map(|k| if k < 32 { -4096 } else { 4096 })
                    .collect(),
            }],
        }
    }

    #[test]
    fn a_tree_answers_by_its_borders() {
        let f = forest();
        let values = [-3.0f32, 1.0, 2.0, 2.5];
        let cut = |k: usize| {
            values
                .iter()
                .map(|v| Forest::cut(&f.borders[k], *v))
                .collect()
        };
        let odds = f.log_odds(&[cut(0), cut(1)], values.len());
        assert_eq!(odds, [-0.5, -0.5, -0.5, 1.5]);
    }

    #[test]
    fn forests_come_back_from_bytes_and_parts_of_them_do_not() {
        let all = vec![forest(), forest()];
        let bytes = Forest::write(&all);
        assert_eq!(Forest::read(&bytes), Some(all));
        assert_eq!(Forest::read(&bytes[..bytes.len() - 1]), None);
        assert_eq!(Forest::read(b"other"), None);
    }
}
