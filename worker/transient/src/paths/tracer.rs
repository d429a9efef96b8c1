//! The scene and the techniques in which paths are traced.

use picofarm_scene::Vec3;

use crate::{
    api::Gate,
    light::{
        caustics::Caustics, contacts::Contacts, emitters::Emitters, light_context::Surroundings,
        mirror_images::Mirrors, reflectors::Reflectors,
    },
    paths::{
        ellipsoid::{patches::Patches, window::Window},
        vertex::Vertex,
    },
    scene::{hit::Hit, world::World},
};

/// The scene and the settings in which paths are traced.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Walk<'a> {
    pub world: &'a World,
    pub emitters: &'a Emitters,
    pub mirrors: &'a Mirrors,
    pub gate: &'a Gate,
    /// Longest path in bounces.
    pub max_bounces: u32,
    /// Whether walks connect to light vertices.
    pub lights: bool,
    /// Light paths via near-mirrors, if they pay off.
    pub caustics: Option<&'a Caustics>,
    /// Near-mirrors that gather points aim at, if aiming pays off.
    pub reflectors: Option<&'a Reflectors>,
    /// Zones around spots close to other surfaces, if there are any.
    pub contacts: Option<&'a Contacts>,
    /// Length of the shortest path from the laser to a spot, metres.
    pub shortest_m: f64,
    /// The path lengths that count with a narrow gate. Other contributions are discarded.
    pub window: Option<Window>,
    /// The patches on which shared vertices are drawn for a narrow gate.
    pub patches: Option<&'a Patches>,
}

/// Kinds of light vertices.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Lights {
    /// All vertices that spots light directly.
    All,
    /// Directly lit vertices on unshared conductors, for vertices that a tile's shared vertices
    /// serve as well.
    Glossy,
    /// Vertices beyond near-mirrors.
    Beyond,
    /// Vertices in the zones of spots close to other surfaces.
    Contact,
}

/// The maximum number of spots that a camera vertex is connected to. This number and those below
/// were chosen by error² × CPU time on the reference rooms, where the optimum is flat (2, 4 and 12
/// spots: 7.2, 5.7 and 6.0 on room-diffuse). More connections from one vertex also correlate
/// neighbouring bins of a pixel, so that errors of sums over bins exceed the estimate from the
/// bins' own errors.
pub(crate) const SPOTS: u32 = 4;

/// Connects to every spot.
pub(crate) const ALL: u32 = u32::MAX;

impl Walk<'_> {
    /// Returns the part of this walk's state that light paths are traced in.
    #[inline]
    pub fn surroundings(&self) -> Surroundings<'_> {
        Surroundings {
            world: self.world,
            emitters: self.emitters,
            mirrors: self.mirrors,
            gate: self.gate,
            max_bounces: self.max_bounces,
        }
    }

    /// Returns true if a path with one more vertex and a spot can still count.
    #[inline]
    pub fn goes_on(&self, v: &Vertex) -> bool {
        !v.hit.surface.is_black()
            && v.bounce + 2 <= self.max_bounces
            && v.length_m + self.shortest_m < self.gate.end_m()
            && self.in_time(v.hit.p, v.length_m)
    }

    /// Returns false if a narrow gate ends before the shortest path via `p`.
    #[inline]
    pub fn in_time(&self, p: Vec3, length_m: f64) -> bool {
        self.window
            .is_none_or(|w| length_m + self.emitters.shortest_m(self.world, p) < w.end_m)
    }

    /// Zeroes the weights of spots if their path via a surface point misses a narrow gate. Returns
    /// whether any weight is left.
    pub fn keep_in_window(&self, p: Vec3, length_m: f64, weights: &mut [f32]) -> bool {
        if self.window.is_none() {
            return true;
        }
        let mut any = false;
        for (spot, w) in weights.iter_mut().enumerate().filter(|(_, w)| **w > 0.0) {
            if self.in_window(p, length_m, spot) {
                any = true;
            } else {
                *w = 0.0;
            }
        }
        any
    }

    /// Returns whether a path from a spot with a weight via a surface point can count.
    pub fn any_in_window(&self, p: Vec3, length_m: f64, weights: &[f32]) -> bool {
        let mut lit = weights.iter().enumerate().filter(|(_, w)| **w > 0.0);
        self.window.is_none() || lit.any(|(spot, _)| self.in_window(p, length_m, spot))
    }

    #[inline]
    fn in_window(&self, p: Vec3, length_m: f64, spot: usize) -> bool {
        let e = &self.emitters.list[spot];
        let path = length_m + self.world.metres((e.p - p).length()) + e.path_m;
        self.window.is_none_or(|w| w.holds(path))
    }

    /// Returns whether a vertex lit by a spot belongs to the spot's zone.
    #[inline]
    pub fn is_own(&self, spot: usize, h: &Hit) -> bool {
        self.contacts.is_some_and(|c| c.own(self.world, spot, h))
    }

    /// Zeroes the weights of spots if the zones account for their light at `h`.
    #[inline]
    pub fn leave_to_zones(&self, h: &Hit, weights: &mut [f32]) {
        if let Some(contacts) = self.contacts {
            contacts.leave_out(self.world, h, weights);
        }
    }
}
