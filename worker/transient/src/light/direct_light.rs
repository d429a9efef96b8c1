//! Light vertices that spots light directly.

use crate::{
    light::{
        contacts::Contacts,
        emitters::Emitters,
        light_vertices::{LightVertex, LightVertices, share},
    },
    numeric::rng::Rng,
    scene::{bvh::tree::Stack, intersection::lift, world::World},
};

impl LightVertices {
    /// Redraws `count` vertices, spread evenly over the spots. Vertices on mirrors are left out,
    /// because a camera vertex is almost never within their lobe (aimed paths reach them); so are
    /// those in a spot's own zone.
    pub fn fill(
        &mut self,
        (world, emitters, contacts): (&World, &Emitters, Option<&Contacts>),
        count: u32,
        rng: &mut Rng,
        stack: &mut Stack,
    ) {
        self.clear();
        let spots = emitters.list.len();
        if spots == 0 {
            return;
        }
        let chance = 1.0 / spots as f32;
        let shift = rng.uniform();
        for l in 0..count {
            // Strata over the spots, rotated.
            let at = (l as f32 + rng.uniform()) / count as f32 + shift;
            let spot = (((at - at.floor()) * spots as f32) as usize).min(spots - 1);
            let e = &emitters.list[spot];
            let Some((w, weight, pdf)) = e.surface.sample(e.n, e.back, rng) else {
                continue;
            };
            let Some(mut hit) = world.closest(stack, lift(e.p, e.n), w) else {
                continue;
            };
            if contacts.is_some_and(|c| c.own(world, spot, &hit)) {
                continue;
            }
            hit.choose_lobe(rng);
            if weight == 0.0 || hit.surface.specular() || hit.surface.is_black() {
                continue;
            }
            let leg = hit.p - e.p;
            let d2 = leg.dot(leg);
            let flux = weight * hit.through / (chance * count as f32);
            self.push(LightVertex {
                hit,
                back: -w,
                flux,
                density: share(emitters, pdf) * hit.n.dot(w).abs() / d2,
                path_m: e.path_m + world.metres(d2.sqrt()),
                spot,
                bounces: 2,
                alpha: 0.0,
            });
        }
    }
}
