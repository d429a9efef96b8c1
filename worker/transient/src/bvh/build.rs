//! Building: a binary tree from `obvhs`, collapsed to eight children a node.

use obvhs::{
    BvhBuildParams,
    bvh2::{Bvh2, builder::build_bvh2},
    triangle::Triangle,
};
use picofarm_scene::Vec3;

use super::{Bvh, EMPTY, Kernel, LEAF, Node, Pack, simd};

/// Triangles in a leaf: one pack.
const LEAF_SIZE: u32 = 8;

const NO_NODE: Node = Node {
    bounds: [
        [f32::INFINITY; 8],
        [f32::INFINITY; 8],
        [f32::INFINITY; 8],
        [f32::NEG_INFINITY; 8],
        [f32::NEG_INFINITY; 8],
        [f32::NEG_INFINITY; 8],
    ],
    child: [EMPTY; 8],
};

pub(super) fn build(triangles: &[[Vec3; 3]]) -> Bvh {
    let mut bvh = Bvh {
        nodes: vec![],
        packs: vec![],
        depth: 0,
        kernel: [Kernel::Avx512, Kernel::Avx2]
            .into_iter()
            .find(|&k| simd::available(k))
            .unwrap_or(Kernel::Portable),
    };
    // A triangle without area cannot be hit; near-degenerate ones stay.
    let used: Vec<u32> = (0..triangles.len() as u32)
        .filter(|&i| normal(&triangles[i as usize]).is_some())
        .collect();
    if used.is_empty() {
        return bvh;
    }
    let input: Vec<Triangle> = used
        .iter()
        .map(|&i| {
            let [a, b, c] = triangles[i as usize];
            let mut t = Triangle::default();
            (t.v0, t.v1, t.v2) = (array(a).into(), array(b).into(), array(c).into());
            t
        })
        .collect();
    let mut params = BvhBuildParams::medium_build();
    params.pre_split = false;
    params.max_prims_per_leaf = LEAF_SIZE;
    let tree = build_bvh2(&input, params, &mut std::time::Duration::default());
    bvh.nodes.push(NO_NODE);
    let mut open = vec![(0usize, 0usize, 1usize)];
    while let Some((node, slot, depth)) = open.pop() {
        bvh.depth = bvh.depth.max(depth);
        bvh.collapse(&tree, node, slot, depth, triangles, &used, &mut open);
    }
    bvh
}

fn array(p: Vec3) -> [f32; 3] {
    p.into()
}

/// Unit normal (v1−v0)×(v2−v0), computed in f64; `None` for a triangle without area.
pub(crate) fn normal(t: &[Vec3; 3]) -> Option<Vec3> {
    let wide = |v: Vec3| [f64::from(v.x), f64::from(v.y), f64::from(v.z)];
    let [a, b, c] = t.map(wide);
    let e = [b[0] - a[0], b[1] - a[1], b[2] - a[2]];
    let f = [c[0] - a[0], c[1] - a[1], c[2] - a[2]];
    let n = [
        e[1] * f[2] - e[2] * f[1],
        e[2] * f[0] - e[0] * f[2],
        e[0] * f[1] - e[1] * f[0],
    ];
    let length = (n[0] * n[0] + n[1] * n[1] + n[2] * n[2]).sqrt();
    if length.is_finite() && length > 0.0 {
        let k = 1.0 / length;
        Some(Vec3::new(
            (n[0] * k) as f32,
            (n[1] * k) as f32,
            (n[2] * k) as f32,
        ))
    } else {
        None
    }
}

impl Bvh {
    #[expect(clippy::too_many_arguments, reason = "one step of a conversion loop")]
    fn collapse(
        &mut self,
        tree: &Bvh2,
        node: usize,
        slot: usize,
        depth: usize,
        triangles: &[[Vec3; 3]],
        used: &[u32],
        open: &mut Vec<(usize, usize, usize)>,
    ) {
        let leaf = |n: usize| tree.nodes[n].prim_count > 0;
        let first = |n: usize| tree.nodes[n].first_index as usize;
        let mut children = if leaf(node) {
            vec![node]
        } else {
            vec![first(node), first(node) + 1]
        };
        // Open the child of largest surface until eight are there.
        while children.len() < 8 {
            let mut widest: Option<(usize, f32)> = None;
            for (i, &c) in children.iter().enumerate() {
                let area = tree.nodes[c].aabb().half_area();
                if !leaf(c) && widest.is_none_or(|(_, a)| area > a) {
                    widest = Some((i, area));
                }
            }
            let Some((i, _)) = widest else { break };
            let c = first(children[i]);
            children[i] = c;
            children.push(c + 1);
        }
        let mut wide = NO_NODE;
        for (i, &c) in children.iter().enumerate() {
            let aabb = tree.nodes[c].aabb();
            for d in 0..3 {
                wide.bounds[d][i] = aabb.min[d];
                wide.bounds[3 + d][i] = aabb.max[d];
            }
            wide.child[i] = if leaf(c) {
                self.pack(tree, c, triangles, used)
            } else {
                let s = self.nodes.len();
                self.nodes.push(NO_NODE);
                open.push((c, s, depth + 1));
                s as u32
            };
        }
        self.nodes[slot] = wide;
    }

    fn pack(&mut self, tree: &Bvh2, leaf: usize, triangles: &[[Vec3; 3]], used: &[u32]) -> u32 {
        let node = &tree.nodes[leaf];
        let start = self.packs.len() as u32;
        let range = node.first_index as usize..(node.first_index + node.prim_count) as usize;
        for chunk in tree.primitive_indices[range].chunks(8) {
            let mut pack = Pack {
                vertex: [[f32::NAN; 8]; 9],
                id: [EMPTY; 8],
            };
            for (lane, &k) in chunk.iter().enumerate() {
                let id = used[k as usize];
                for (v, p) in triangles[id as usize].iter().enumerate() {
                    for d in 0..3 {
                        pack.vertex[3 * v + d][lane] = p[d];
                    }
                }
                pack.id[lane] = id;
            }
            self.packs.push(pack);
        }
        let count = self.packs.len() as u32 - start;
        let last = (node.prim_count - 1) % 8;
        assert!(
            start < (1 << 24) && count < 16,
            "leaves hold at most {LEAF_SIZE} triangles and scenes fewer than 2^24 packs"
        );
        LEAF | (count << 27) | (last << 24) | start
    }
}
