//! Closest-hit rays against placed meshes, for the generators' own checks (support, view, beams).
//!
//! Acceleration is `obvhs`. The triangle test is our own scalar arithmetic, so that the depths by
//! which a scene is accepted are the same on every machine. Each mesh has its own tree, independent
//! of the scene.

use std::sync::Arc;

use obvhs::{
    BvhBuildParams,
    bvh2::reinsertion::ReinsertionOptimizer,
    cwbvh::{CwBvh, bvh2_to_cwbvh::bvh2_to_cwbvh},
    ploc::PlocBuilder,
    ray::{Ray, RayHit},
    triangle::Triangle,
};

use crate::{Affine, Mesh, Vec3};

/// A mesh with its ray tree and its bounding box.
#[derive(Debug)]
pub(crate) struct Model {
    /// The geometry.
    pub(crate) mesh: Arc<Mesh>,
    /// The smallest coordinates.
    pub(crate) lo: Vec3,
    /// The largest coordinates.
    pub(crate) hi: Vec3,
    /// `None` for at most [`FEW`] triangles, which are all tested.
    tree: Option<CwBvh>,
}

/// The number of triangles up to which testing all of them takes less time than a tree.
const FEW: usize = 12;

/// The intersection of a ray with a scene.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Hit {
    /// The ray parameter in units of the direction's length.
    pub(crate) t: f32,
    /// The index of the placed object.
    pub(crate) object: usize,
    /// The index of the triangle in its mesh.
    pub(crate) triangle: u32,
}

/// The tolerance of barycentric coordinates, which closes the seams between neighbouring triangles.
const SEAM: f32 = 1e-6;

/// Computes the intersection by Möller and Trumbore (1997), for both sides. Returns `None` for a
/// miss or a degenerate triangle.
pub(crate) fn intersect([a, b, c]: [Vec3; 3], origin: Vec3, direction: Vec3) -> Option<f32> {
    let (e1, e2) = (b - a, c - a);
    let p = direction.cross(e2);
    let det = e1.dot(p);
    if det == 0.0 {
        return None;
    }
    let s = origin - a;
    let u = s.dot(p) / det;
    let q = s.cross(e1);
    let v = direction.dot(q) / det;
    let inside = u >= -SEAM && v >= -SEAM && u + v <= 1.0 + SEAM;
    let t = e2.dot(q) / det;
    (inside && t.is_finite()).then_some(t)
}

/// The depth of a tree up to which obvhs searches it.
const DEEPEST: usize = 31;

/// Builds a tree as obvhs's own `build_cwbvh_from_tris`, which does not check the depth. Returns
/// `None` for a tree that is too deep.
fn built(triangles: &[Triangle]) -> Option<CwBvh> {
    let params = BvhBuildParams::fast_build();
    let mut binary = PlocBuilder::with_capacity(triangles.len()).build(
        params.ploc_search_distance,
        triangles,
        (0..triangles.len() as u32).collect(),
        params.sort_precision,
        params.search_depth_threshold,
    );
    ReinsertionOptimizer::default().run(&mut binary, params.reinsertion_batch_ratio, None);
    let tree = bvh2_to_cwbvh(&binary, params.max_prims_per_leaf.clamp(1, 3), true, false);
    let mut open = vec![(0, 0)];
    while let Some((node, depth)) = open.pop() {
        if depth > DEEPEST {
            return None;
        }
        let node = tree.nodes.get(node)?;
        let inner = (0..8).filter(|child| !node.is_child_empty(*child) && !node.is_leaf(*child));
        open.extend(inner.map(|child| (node.child_node_index(child) as usize, depth + 1)));
    }
    Some(tree)
}

impl Model {
    /// The greatest coordinate of a vertex, metres. The areas of obvhs's boxes overflow far beyond
    /// it, which makes obvhs panic.
    pub(crate) const FARTHEST_M: f32 = 1e6;

    /// Builds the tree. Returns `None` for a mesh without triangles, with a vertex beyond
    /// [`Self::FARTHEST_M`], or with so many triangles in the same place that no tree divides them.
    pub(crate) fn new(mesh: Mesh) -> Option<Self> {
        let near = |p: &Vec3| {
            <[f32; 3]>::from(*p)
                .iter()
                .all(|x| x.abs() <= Self::FARTHEST_M)
        };
        if mesh.triangles.is_empty() || !mesh.positions.iter().all(near) {
            return None;
        }
        let (lo, hi) = mesh.bounds()?;
        let corner = |v: u32| <[f32; 3]>::from(mesh.positions[v as usize]).into();
        let tree = match mesh.triangles.len() {
            0..=FEW => None,
            _ => {
                let triangle = |&[a, b, c]: &[u32; 3]| Triangle {
                    v0: corner(a),
                    v1: corner(b),
                    v2: corner(c),
                };
                let triangles: Vec<Triangle> = mesh.triangles.iter().map(triangle).collect();
                Some(built(&triangles)?)
            }
        };
        Some(Self {
            mesh: Arc::new(mesh),
            lo,
            hi,
            tree,
        })
    }

