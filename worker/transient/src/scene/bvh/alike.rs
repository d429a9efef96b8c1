//! Handles large numbers of nearly identical boxes. A builder that joins the pair with the smallest
//! surface cannot distinguish them: every union has the same size, each round joins one pair, and
//! the tree becomes a chain, built in quadratic time. Such boxes are therefore built as one box,
//! and the subtree below it is built by halving.

use std::collections::HashMap;

use obvhs::{
    aabb::Aabb,
    bvh2::{Bvh2, node::Bvh2Node},
};

/// Number of identical boxes that does no harm, because they fit in one leaf.
const FEW: usize = 8;

/// Relative tolerance of two identical boxes: well above the f32 precision of a surface.
const SHARE: f32 = 1.0 / 65536.0;

/// Smaller boxes count as boxes of this size, render units.
const LEAST: f32 = 1e-12;

/// A box, or several nearly identical boxes.
#[derive(Debug)]
pub(crate) struct Group {
    pub bounds: Aabb,
    /// The indices of the boxes.
    pub members: Vec<u32>,
}

/// Returns groups of boxes in the order of their first members; `None` if no more than [`FEW`]
/// boxes are identical anywhere.
pub(crate) fn groups(boxes: &[Aabb]) -> Option<Vec<Group>> {
    let mut by_key = HashMap::with_capacity(boxes.len());
    let (mut group_of, mut count) = (Vec::with_capacity(boxes.len()), vec![]);
    for b in boxes {
        let group = *by_key.entry(key(b)).or_insert(count.len());
        match count.get_mut(group) {
            Some(n) => *n += 1,
            None => count.push(1usize),
        }
        group_of.push(group);
    }
    if count.iter().all(|&n| n <= FEW) {
        return None;
    }
    let mut groups: Vec<Group> = vec![];
    let mut place = vec![usize::MAX; count.len()];
    for (k, &group) in group_of.iter().enumerate() {
        let position = place[group];
        if count[group] > FEW && position != usize::MAX {
            groups[position].bounds = groups[position].bounds.union(&boxes[k]);
            groups[position].members.push(k as u32);
        } else {
            place[group] = groups.len();
            groups.push(Group {
                bounds: boxes[k],
                members: vec![k as u32],
            });
        }
    }
    Some(groups)
}

/// Returns a key that nearly identical boxes share.
fn key(b: &Aabb) -> [i64; 7] {
    let (low, high) = (b.min.to_array(), b.max.to_array());
    let size = (0..3).fold(LEAST, |a, k| a.max(high[k] - low[k]));
    // Rounds to a power of two by clearing all bits except the exponent.
    let size = f32::from_bits(size.to_bits() & 0x7f80_0000);
    let step = f64::from(size * SHARE);
    let cell = |x: f32| (f64::from(x) / step).round() as i64;
    let [x, y, z] = low.map(cell);
    let [u, v, w] = high.map(cell);
    [x, y, z, u, v, w, i64::from(size.to_bits())]
}

/// Turns a tree over groups into one over their members.
pub(crate) fn expand(tree: &mut Bvh2, groups: &[Group], boxes: &[Aabb]) {
    let held = std::mem::take(&mut tree.primitive_indices);
    for n in 0..tree.nodes.len() {
        let node = tree.nodes[n];
        if node.prim_count > 0 {
            debug_assert_eq!(node.prim_count, 1, "a leaf is a group");
            let group = &groups[held[node.first_index as usize] as usize];
            halve(tree, n, &group.members, boxes);
        }
    }
}

