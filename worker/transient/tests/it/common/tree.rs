//! Triangles in f64 and a tree over them, for the independent tracers. It shares no code with the
//! renderer.

use picofarm_scene::{Bsdf, Scene};

use super::{brute::P, glass};

/// The maximum number of triangles in a leaf.
const LEAF: usize = 4;

/// One triangle: corners, unit normal, scattering of its front and of its back.
#[derive(Clone, Copy)]
struct Triangle {
    corners: [P; 3],
    normal: P,
    sides: [Bsdf; 2],
}

/// Bounds, and either the index of the second child (the first follows its parent) or a range of
/// triangles.
struct Node {
    low: [f64; 3],
    high: [f64; 3],
    second: usize,
    range: std::ops::Range<usize>,
}

/// A surface point: position, unit normal on the side that was hit, its scattering, distance,
/// whether that side is the triangle's front, and the triangle's index.
#[derive(Debug, Clone, Copy)]
pub struct Vertex {
    pub p: P,
    pub n: P,
    pub bsdf: Bsdf,
    pub t: f64,
    pub front: bool,
    pub triangle: usize,
}

/// A binary tree of boxes, split at the median, and a separate list of glass panes.
pub struct Tree {
    nodes: Vec<Node>,
    triangles: Vec<Triangle>,
    panes: Vec<Triangle>,
}

/// The index that stands for no triangle.
pub const NONE: usize = usize::MAX;

impl Tree {
    pub fn new(scene: &Scene) -> Self {
        let (mut triangles, mut panes) = (vec![], vec![]);
        for o in &scene.objects {
            for (t, &m) in o.mesh.triangles.iter().zip(&o.mesh.triangle_material) {
                let corners = t.map(|i| P::from(o.to_world.point(o.mesh.positions[i as usize])));
                let n = (corners[1] - corners[0]).cross(corners[2] - corners[0]);
                let material = &o.mesh.materials[m as usize];
                assert!(
                    material.texture.is_none(),
                    "textures are not for this tracer"
                );
                let black = Bsdf::Diffuse { reflectance: 0.0 };
                let (list, both) = match material.bsdf {
                    Bsdf::ThinDielectric { .. } => (&mut panes, true),
                    Bsdf::Dielectric { .. } => (&mut triangles, true),
                    _ => (&mut triangles, material.two_sided),
                };
                if n.length() > 0.0 {
                    list.push(Triangle {
                        corners,
                        normal: n.unit(),
                        sides: match both {
                            true => [material.bsdf; 2],
                            false => [material.bsdf, black],
                        },
                    });
                }
            }
        }
        let mut nodes = vec![];
        let count = triangles.len();
        build(&mut nodes, &mut triangles, 0..count);
        Self {
            nodes,
            triangles,
            panes,
        }
    }

    /// Returns the fraction of light that the glass between two points transmits.
    pub fn through(&self, a: P, b: P) -> f64 {
        let way = b - a;
        let d = way.unit();
        let across = |pane: &&Triangle| pane.distance(a, d, way.length()).is_some();
        self.panes.iter().filter(across).fold(1.0, |all, pane| {
            let cos = pane.normal.dot(d);
            all * glass::pane(pane.sides[0], cos.abs(), cos <= 0.0).passes
        })
    }

    /// Returns the first pane of thin glass along a unit direction, nearer than `limit` and other
    /// than `left`.
    pub fn pane(&self, o: P, d: P, limit: f64, left: usize) -> Option<Vertex> {
        let (mut nearest, mut best) = (limit, None);
        for (k, pane) in self.panes.iter().enumerate() {
            let k = self.triangles.len() + k;
            if k == left {
                continue;
            }
            if let Some(t) = pane.distance(o, d, nearest) {
                (nearest, best) = (t, Some((k, pane)));
            }
        }
        best.map(|(k, pane)| pane.vertex(k, (o, d), nearest))
    }

    /// Returns the first surface along a unit direction, beyond 1e-11 and nearer than `limit`.
    pub fn hit(&self, o: P, d: P, limit: f64) -> Option<Vertex> {
        self.hit_but(o, d, limit, NONE)
    }