    /// Returns the extents along x, y and z.
    pub(crate) fn size(&self) -> [f32; 3] {
        (self.hi - self.lo).into()
    }

    /// Returns the closest hit with t in (0, `limit`) in the mesh's own frame: (t, triangle).
    pub(crate) fn closest(&self, origin: Vec3, direction: Vec3, limit: f32) -> Option<(f32, u32)> {
        self.closest_of(origin, direction, limit, |_| true)
    }

    /// Like [`Self::closest`], but considers only triangles for which `counts` is true.
    fn closest_of(
        &self,
        origin: Vec3,
        direction: Vec3,
        limit: f32,
        counts: impl Fn(usize) -> bool,
    ) -> Option<(f32, u32)> {
        // obvhs's 8-wide nodes lose rays with a component of −0.0; adding 0.0 makes it +0.0.
        let direction = direction + Vec3::ZERO;
        let test = |k: usize| {
            let [a, b, c] = self.mesh.triangles[k];
            let at = |v: u32| self.mesh.positions[v as usize];
            match intersect([at(a), at(b), at(c)], origin, direction) {
                Some(t) if t > 0.0 && counts(k) => t,
                _ => f32::INFINITY,
            }
        };
        let Some(tree) = &self.tree else {
            let (mut nearest, mut found) = (limit, None);
            for k in 0..self.mesh.triangles.len() {
                let t = test(k);
                if t < nearest {
                    (nearest, found) = (t, Some((t, k as u32)));
                }
            }
            return found;
        };
        let (o, d): ([f32; 3], [f32; 3]) = (origin.into(), direction.into());
        let mut hit = RayHit::none();
        let found = tree.ray_traverse(
            Ray::new(o.into(), d.into(), 0.0, limit),
            &mut hit,
            |_, id| test(tree.primitive_indices[id] as usize),
        );
        found.then(|| (hit.t, tree.primitive_indices[hit.primitive_id as usize]))
    }
}

/// Placed models, ready for rays. Every placement must be rigid.
#[derive(Debug, Default)]
pub(crate) struct World {
    placed: Vec<Placed>,
}

#[derive(Debug)]
struct Placed {
    model: Arc<Model>,
    to_world: Affine,
    lo: Vec3,
    hi: Vec3,
}

/// The margin by which boxes are enlarged, so that flat meshes have a volume (metres).
const PAD: f32 = 1e-4;

impl World {
    /// Adds a model. Its index is the number of models added earlier.
    pub(crate) fn add(&mut self, model: Arc<Model>, to_world: Affine) {
        let (mut lo, mut hi) = (Vec3::splat(f32::INFINITY), Vec3::splat(f32::NEG_INFINITY));
        for i in 0..8 {
            let side = |k: usize| {
                if i >> k & 1 == 1 {
                    model.hi[k]
                } else {
                    model.lo[k]
                }
            };
            let p = to_world.point(Vec3::new(side(0), side(1), side(2)));
            (lo, hi) = (lo.min(p), hi.max(p));
        }
        self.placed.push(Placed {
            model,
            to_world,
            lo: lo - Vec3::splat(PAD),
            hi: hi + Vec3::splat(PAD),
        });
    }

    /// Returns the smallest and largest coordinates of the models from index `first` on, with a
    /// small margin.
    pub(crate) fn boxes(&self, first: usize) -> impl Iterator<Item = [Vec3; 2]> {
        self.placed[first..]
            .iter()
            .map(|placed| [placed.lo, placed.hi])
    }

    /// Returns the closest hit with t > 0 over all placed models, ignoring thin glass. In a tie,
    /// the model added first wins.
    pub(crate) fn closest(&self, origin: Vec3, direction: Vec3) -> Option<Hit> {
        let inverse = Vec3::new(1.0 / direction.x, 1.0 / direction.y, 1.0 / direction.z);
        let mut best: Option<Hit> = None;
        for (object, placed) in self.placed.iter().enumerate() {
            let limit = best.map_or(f32::MAX, |h| h.t);
            if !placed.box_before(origin, inverse, limit) {
                continue;
            }
            // The inverse of a rigid placement is its transpose.
            let [r0, r1, r2] = placed.to_world.linear;
            let back = |d: Vec3| r0 * d.x + r1 * d.y + r2 * d.z;
            let local = back(origin - placed.to_world.translation);
            let mesh = &placed.model.mesh;
            let opaque = |k: usize| !mesh.materials[mesh.triangle_material[k] as usize].is_glass();
            let hit = placed
                .model
                .closest_of(local, back(direction), limit, opaque);
            if let Some((t, triangle)) = hit
                && t < limit
            {
                best = Some(Hit {
                    t,
                    object,
                    triangle,
                });
            }
        }
        best
    }

    /// Returns the world-space unit normal of the hit facet, turned against `direction`.
    pub(crate) fn normal(&self, hit: Hit, direction: Vec3) -> Vec3 {
        let n = self.facing(hit);
        if n.dot(direction) > 0.0 { -n } else { n }
    }

