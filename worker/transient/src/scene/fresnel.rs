//! Smooth surfaces between air and a body of glass: reflection and refraction of unpolarised light.

use picofarm_scene::{Bsdf, Material, Vec3};

/// A body of glass behind a surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Body {
    /// Index of refraction relative to the surroundings.
    pub ior: f32,
    /// Share of the refracted light that passes the surface.
    pub transmittance: f32,
}

/// The reflection and refraction of a ray at a surface.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Split {
    /// Reflected share; 1 for total reflection.
    pub reflects: f32,
    /// Unit direction of the reflected ray.
    pub reflected: Vec3,
    /// Unit direction of the refracted ray; meaningless for total reflection.
    pub refracted: Vec3,
}

impl Body {
    /// Returns `None` if the material is not a body of glass.
    pub fn new(material: &Material) -> Option<Self> {
        match material.bsdf {
            Bsdf::Dielectric { ior, transmittance } => Some(Self { ior, transmittance }),
            _ => None,
        }
    }
}

/// Splits a ray along the unit direction `w` at a surface with the unit normal `n` facing the ray,
/// from the index of refraction `from` to `to` (Snell, Fresnel).
pub(crate) fn split(w: Vec3, n: Vec3, (from, to): (f32, f32)) -> Split {
    let cos = (-n.dot(w)).clamp(0.0, 1.0);
    let reflected = (w + n * (2.0 * cos)).normalized();
    let ratio = from / to;
    // Square of the cosine behind the surface, written without 1 − sin², so that equal indices
    // change nothing.
    let square = 1.0 - ratio * ratio + ratio * ratio * (cos * cos);
    if square <= 0.0 {
        return Split {
            reflects: 1.0,
            reflected,
            refracted: w,
        };
    }
    let behind = square.sqrt();
    let (a, b) = (from * cos, to * behind);
    let (c, d) = (to * cos, from * behind);
    let root = |x: f32, y: f32| {
        let r = (x - y) / (x + y).max(f32::MIN_POSITIVE);
        r * r
    };
    Split {
        reflects: 0.5 * (root(a, b) + root(c, d)),
        reflected,
        refracted: (w * ratio + n * (ratio * cos - behind)).normalized(),
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn rays_bend_as_snell_says_and_come_back_the_way_they_came(
            x in -1.0f32..1.0, y in -1.0f32..1.0, ior in 1.0f32..4.0,
        ) {
            let n = Vec3::new(0.0, 0.0, 1.0);
            let w = Vec3::new(x, y, -1.0).normalized();
            let there = split(w, n, (1.0, ior));
            let sine = |w: Vec3| f64::from(n.cross(w).length());
            prop_assert!((sine(there.refracted) * f64::from(ior) - sine(w)).abs() < 1e-6);
            prop_assert!(there.refracted.z < 0.0 && there.reflected.z > 0.0);
            prop_assert!((0.0..=1.0).contains(&there.reflects));
            let back = split(-there.refracted, -n, (ior, 1.0));
            prop_assert!((back.refracted + w).length() < 1e-5, "{:?} {w:?}", back.refracted);
            prop_assert!((back.reflects - there.reflects).abs() < 1e-5);
        }

        #[test]
        fn flat_rays_from_within_are_reflected_whole(angle in 0.0f32..1.0, ior in 1.1f32..4.0) {
            // The angle is beyond the critical angle.
            let sine = 1.0 / ior + angle * (1.0 - 1.0 / ior);
            let w = Vec3::new(sine, 0.0, -(1.0 - sine * sine).max(0.0).sqrt()).normalized();
            prop_assume!(sine > 1.0 / ior * (1.0 + 1e-5));
            prop_assert_eq!(split(w, Vec3::new(0.0, 0.0, 1.0), (ior, 1.0)).reflects, 1.0);
        }
    }

    #[test]
    fn a_surface_without_a_step_of_the_index_changes_nothing() {
        let w = Vec3::new(0.6, 0.0, -0.8);
        let same = split(w, Vec3::new(0.0, 0.0, 1.0), (1.0, 1.0));
        assert_eq!(same.reflects, 0.0);
        assert!((same.refracted - w).length() < 1e-6);
        // At normal incidence the reflectance is (n − 1)²/(n + 1)².
        let straight = split(
            Vec3::new(0.0, 0.0, -1.0),
            Vec3::new(0.0, 0.0, 1.0),
            (1.0, 1.5),
        );
        assert!((straight.reflects - 0.04).abs() < 1e-6);
    }
}
