//! Finds all triangles on a segment, for glass. This is scalar code, because few rays need it.

use picofarm_scene::Vec3;

use crate::scene::bvh::{
    nodes::{LEAF, packs},
    traverse::{inverse, largest},
    tree::{Bvh, Stack, usable},
};

impl Bvh {
    /// Writes every triangle that `origin + t · direction` hits with 0 < t ≤ `limit` as (t, index),
    /// nearest first and at equal t the lowest index first. Writes none for rays that are not
    /// finite. The arithmetic is the same as for the nearest hit.
    pub(crate) fn all(
        &self,
        stack: &mut Stack,
        (origin, direction, limit): (Vec3, Vec3, f32),
        out: &mut Vec<(f32, u32)>,
    ) {
        out.clear();
        stack.rays += 1;
        if !usable(origin, direction, limit) || self.nodes.is_empty() {
            return;
        }
        let (o, d) = (origin, direction);
        let slope = [inverse(d.x), inverse(d.y), inverse(d.z)];
        let near = [d.x, d.y, d.z].map(|x| usize::from(x.is_sign_negative()));
        let slack = 1.0 + 4.0 * f32::EPSILON;
        let kz = largest(d);
        let (mut kx, mut ky) = ((kz + 1) % 3, (kz + 2) % 3);
        if d[kz] < 0.0 {
            std::mem::swap(&mut kx, &mut ky);
        }
        let shear = [d[kx] / d[kz], d[ky] / d[kz], 1.0 / d[kz]];
        self.deepen(stack);
        stack.entries[0].0 = 0;
        let mut depth = 1;
        while depth > 0 {
            depth -= 1;
            let current = stack.entries[depth].0;
            if current & LEAF == 0 {
                let node = &self.nodes[current as usize];
                for (lane, &child) in node.child.iter().enumerate() {
                    let plane = |far: usize, a: usize| {
                        (node.bounds[a + 3 * (near[a] ^ far)][lane] - o[a]) * slope[a]
                    };
                    let first = plane(0, 0).max(plane(0, 1)).max(plane(0, 2).max(0.0));
                    let last = plane(1, 0).min(plane(1, 1)).min(plane(1, 2)) * slack;
                    if first <= last.min(limit) {
                        stack.entries[depth].0 = child;
                        depth += 1;
                    }
                }
                continue;
            }
            for pack in &self.packs[packs(current)] {
                for lane in 0..8 {
                    let at = |v: usize, k: usize| pack.vertex[3 * v + k][lane] - o[k];
                    let corner = |v: usize| {
                        let z = at(v, kz);
                        [at(v, kx) - shear[0] * z, at(v, ky) - shear[1] * z, z]
                    };
                    let [a, b, c] = [corner(0), corner(1), corner(2)];
                    let u = c[0] * b[1] - c[1] * b[0];
                    let v = a[0] * c[1] - a[1] * c[0];
                    let w = b[0] * a[1] - b[1] * a[0];
                    // Lanes without a triangle are NaN, so they are never inside.
                    let inside = u.min(v).min(w) >= 0.0 || u.max(v).max(w) <= 0.0;
                    let det = u + v + w;
                    let t = match inside && pack.is_needle(lane) {
                        true => pack.exactly(lane, o, d),
                        false => shear[2] * (u * a[2] + v * b[2] + w * c[2]) / det,
                    };
                    if inside && det != 0.0 && t > 0.0 && t <= limit {
                        out.push((t, pack.triangle(lane)));
                    }
                }
            }
        }
        out.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
    }
}
