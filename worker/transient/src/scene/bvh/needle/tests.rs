use picofarm_scene::Vec3;
use proptest::prelude::*;

use super::{along, is_needle};
use crate::scene::{
    bvh::{nodes::Kernel, normal::normal, tree::Bvh},
    intersection::{lift, point},
};

fn v(p: (f32, f32, f32)) -> Vec3 {
    Vec3::new(p.0, p.1, p.2)
}

fn place(range: std::ops::Range<f32>) -> impl Strategy<Value = Vec3> {
    (range.clone(), range.clone(), range).prop_map(v)
}

#[test]
fn needles_are_told_by_length_over_width_at_any_scale() {
    for scale in [1e-6f32, 1.0, 1e6] {
        let t = |width: f32| {
            [
                Vec3::ZERO,
                Vec3::new(scale, 0.0, 0.0),
                Vec3::new(0.4 * scale, width * scale, 0.0),
            ]
        };
        assert!(!is_needle(&t(0.1)) && is_needle(&t(0.05)), "{scale}");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2_000))]

    /// Tests the two needles of a strip with every kernel.
    #[test]
    fn rays_from_and_to_a_point_of_a_strip_do_not_meet_it(
        middle in place(-3.0..3.0),
        (along, across) in (place(-1.0..1.0), place(-1.0..1.0)),
        (length, width) in (0.1f32..4.0, -4.0f32..-1.0),
        (share, beside) in (-0.45f32..0.45, -0.45f32..0.45),
        others in prop::collection::vec(place(-6.0..6.0), 8),
    ) {
        prop_assume!(along.length() > 0.1 && along.cross(across).length() > 0.1);
        let l = along.normalized();
        let w = l.cross(across).normalized().cross(l) * libm::powf(10.0, width);
        let l = l * length;
        let corner = |a: f32, b: f32| middle + l * a + w * b;
        let [a, b, c, d] = [(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)].map(|(a, b)| corner(a, b));
        let strip = [[a, b, c], [a, c, d]];
        // The camera is at the origin.
        let goal = corner(share, beside);
        prop_assume!(goal.length() > 0.2);
        let triangles: Vec<_> = strip.to_vec();
        for kernel in [Kernel::Avx512, Kernel::Avx2, Kernel::Portable] {
            let Some(bvh) = Bvh::build(&triangles).with_kernel(kernel) else {
                continue;
            };
            let mut stack = bvh.stack();
            let Some((_, id)) = bvh.closest(&mut stack, Vec3::ZERO, goal.normalized(), f32::INFINITY) else {
                continue;
            };
            let t = strip[id as usize];
            let n = normal(&t).expect("it has an area");
            let n = if n.dot(goal) <= 0.0 { n } else { -n };
            prop_assume!(n.dot(goal.normalized()) < -1e-2);
            let p = point(&t, Vec3::ZERO, goal.normalized());
            let from = lift(p, n);
            let above = |q: &Vec3| n.dot((*q - p).normalized()) > 1e-2;
            let ends: Vec<Vec3> = others.iter().copied().filter(above).collect();
            let mut blocked = vec![false; ends.len()];
            bvh.occluded_bundle(&mut stack, from, &ends, &mut blocked);
            prop_assert!(blocked.iter().all(|b| !b), "a bundle from the strip, {kernel:?}");
            for &q in &ends {
                prop_assert!(!bvh.occluded(&mut stack, from, q - from, 1.0), "from the strip, {kernel:?}");
                prop_assert!(!bvh.occluded(&mut stack, q, from - q, 1.0), "to the strip, {kernel:?}");
                let mut one = [false; 8];
                bvh.occluded_bundle(&mut stack, q, &[from; 8], &mut one);
                prop_assert_eq!(one, [false; 8], "a bundle to the strip, {:?}", kernel);
            }
        }
    }

    #[test]
    fn a_needle_is_met_where_its_plane_is(
        t in [place(-4.0..4.0), place(-4.0..4.0), place(-4.0..4.0)],
        (o, d) in (place(-4.0..4.0), place(-1.0..1.0)),
    ) {
        // Any triangle except needles: f32 is accurate for most of them.
        prop_assume!(normal(&t).is_some() && d.length() > 0.1);
        let mut stack = Bvh::build(&[t]).stack();
        if let Some((f32_says, _)) = Bvh::build(&[t]).closest(&mut stack, o, d, f32::INFINITY) {
            let n = normal(&t).expect("it has an area");
            prop_assume!(n.dot(d).abs() > 1e-2 && !is_needle(&t));
            let exact = along(&t, o, d);
            prop_assert!((exact - f32_says).abs() < 1e-3 * (1.0 + exact), "{exact} {f32_says}");
        }
    }
}
