//! The scene's Lambertian surfaces, cut and gathered into patches of similar size, each with its
//! path to every spot. Narrow gates are tested against whole patches.

use picofarm_scene::Vec3;

use crate::{light::emitters::Emitters, scene::world::World};

/// Target number of patches; a scene of many small separate parts has more.
const COUNT: f32 = 3000.0;

/// Largest number of successive halvings of a triangle.
const HALVINGS: u32 = 24;

/// Number of pieces from which triangles stay whole, because long needles would produce millions.
/// Larger pieces only make sampling less efficient.
const MOST: usize = 1 << 17;

/// Cosine above which triangles of a patch count as coplanar.
const FLAT: f32 = 0.98;

/// Marks a link to a piece or patch instead of a halving.
const LEAF: u32 = 1 << 31;
const NONE: u32 = u32::MAX;

/// Splits a triangle from the middle of edge `edge` (between its vertices `edge` and `edge` + 1) to
/// the opposite vertex.
#[derive(Debug, Clone, Copy)]
struct Halving {
    edge: u8,
    /// The half with vertex `edge`, and the other.
    halves: [u32; 2],
}

/// A part of a triangle.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Piece {
    pub triangle: u32,
    pub corners: [Vec3; 3],
    /// Sum of areas of the patch's pieces up to and including this one.
    pub upto: f32,
}

/// Neighbouring pieces, in columns by patch.
#[derive(Debug, Default)]
pub(crate) struct Patches {
    /// Link of every triangle.
    of_triangle: Vec<u32>,
    halvings: Vec<Halving>,
    pub(crate) pieces: Vec<Piece>,
    /// Index of each patch's first piece; its pieces end at the next patch's first.
    pub(crate) first: Vec<u32>,
    pub(crate) centre: [Vec<f32>; 3],
    /// The normal of a flat patch, otherwise zero.
    pub(crate) normal: [Vec<f32>; 3],
    /// Whether the patch scatters from its front only.
    pub(crate) one_sided: Vec<bool>,
    /// Half the diagonal of its box, render units.
    pub(crate) radius: Vec<f32>,
    pub(crate) area: Vec<f32>,
    /// `[spot][patch]`: optical path from the laser, render units.
    pub(crate) path: Vec<f32>,
    /// `[spot][patch]`: approximate flux there per unit power, negative on the back of a flat
    /// patch.
    pub(crate) flux: Vec<f32>,
}

impl Patches {
    /// Cuts a scene's surfaces. Surfaces without a Lambertian part are left out.
    pub fn new(world: &World, emitters: &Emitters) -> Self {
        let mut all = Self::default();
        let areas: Vec<f32> = (0..world.triangles.len())
            .map(|t| {
                let surface = &world.surfaces[world.surface[t] as usize];
                let scatters = !surface.is_black() && (surface.diffuse() || surface.is_open());
                let area = area(&world.triangles[t]);
                let lit = world.normals[t] != Vec3::ZERO && world.counts(t);
                let counts = scatters && lit && area > 0.0;
                if counts { area } else { 0.0 }
            })
            .collect();
        let total: f64 = areas.iter().map(|&a| f64::from(a)).sum();
        let size = (total as f32 / COUNT).sqrt() * 1.5;
        let mut cut = vec![];
        for (t, &area) in areas.iter().enumerate() {
            let link = if area > 0.0 {
                all.halve(t as u32, world.triangles[t], size, HALVINGS, &mut cut)
            } else {
                NONE
            };
            all.of_triangle.push(link);
        }
        let mut order: Vec<u32> = (0..cut.len() as u32).collect();
        let mut patch_of = vec![0; cut.len()];
        all.gather(world, &cut, &mut order, size, &mut patch_of);
        all.first.push(all.pieces.len() as u32);
        let links = all.of_triangle.iter_mut();
        let halves = all.halvings.iter_mut().flat_map(|h| h.halves.iter_mut());
        for link in links.chain(halves) {
            if *link != NONE && *link & LEAF != 0 {
                *link = LEAF | patch_of[(*link & !LEAF) as usize];
            }
        }
        all.measure(world, emitters);
        all
    }

