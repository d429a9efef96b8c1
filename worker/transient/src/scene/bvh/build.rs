//! Builds the hierarchy: a binary tree from `obvhs`, collapsed to eight children per node according
//! to [`Plan`].

use std::{
    sync::mpsc::{self, RecvTimeoutError},
    time::Duration,
};

use obvhs::{
    Boundable, BvhBuildParams,
    aabb::Aabb,
    bvh2::{Bvh2, builder::build_bvh2},
    triangle::Triangle,
};
use picofarm_scene::Vec3;

use crate::{
    api::{RenderError, Stop, Unstopped},
    scene::bvh::{
        alike, build, needle,
        nodes::{EMPTY, Kernel, LEAF, Node, Pack},
        normal::normal,
        plan::Plan,
        simd,
        tree::Bvh,
    },
};

impl Bvh {
    /// Builds the hierarchy. Triangles without area or with vertices that are not finite are left
    /// out.
    pub fn build(triangles: &[[Vec3; 3]]) -> Self {
        build::build_unless(triangles, Stop(&Unstopped)).expect("nobody stops it")
    }

    /// Like [`Bvh::build`], but returns an error if a stop is requested.
    pub(crate) fn build_unless(triangles: &[[Vec3; 3]], stop: Stop) -> Result<Self, RenderError> {
        build::build_unless(triangles, stop)
    }
}

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

/// Number of triangles from which the binary tree is built on a thread of its own, which can be
/// abandoned.
const MANY: usize = 1 << 17;

/// Interval between two polls of the stop request meanwhile.
const LOOK: Duration = Duration::from_millis(50);

pub(crate) fn build_unless(triangles: &[[Vec3; 3]], stop: Stop) -> Result<Bvh, RenderError> {
    let mut bvh = Bvh {
        nodes: vec![],
        packs: vec![],
        depth: 0,
        kernel: [Kernel::Avx512, Kernel::Avx2]
            .into_iter()
            .find(|&k| simd::available(k))
            .unwrap_or(Kernel::Portable),
    };
    // A triangle without area cannot be hit and is dropped; near-degenerate ones stay.
    let used: Vec<u32> = (0..triangles.len() as u32)
        .filter(|&i| normal(&triangles[i as usize]).is_some())
        .collect();
    if used.is_empty() {
        return Ok(bvh);
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
    let tree = match input.len() < MANY {
        true => binary(&input),
        false => apart(input, stop)?,
    };
    let plan = Plan::new(&tree);
    bvh.nodes.push(NO_NODE);
    let mut open = vec![(0usize, 0usize, 1usize)];
    let (mut children, mut held) = (vec![], vec![]);
    let mut steps = 0u32;
    while let Some((node, slot, depth)) = open.pop() {
        steps += 1;
        if steps.is_multiple_of(4096) {
            stop.check()?;
        }
        bvh.depth = bvh.depth.max(depth);
        plan.children(&tree, node, &mut children);
        let mut wide = NO_NODE;
        for (i, &c) in children.iter().enumerate() {
            let aabb = tree.nodes[c].aabb();
            for d in 0..3 {
                wide.bounds[d][i] = aabb.min[d];
                wide.bounds[3 + d][i] = aabb.max[d];
            }
            wide.child[i] = if plan.is_leaf(c) {
                plan.triangles(&tree, c, &mut held);
                for k in &mut held {
                    *k = used[*k as usize];
                }
                bvh.pack(triangles, &held)
            } else {
                let s = bvh.nodes.len();
                bvh.nodes.push(NO_NODE);
                open.push((c, s, depth + 1));
                s as u32
            };
        }
        bvh.nodes[slot] = wide;
    }
    Ok(bvh)
}

fn binary(input: &[Triangle]) -> Bvh2 {
    let boxes: Vec<Aabb> = input.iter().map(Boundable::aabb).collect();
    let Some(groups) = alike::groups(&boxes) else {
        return joined(input);
    };
    let bounds: Vec<Aabb> = groups.iter().map(|g| g.bounds).collect();
    let mut tree = joined(&bounds);
    alike::expand(&mut tree, &groups, &boxes);
    tree
}

fn joined<T: Boundable>(input: &[T]) -> Bvh2 {
    let mut params = BvhBuildParams::medium_build();
    params.pre_split = false;
    params.max_prims_per_leaf = 1;
    params.reinsertion_batch_ratio = 0.1;
    params.post_collapse_reinsertion_batch_ratio_multiplier = 0.0;
    build_bvh2(input, params, &mut Duration::default())
}

/// Builds the same tree on a thread of its own. The library's builder cannot be stopped, but it can
/// be abandoned: it then finishes by itself, and its tree is dropped.
fn apart(input: Vec<Triangle>, stop: Stop) -> Result<Bvh2, RenderError> {
    let (done, tree) = mpsc::channel();
    let builder = move || {
        // If the render was stopped, the receiver no longer exists.
        let _ = done.send(binary(&input));
    };
    let named = std::thread::Builder::new().name("bvh".into());
    named.spawn(builder).map_err(|e| RenderError::Invalid {
        field: "threads".into(),
        what: format!("cannot start one to build a large scene's tree: {e}"),
    })?;
    loop {
        match tree.recv_timeout(LOOK) {
            Ok(tree) => return Ok(tree),
            Err(RecvTimeoutError::Timeout) => stop.check()?,
            Err(RecvTimeoutError::Disconnected) => panic!("the tree's builder broke"),
        }
    }
}

fn array(p: Vec3) -> [f32; 3] {
    p.into()
}

impl Bvh {
    /// Stores a leaf and returns its code as a child.
    pub(crate) fn pack(&mut self, triangles: &[[Vec3; 3]], held: &[u32]) -> u32 {
        let start = self.packs.len() as u32;
        for chunk in held.chunks(8) {
            let mut pack = Pack {
                vertex: [[f32::NAN; 8]; 9],
                id: [EMPTY; 8],
            };
            for (lane, &id) in chunk.iter().enumerate() {
                for (v, p) in triangles[id as usize].iter().enumerate() {
                    for d in 0..3 {
                        pack.vertex[3 * v + d][lane] = p[d];
                    }
                }
                pack.id[lane] = id | needle::mark(&triangles[id as usize]);
            }
            self.packs.push(pack);
        }
        let count = self.packs.len() as u32 - start;
        let last = (held.len() as u32 - 1) % 8;
        assert!(
            start < (1 << 24) && count < 16,
            "leaves hold few triangles and scenes fewer than 2^24 packs"
        );
        LEAF | (count << 27) | (last << 24) | start
    }
}