    /// Returns the world-space unit normal of the hit facet, by the order of its corners.
    pub(crate) fn facing(&self, hit: Hit) -> Vec3 {
        let placed = &self.placed[hit.object];
        let mesh = &placed.model.mesh;
        let [a, b, c] = mesh.triangles[hit.triangle as usize].map(|v| mesh.positions[v as usize]);
        placed.to_world.direction((b - a).cross(c - a)).normalized()
    }
}

impl Placed {
    fn box_before(&self, origin: Vec3, inverse: Vec3, limit: f32) -> bool {
        let (mut near, mut far) = (0.0f32, limit);
        for k in 0..3 {
            let a = (self.lo[k] - origin[k]) * inverse[k];
            let b = (self.hi[k] - origin[k]) * inverse[k];
            // min and max drop the NaN of 0·∞ (a ray inside a slab and parallel to it).
            near = near.max(a.min(b));
            far = far.min(a.max(b));
        }
        near <= far
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Material, shape::Shape};

    #[test]
    fn rays_find_the_nearest_of_placed_and_turned_boxes() {
        let mut shape = Shape::new("box");
        let m = shape.material(Material::diffuse("grey", [0.5; 3]));
        shape.cuboid([-0.5, 0.0, -0.5], [0.5, 1.0, 0.5], m);
        let model = Arc::new(Model::new(shape.finish()).expect("a box has triangles"));
        let mut world = World::default();
        world.add(
            model.clone(),
            Affine::yaw_then_move(0.0, Vec3::new(0.0, 0.0, 5.0)),
        );
        let quarter = std::f32::consts::FRAC_PI_4;
        world.add(
            model,
            Affine::yaw_then_move(quarter, Vec3::new(0.0, 0.0, 3.0)),
        );
        let ahead = Vec3::new(0.0, 0.0, 2.0);
        let hit = world
            .closest(Vec3::new(0.01, 0.5, 0.0), ahead)
            .expect("two boxes stand in the way");
        assert_eq!(hit.object, 1);
        assert!(
            (hit.t * 2.0 - (3.0 - 0.5f32.sqrt())).abs() < 0.02,
            "{hit:?}"
        );
        assert!(world.normal(hit, ahead).z < 0.0);
        assert!(world.closest(Vec3::new(0.0, 1.5, 0.0), ahead).is_none());
    }

    #[test]
    fn a_direction_with_negative_zeros_hits_like_any_other() {
        let mut shape = Shape::new("table");
        let m = shape.material(Material::diffuse("grey", [0.5; 3]));
        for k in 0..8 {
            let x = k as f32 * 0.2;
            shape.cuboid([x, 0.0, 0.0], [x + 0.1, 1.0, 0.1], m);
        }
        let model = Model::new(shape.finish()).expect("boxes have triangles");
        for zero in [0.0, -0.0] {
            let down = Vec3::new(zero, -1.0, zero);
            let hit = model.closest(Vec3::new(0.63, 1.5, 0.04), down, f32::MAX);
            assert_eq!(hit.map(|(t, _)| t), Some(0.5));
        }
    }

    #[test]
    fn meshes_of_any_triangles_are_searched_or_refused() {
        use proptest::prelude::*;
        let number = prop_oneof![
            Just(0.0f32),
            Just(-0.0f32),
            Just(1.0f32),
            Just(f32::MAX),
            Just(f32::MIN_POSITIVE),
            -1.0f32..1.0,
            any::<f32>().prop_filter("finite", |x| x.is_finite()),
        ];
        let point = [number.clone(), number.clone(), number];
        let points = proptest::collection::vec(point, 1..6);
        let corners = proptest::collection::vec((0..6usize, 0..6usize, 0..6usize), 1..300);
        let mut runner = proptest::test_runner::TestRunner::new(ProptestConfig {
            failure_persistence: None,
            cases: 500,
            ..ProptestConfig::default()
        });
        let outcome = runner.run(&(points, corners), |(points, corners)| {
            let count = points.len();
            let mesh = Mesh {
                positions: points.into_iter().map(Vec3::from).collect(),
                triangles: corners
                    .iter()
                    .map(|&(a, b, c)| [a, b, c].map(|v| (v % count) as u32))
                    .collect(),
                triangle_material: vec![0; corners.len()],
                materials: vec![Material::diffuse("grey", [0.5; 3])],
                ..Mesh::default()
            };
            if let Some(model) = Model::new(mesh) {
                for direction in [[0.0, 0.0, 1.0], [1.0, 0.5, -0.25]] {
                    let origin = Vec3::new(0.1, 0.2, -3.0);
                    let hit = model.closest(origin, Vec3::from(direction), f32::MAX);
                    prop_assert!(hit.is_none_or(|(t, _)| t.is_finite()));
                }
            }
            Ok(())
        });
        if let Err(e) = outcome {
            panic!("{e}");
        }
    }
}