/// Replaces node `n` by a subtree over `members`, halved along the axis with the largest spread of
/// their centres.
fn halve(tree: &mut Bvh2, n: usize, members: &[u32], boxes: &[Aabb]) {
    let mut members = members.to_vec();
    let centre = |k: u32, axis: usize| {
        let b = &boxes[k as usize];
        b.min[axis] + b.max[axis]
    };
    let spread = |axis: usize| {
        let all = || members.iter().map(|&k| centre(k, axis));
        all().fold(f32::NEG_INFINITY, f32::max) - all().fold(f32::INFINITY, f32::min)
    };
    let axis = (1..3).fold(0, |a, b| if spread(b) > spread(a) { b } else { a });
    members.sort_by(|&a, &b| centre(a, axis).total_cmp(&centre(b, axis)).then(a.cmp(&b)));
    let around = |part: &[u32]| {
        let each = part.iter().map(|&k| boxes[k as usize]);
        each.reduce(|a, b| a.union(&b)).expect("a part has members")
    };
    let mut open = vec![(n, 0, members.len())];
    while let Some((n, from, to)) = open.pop() {
        let part = &members[from..to];
        if let &[one] = part {
            let position = tree.primitive_indices.len() as u32;
            tree.primitive_indices.push(one);
            tree.nodes[n] = Bvh2Node::new(boxes[one as usize], 1, position);
            continue;
        }
        let first = tree.nodes.len();
        tree.nodes[n] = Bvh2Node::new(around(part), 0, first as u32);
        tree.nodes.extend([Bvh2Node::default(); 2]);
        let half = from.midpoint(to);
        open.extend([(first, from, half), (first + 1, half, to)]);
    }
}

#[cfg(test)]
mod tests {
    use obvhs::{BvhBuildParams, bvh2::builder::build_bvh2};

    use super::*;

    fn aabb(min: [f32; 3], max: [f32; 3]) -> Aabb {
        Aabb::new(min.into(), max.into())
    }

    #[test]
    fn sheets_that_lie_closer_than_f32_tells_make_a_tree_of_little_depth_that_holds_each_once() {
        let mut boxes: Vec<Aabb> = (0..40_000)
            .map(|k| {
                let z = 1e-30 * k as f32;
                aabb([-1.0, -1.0, z], [1.0, 1.0, z])
            })
            .collect();
        boxes.extend((0..1000).map(|k| {
            let x = k as f32;
            aabb([x, 0.0, 0.0], [x + 2.0, 1.0, 1.0])
        }));
        let groups = groups(&boxes).unwrap();
        assert!(groups.len() < 1100, "{}", groups.len());
        let bounds: Vec<Aabb> = groups.iter().map(|g| g.bounds).collect();
        let mut params = BvhBuildParams::medium_build();
        params.max_prims_per_leaf = 1;
        let mut tree = build_bvh2(&bounds, params, &mut Default::default());
        expand(&mut tree, &groups, &boxes);
        let (mut met, mut open) = (vec![0; boxes.len()], vec![(0usize, 0)]);
        while let Some((n, depth)) = open.pop() {
            assert!(depth < 64);
            let (node, first) = (&tree.nodes[n], tree.nodes[n].first_index as usize);
            if node.prim_count == 1 {
                met[tree.primitive_indices[first] as usize] += 1;
                continue;
            }
            for child in [first, first + 1] {
                let (outer, inner) = (node.aabb(), tree.nodes[child].aabb());
                assert_eq!(outer.union(inner), *outer);
                open.push((child, depth + 1));
            }
        }
        assert!(met.iter().all(|&n| n == 1));
    }

    #[test]
    fn boxes_that_differ_stay_by_themselves() {
        let boxes: Vec<Aabb> = (0..1000)
            .map(|k| {
                let x = 0.01 * k as f32;
                aabb([x, 0.0, 0.0], [x + 0.01, 0.01, 0.0])
            })
            .collect();
        assert!(groups(&boxes).is_none());
        assert!(groups(&[boxes[0]; 8]).is_none());
        let many = groups(&[boxes[0]; 9]).unwrap();
        assert_eq!(many.len(), 1);
        assert_eq!(many[0].members, [0, 1, 2, 3, 4, 5, 6, 7, 8]);
    }
}