    /// Returns the number of patches.
    pub fn len(&self) -> usize {
        self.area.len()
    }

    /// Halves a triangle until its edges are no longer than `size`. Returns the link to it.
    fn halve(
        &mut self,
        triangle: u32,
        corners: [Vec3; 3],
        size: f32,
        left: u32,
        cut: &mut Vec<Piece>,
    ) -> u32 {
        let length = |k: usize| (corners[(k + 1) % 3] - corners[k]).length();
        let edge = (1..3).fold(0, |a, k| if length(k) > length(a) { k } else { a });
        let next = (edge + 1) % 3;
        if length(edge) <= size || left == 0 || cut.len() >= MOST {
            cut.push(Piece {
                triangle,
                corners,
                upto: area(&corners),
            });
            return LEAF | (cut.len() as u32 - 1);
        }
        let at = self.halvings.len();
        self.halvings.push(Halving {
            edge: edge as u8,
            halves: [NONE; 2],
        });
        let middle = (corners[edge] + corners[next]) * 0.5;
        for (half, moved) in [next, edge].into_iter().enumerate() {
            let mut corners = corners;
            corners[moved] = middle;
            let link = self.halve(triangle, corners, size, left - 1, cut);
            self.halvings[at].halves[half] = link;
        }
        at as u32
    }

    /// Makes a patch of the pieces in `order` if they are close together, otherwise recurses into
    /// both halves.
    fn gather(
        &mut self,
        world: &World,
        cut: &[Piece],
        order: &mut [u32],
        size: f32,
        patch_of: &mut [u32],
    ) {
        if order.is_empty() {
            return;
        }
        let (mut low, mut high) = (Vec3::from([f32::MAX; 3]), Vec3::from([f32::MIN; 3]));
        for p in order.iter().flat_map(|&k| cut[k as usize].corners) {
            (low, high) = (low.min(p), high.max(p));
        }
        let box_ = high - low;
        let axis = (1..3).fold(0, |a, k| if box_[k] > box_[a] { k } else { a });
        if box_[axis] > size && order.len() > 1 {
            let middle = |k: u32| cut[k as usize].corners.iter().map(|p| p[axis]).sum::<f32>();
            order.sort_by(|&a, &b| middle(a).total_cmp(&middle(b)).then(a.cmp(&b)));
            let (a, b) = order.split_at_mut(order.len() / 2);
            self.gather(world, cut, a, size, patch_of);
            self.gather(world, cut, b, size, patch_of);
            return;
        }
        let front = world.normals[cut[order[0] as usize].triangle as usize];
        let (mut flat, mut one_sided, mut area) = (true, true, 0.0f32);
        self.first.push(self.pieces.len() as u32);
        let patch = self.area.len() as u32;
        for &k in order.iter() {
            let piece = &cut[k as usize];
            let t = piece.triangle as usize;
            let cos = world.normals[t].dot(front);
            flat &= cos.abs() > FLAT;
            one_sided &= cos > FLAT && !world.surfaces[world.surface[t] as usize].two_sided();
            area += piece.upto;
            patch_of[k as usize] = patch;
            self.pieces.push(Piece {
                upto: area,
                ..*piece
            });
        }
        let centre = (low + high) * 0.5;
        let normal = if flat { front } else { Vec3::ZERO };
        for k in 0..3 {
            self.centre[k].push(centre[k]);
            self.normal[k].push(normal[k]);
        }
        self.one_sided.push(one_sided);
        self.radius.push(0.5 * box_.length());
        self.area.push(area);
    }

