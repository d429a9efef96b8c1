//! A bounding volume hierarchy by median splits. Its depth depends on the number of triangles
//! alone, so that triangles of any shape and place, also equal ones, are searched safely.

use crate::{Vec3, trace::intersect};

/// The greatest number of triangles of a leaf.
const LEAF: usize = 4;

/// Triangles in world space, ready for rays.
pub(crate) struct Tree {
    /// In the order of the leaves.
    triangles: Vec<[Vec3; 3]>,
    nodes: Vec<Node>,
}

struct Node {
    lo: Vec3,
    hi: Vec3,
    /// The range of triangles of a leaf, or the indices of two children.
    content: Content,
}

enum Content {
    Leaf(usize, usize),
    Inner(usize, usize),
}

impl Tree {
    /// Builds the tree. The corners must be finite.
    pub(crate) fn new(mut triangles: Vec<[Vec3; 3]>) -> Self {
        let mut nodes = Vec::new();
        let count = triangles.len();
        if count > 0 {
            build(&mut triangles, 0, count, &mut nodes);
        }
        Self { triangles, nodes }
    }

    /// Returns the ray parameter and the corners of the closest triangle with t > 0.
    pub(crate) fn closest(&self, origin: Vec3, direction: Vec3) -> Option<(f32, [Vec3; 3])> {
        let inverse = Vec3::new(1.0 / direction.x, 1.0 / direction.y, 1.0 / direction.z);
        let mut best: Option<(f32, [Vec3; 3])> = None;
        let mut open: Vec<usize> = match self.nodes.is_empty() {
            true => return None,
            false => vec![self.nodes.len() - 1],
        };
        while let Some(node) = open.pop() {
            let node = &self.nodes[node];
            if !node.is_before(origin, inverse, best.map_or(f32::MAX, |b| b.0)) {
                continue;
            }
            match node.content {
                Content::Inner(a, b) => open.extend([a, b]),
                Content::Leaf(from, to) => {
                    for triangle in &self.triangles[from..to] {
                        let hit = intersect(*triangle, origin, direction).filter(|t| *t > 0.0);
                        if let Some(t) = hit
                            && best.is_none_or(|b| t < b.0)
                        {
                            best = Some((t, *triangle));
                        }
                    }
                }
            }
        }
        best
    }
}

impl Node {
    fn is_before(&self, origin: Vec3, inverse: Vec3, limit: f32) -> bool {
        let (mut near, mut far) = (0.0f32, limit);
        for k in 0..3 {
            let a = (self.lo[k] - origin[k]) * inverse[k];
            let b = (self.hi[k] - origin[k]) * inverse[k];
            // min and max drop the NaN of 0·∞ (a ray inside a slab and parallel to it).
            near = near.max(a.min(b));
            far = far.min(a.max(b));
        }
        near <= far * (1.0 + 1e-5)
    }
}

/// Appends the nodes of a range of triangles, the root last, and returns the root's index.
fn build(all: &mut [[Vec3; 3]], from: usize, to: usize, nodes: &mut Vec<Node>) -> usize {
    let part = &mut all[from..to];
    let corners = part.iter().flatten();
    let (lo, hi) = corners.fold(
        (Vec3::splat(f32::INFINITY), Vec3::splat(f32::NEG_INFINITY)),
        |(lo, hi), p| (lo.min(*p), hi.max(*p)),
    );
    let content = match part.len() <= LEAF {
        true => Content::Leaf(from, to),
        false => {
            let size = hi - lo;
            let axis = match (size.x >= size.y && size.x >= size.z, size.y >= size.z) {
                (true, _) => 0,
                (_, true) => 1,
                _ => 2,
            };
            let centre = |t: &[Vec3; 3]| t[0][axis] + t[1][axis] + t[2][axis];
            let half = part.len() / 2;
            part.select_nth_unstable_by(half, |a, b| centre(a).total_cmp(&centre(b)));
            let middle = from + half;
            let first = build(all, from, middle, nodes);
            Content::Inner(first, build(all, middle, to, nodes))
        }
    };
    nodes.push(Node { lo, hi, content });
    nodes.len() - 1
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_tree_finds_what_a_search_of_all_finds_also_among_equal_triangles() {
        let mut state = 1u32;
        let mut random = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) as f32 / (1 << 24) as f32
        };
        let mut point = || Vec3::new(random(), random(), random());
        let mut all: Vec<[Vec3; 3]> = (0..200).map(|_| [point(), point(), point()]).collect();
        all.extend(std::iter::repeat_n(all[0], 100_000));
        let rays: Vec<[Vec3; 2]> = (0..50).map(|_| [point(), point() - point()]).collect();
        let tree = Tree::new(all.clone());
        for [origin, direction] in rays {
            let hits = all[..200].iter();
            let expected = hits
                .filter_map(|t| intersect(*t, origin, direction).filter(|t| *t > 0.0))
                .min_by(f32::total_cmp);
            let found = tree.closest(origin, direction).map(|(t, _)| t);
            assert_eq!(found, expected);
        }
        assert!(
            Tree::new(Vec::new())
                .closest(Vec3::ZERO, Vec3::splat(1.0))
                .is_none()
        );
    }
}
