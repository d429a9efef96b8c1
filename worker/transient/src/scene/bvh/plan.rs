//! Collapses a binary tree to one with eight children per node at the least expected cost.
//!
//! This is the dynamic programme of Ylitie, Karras and Laine (HPG 2017, section 3.2), with the cost
//! of this traversal: a node and a leaf cost the same for any number of children or triangles, up
//! to eight. It fills nodes and leaves better than opening the widest child does.

use obvhs::bvh2::Bvh2;

/// Number of triangles in a leaf: one pack.
const LEAF_SIZE: u32 = 8;

/// Cost of visiting a leaf, in visits of a node.
const LEAF_COST: f32 = 1.0;

/// The optimal choices for one subtree.
#[derive(Debug, Clone, Copy, Default)]
struct Choice {
    /// Least cost of the subtree as at most 1, 2, … 8 roots.
    cost: [f32; 8],
    /// For 2, … 8 roots: the number of roots in the left child; 0 if one root fewer costs no more.
    left: [u8; 8],
    /// The same for the children of this subtree's own node.
    split: u8,
    /// Whether the subtree as one root is a leaf.
    leaf: bool,
    /// Number of triangles below.
    count: u32,
}

/// The choices, by node of the binary tree.
#[derive(Debug)]
pub(crate) struct Plan(Vec<Choice>);

impl Plan {
    pub(crate) fn new(tree: &Bvh2) -> Self {
        let mut plan = Self(vec![Choice::default(); tree.nodes.len()]);
        // List parents before children, then visit the list backwards.
        let mut order = vec![0usize];
        let mut i = 0;
        while i < order.len() {
            let node = &tree.nodes[order[i]];
            if node.prim_count == 0 {
                let first = node.first_index as usize;
                order.extend([first, first + 1]);
            }
            i += 1;
        }
        for &n in order.iter().rev() {
            plan.0[n] = plan.choose(tree, n);
        }
        plan
    }

    fn choose(&self, tree: &Bvh2, n: usize) -> Choice {
        let node = &tree.nodes[n];
        let area = node.aabb().half_area();
        if node.prim_count > 0 {
            let packs = node.prim_count.div_ceil(LEAF_SIZE);
            return Choice {
                cost: [area * LEAF_COST * packs as f32; 8],
                leaf: true,
                count: node.prim_count,
                ..Choice::default()
            };
        }
        let first = node.first_index as usize;
        let (a, b) = (&self.0[first], &self.0[first + 1]);
        // Returns the best division of `roots` ≥ 2 between the children.
        let share = |roots: usize| {
            let cost = |k: usize| a.cost[k - 1] + b.cost[roots - k - 1];
            (1..roots).fold((f32::INFINITY, 1), |best, k| {
                if cost(k) < best.0 {
                    (cost(k), k as u8)
                } else {
                    best
                }
            })
        };
        let mut choice = Choice {
            count: a.count + b.count,
            ..Choice::default()
        };
        let (below, split) = share(8);
        choice.split = split;
        choice.cost[0] = area + below;
        if choice.count <= LEAF_SIZE && area * LEAF_COST <= choice.cost[0] {
            (choice.cost[0], choice.leaf) = (area * LEAF_COST, true);
        }
        for roots in 2..=8 {
            let (cost, left) = share(roots);
            choice.cost[roots - 1] = choice.cost[roots - 2];
            if cost < choice.cost[roots - 1] {
                (choice.cost[roots - 1], choice.left[roots - 1]) = (cost, left);
            }
        }
        choice
    }

    /// Returns whether the subtree as one root is a leaf.
    pub(crate) fn is_leaf(&self, n: usize) -> bool {
        self.0[n].leaf
    }

    /// Writes the children of the wide node for subtree `n`, at most eight. If the tree is one
    /// leaf, writes that leaf.
    pub(crate) fn children(&self, tree: &Bvh2, n: usize, children: &mut Vec<usize>) {
        children.clear();
        if self.0[n].leaf {
            children.push(n);
            return;
        }
        let (first, split) = (
            tree.nodes[n].first_index as usize,
            usize::from(self.0[n].split),
        );
        let mut open = vec![(first + 1, 8 - split), (first, split)];
        while let Some((n, mut roots)) = open.pop() {
            while roots > 1 && self.0[n].left[roots - 1] == 0 {
                roots -= 1;
            }
            if roots == 1 {
                children.push(n);
            } else {
                let first = tree.nodes[n].first_index as usize;
                let left = usize::from(self.0[n].left[roots - 1]);
                open.extend([(first + 1, roots - left), (first, left)]);
            }
        }
    }

    /// Writes the triangles below `n`.
    pub(crate) fn triangles(&self, tree: &Bvh2, n: usize, held: &mut Vec<u32>) {
        held.clear();
        let mut open = vec![n];
        while let Some(n) = open.pop() {
            let node = &tree.nodes[n];
            let first = node.first_index as usize;
            if node.prim_count > 0 {
                let range = first..first + node.prim_count as usize;
                held.extend_from_slice(&tree.primitive_indices[range]);
            } else {
                open.extend([first + 1, first]);
            }
        }
    }
}