    /// Computes the path and the flux from every spot to every patch.
    fn measure(&mut self, world: &World, emitters: &Emitters) {
        for e in &emitters.list {
            let start = (e.path_m * f64::from(world.scale)) as f32;
            let lit = !e.surface.is_black() && e.n.dot(e.back) > 0.0;
            for k in 0..self.len() {
                let to = self.centre(k) - e.p;
                let d = to.length();
                let r = self.radius[k];
                let out = if e.surface.diffuse() {
                    // Parts of the patch may be lit even if its centre is not.
                    ((e.n.dot(to) + r) / (d + r)).clamp(0.0, 1.0)
                } else {
                    0.5
                };
                let normal = self.normal(k);
                let cos = if normal == Vec3::ZERO {
                    0.5
                } else {
                    -normal.dot(to) / d.max(1e-6)
                };
                let out = if lit { out } else { 0.0 };
                self.path.push(start + d);
                self.flux.push(out * cos / (d * d + r * r));
            }
        }
    }

    pub(crate) fn centre(&self, patch: usize) -> Vec3 {
        let [x, y, z] = &self.centre;
        Vec3::new(x[patch], y[patch], z[patch])
    }

    pub(crate) fn normal(&self, patch: usize) -> Vec3 {
        let [x, y, z] = &self.normal;
        Vec3::new(x[patch], y[patch], z[patch])
    }

    /// Returns the patch at the point of a triangle with these barycentric coordinates; `None` if
    /// the triangle is in no patch.
    #[inline]
    pub(crate) fn at(&self, triangle: u32, mut coordinates: [f32; 3]) -> Option<usize> {
        let mut link = self.of_triangle[triangle as usize];
        while link & LEAF == 0 {
            let h = &self.halvings[link as usize];
            let (i, j) = (usize::from(h.edge), (usize::from(h.edge) + 1) % 3);
            let (a, b) = (coordinates[i], coordinates[j]);
            // With m between i and j: a·i + b·j = (a − b)·i + 2b·m = 2a·m + (b − a)·j.
            if a >= b {
                (coordinates[i], coordinates[j]) = (a - b, 2.0 * b);
                link = h.halves[0];
            } else {
                (coordinates[i], coordinates[j]) = (2.0 * a, b - a);
                link = h.halves[1];
            }
        }
        (link != NONE).then_some((link & !LEAF) as usize)
    }
}

fn area(t: &[Vec3; 3]) -> f32 {
    (t[1] - t[0]).cross(t[2] - t[0]).length() * 0.5
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bare(triangles: &[[Vec3; 3]], size: f32) -> (Patches, Vec<Piece>) {
        let (mut all, mut cut) = (Patches::default(), vec![]);
        for (t, &corners) in triangles.iter().enumerate() {
            let link = all.halve(t as u32, corners, size, HALVINGS, &mut cut);
            all.of_triangle.push(link);
        }
        (all, cut)
    }

    #[test]
    fn every_point_of_a_halved_triangle_is_found_in_its_piece() {
        let corner = |x, y, z| Vec3::new(x, y, z);
        let (a, b, c) = (
            corner(0.0, 0.0, 0.0),
            corner(4.0, 0.1, 0.0),
            corner(0.3, 0.4, 1.0),
        );
        let (all, cut) = bare(&[[a, b, c]], 0.5);
        assert!(cut.len() > 8, "{}", cut.len());
        let whole: f32 = cut.iter().map(|p| area(&p.corners)).sum();
        assert!((whole / area(&[a, b, c]) - 1.0).abs() < 1e-5);
        let n = (b - a).cross(c - a);
        for (k, piece) in cut.iter().enumerate() {
            let [p, q, r] = piece.corners;
            for (u, v) in [(0.3, 0.3), (0.8, 0.1), (0.1, 0.8), (0.05, 0.05)] {
                let at = p * u + q * v + r * (1.0 - u - v);
                let part = |s: Vec3, t: Vec3| n.dot((s - at).cross(t - at)) / n.dot(n);
                let found = all.at(0, [part(b, c), part(c, a), part(a, b)]);
                assert_eq!(found, Some(k));
            }
        }
    }

    #[test]
    fn triangles_left_out_are_in_no_patch() {
        let all = Patches {
            of_triangle: vec![NONE],
            ..Patches::default()
        };
        assert_eq!(all.at(0, [0.2, 0.3, 0.5]), None);
    }
}
