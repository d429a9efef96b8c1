//! Rays through a field: closed forms, and gradients against finite differences.

use picofarm_reconstruct::{
    cast_ray,
    field::{EMPTY, Field, GAIN, PEAK, sigmoid, surface_logit},
    render::Renderer,
};
use picofarm_scene::Vec3;
use proptest::prelude::*;

fn cube(nodes: usize) -> Field {
    Field::over(Vec3::ZERO, Vec3::splat(2.0), nodes)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn a_slab_of_constant_density_has_its_depth_and_transmittance_in_closed_form(
        logit in -4.0f32..1.0, x in 0.3f32..1.7, y in 0.3f32..1.7, slant in -0.15f32..0.15,
    ) {
        let mut field = cube(33);
        field.logit.fill(logit);
        let sigma = PEAK / field.spacing * sigmoid(logit);
        let renderer = Renderer::new(&field);
        let origin = Vec3::new(x, y, -1.0);
        let direction = Vec3::new(slant, 0.5 * slant, 1.0).normalized();
        let enter = 1.0 / direction.z;
        let half = enter + std::f32::consts::LN_2 / sigma;
        let leave = 3.0 / direction.z;
        let depth = renderer.depth(origin, direction);
        if half < leave - 0.05 {
            let depth = depth.expect("half the light is stopped inside");
            prop_assert!((depth - half).abs() < 2e-3, "{depth} {half}");
        } else if half > leave + 0.05 {
            prop_assert_eq!(depth, None);
            prop_assert!((renderer.depth_or_end(origin, direction) - leave).abs() < 1e-4);
        }
        let (a, b) = (Vec3::new(x, y, 0.2), Vec3::new(x + slant, y, 0.7));
        let expected = (-sigma * (b - a).length()).exp();
        let got = renderer.transmittance(a, b);
        prop_assert!((got - expected).abs() < 1e-3, "{got} {expected}");
    }

    #[test]
    fn a_flat_surface_anywhere_between_nodes_is_seen_where_it_is(z in 0.5f32..1.5) {
        let mut field = cube(41);
        for i in 0..field.logit.len() {
            let u = GAIN * (field.at(i).z - z) / field.spacing + surface_logit();
            field.logit[i] = u.clamp(EMPTY, 9.0);
        }
        let depth = Renderer::new(&field).depth(Vec3::new(1.0, 1.0, -0.5), Vec3::new(0.0, 0.0, 1.0));
        let error = depth.expect("it is solid behind") - 0.5 - z;
        prop_assert!(error.abs() < 0.02 * field.spacing, "{error}");
    }

    #[test]
    fn gradients_are_those_of_finite_differences(seed in 0u64..1000, free: bool) {
        let mut field = cube(6);
        let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
        for u in &mut field.logit {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            *u = (state >> 40) as f32 / 16_777_216.0 * 6.0 - 4.0;
        }
        let (a, b) = (Vec3::new(0.11, 0.23, 0.15), Vec3::new(1.83, 1.71, 1.62));
        let (_, slopes) = cast_ray(&field, a, b, free);
        let largest = slopes.iter().fold(0.0f64, |m, s| m.max(s.abs()));
        for (node, &slope) in slopes.iter().enumerate() {
            let at = |delta: f32| {
                let mut moved = field.clone();
                moved.logit[node] += delta;
                cast_ray(&moved, a, b, free).0
            };
            let step = 0.02;
            let difference = (at(step) - at(-step)) / f64::from(2.0 * step);
            let error = (difference - slope).abs();
            prop_assert!(error < 2e-3 * largest + 2e-4, "node {node}: {difference} {slope}");
        }
    }
}