    /// Like `hit`, among the triangles other than `left`, the one that the ray leaves.
    pub fn hit_but(&self, o: P, d: P, limit: f64, left: usize) -> Option<Vertex> {
        let (origin, inverse) = ([o.0, o.1, o.2], [1.0 / d.0, 1.0 / d.1, 1.0 / d.2]);
        let (mut nearest, mut best) = (limit, None);
        let mut stack = [0usize; 64];
        let mut depth = 1;
        while depth > 0 {
            depth -= 1;
            let at = stack[depth];
            let node = &self.nodes[at];
            if !node.crossed(origin, inverse, nearest) {
                continue;
            }
            if node.second > 0 {
                stack[depth] = node.second;
                stack[depth + 1] = at + 1;
                depth += 2;
                continue;
            }
            for k in node.range.clone() {
                if k == left {
                    continue;
                }
                if let Some(t) = self.triangles[k].distance(o, d, nearest) {
                    (nearest, best) = (t, Some(k));
                }
            }
        }
        best.map(|k| self.triangles[k].vertex(k, (o, d), nearest))
    }

    /// Returns true if nothing occludes the segment between two points.
    pub fn free(&self, a: P, b: P) -> bool {
        let d = (b - a).length();
        self.hit(a, (b - a) * (1.0 / d), d * (1.0 - 1e-9)).is_none()
    }
}

impl Triangle {
    /// Returns the point at a distance along a ray, on this triangle, which has index `k`.
    fn vertex(&self, k: usize, (o, d): (P, P), t: f64) -> Vertex {
        let front = self.normal.dot(d) <= 0.0;
        Vertex {
            p: o + d * t,
            n: self.normal * if front { 1.0 } else { -1.0 },
            bsdf: self.sides[usize::from(!front)],
            t,
            front,
            triangle: k,
        }
    }

    /// Möller and Trumbore 1997; edges belong to both of their triangles.
    fn distance(&self, o: P, d: P, nearest: f64) -> Option<f64> {
        let v = &self.corners;
        let (e, f) = (v[1] - v[0], v[2] - v[0]);
        let h = d.cross(f);
        let det = e.dot(h);
        if det.abs() < 1e-30 {
            return None;
        }
        let s = o - v[0];
        let (u, q) = (s.dot(h) / det, s.cross(e));
        let (w, t) = (d.dot(q) / det, f.dot(q) / det);
        let inside = u >= -1e-12 && w >= -1e-12 && u + w <= 1.0 + 1e-12;
        (inside && t > 1e-11 && t < nearest).then_some(t)
    }
}

impl Node {
    fn crossed(&self, origin: [f64; 3], inverse: [f64; 3], nearest: f64) -> bool {
        let (mut enter, mut leave) = (0.0f64, nearest);
        for k in 0..3 {
            let a = (self.low[k] - origin[k]) * inverse[k];
            let b = (self.high[k] - origin[k]) * inverse[k];
            // A ray in the plane of a side gives NaN here, which `max` and `min` ignore.
            enter = enter.max(a.min(b));
            leave = leave.min(a.max(b));
        }
        enter <= leave * (1.0 + 1e-12) + 1e-12
    }
}

fn axes(p: P) -> [f64; 3] {
    [p.0, p.1, p.2]
}

fn build(nodes: &mut Vec<Node>, triangles: &mut [Triangle], range: std::ops::Range<usize>) {
    let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    for p in triangles[range.clone()].iter().flat_map(|t| t.corners) {
        for (k, x) in axes(p).into_iter().enumerate() {
            low[k] = low[k].min(x);
            high[k] = high[k].max(x);
        }
    }
    let at = nodes.len();
    nodes.push(Node {
        low,
        high,
        second: 0,
        range: range.clone(),
    });
    if range.len() <= LEAF {
        return;
    }
    let widest = (0..3).max_by(|&a, &b| (high[a] - low[a]).total_cmp(&(high[b] - low[b])));
    let axis = widest.expect("three axes");
    let middle = |t: &Triangle| t.corners.iter().map(|&p| axes(p)[axis]).sum::<f64>();
    let half = range.len() / 2;
    triangles[range.clone()].select_nth_unstable_by(half, |a, b| middle(a).total_cmp(&middle(b)));
    build(nodes, triangles, range.start..range.start + half);
    nodes[at].second = nodes.len();
    build(nodes, triangles, range.start + half..range.end);
}
