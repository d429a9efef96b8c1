//! Tests the hierarchy against brute force, against obvhs' own CWBVH, and at shared edges and
//! vertices.

use crate::common;

use common::{sphere, v};
use obvhs::{
    BvhBuildParams, cwbvh::builder::build_cwbvh_from_tris, ray::Ray, ray::RayHit,
    triangle::Triangle,
};
use picofarm_scene::{Object, Vec3};
use picofarm_transient::{Bvh, Kernel};
use proptest::{prelude::*, test_runner::TestCaseError};

const KERNELS: [Kernel; 3] = [Kernel::Avx512, Kernel::Avx2, Kernel::Portable];

fn soup(o: &Object) -> Vec<[Vec3; 3]> {
    let p = &o.mesh.positions;
    let corner = |i: u32| p[i as usize];
    o.mesh.triangles.iter().map(|t| t.map(corner)).collect()
}

/// Returns numbers in [-1, 1) without a generator crate.
fn noise(seed: u32) -> impl FnMut() -> f32 {
    let mut s = seed.wrapping_mul(747_796_405).wrapping_add(2_891_336_453);
    move || {
        s = s.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (s >> 8) as f32 / 8_388_608.0 - 1.0
    }
}

fn random_soup(count: usize, size: f32, seed: u32) -> Vec<[Vec3; 3]> {
    let mut r = noise(seed);
    (0..count)
        .map(|_| {
            let c = v(r(), r(), r()) * 4.0;
            [0; 3].map(|_| c + v(r(), r(), r()) * size)
        })
        .collect()
}

#[test]
fn a_closed_mesh_lets_no_ray_through_at_edges_and_vertices() {
    let triangles = soup(&sphere(v(0.3, -0.2, 0.1), 1.5, 4, common::grey(0.5)));
    for kernel in KERNELS {
        let Some(bvh) = Bvh::build(&triangles).with_kernel(kernel) else {
            println!("skipped: no {kernel:?} here");
            continue;
        };
        let mut stack = bvh.stack();
        let mut r = noise(5);
        for t in &triangles {
            for i in 0..3 {
                let from = v(r(), r(), r()) * 0.5;
                let (a, b) = (t[i], t[(i + 1) % 3]);
                let s = 0.5 + 0.5 * r();
                for target in [a, a + (b - a) * s, a + (b - a) * 0.5] {
                    let d = target - from;
                    assert!(bvh.closest(&mut stack, from, d, 10.0).is_some());
                    assert!(bvh.occluded(&mut stack, from, d, 10.0));
                }
            }
        }
    }
}

#[test]
fn all_kernels_give_the_same_bits() {
    let triangles = random_soup(3000, 0.4, 3);
    let portable = Bvh::build(&triangles)
        .with_kernel(Kernel::Portable)
        .unwrap();
    for kernel in KERNELS {
        let Some(wide) = Bvh::build(&triangles).with_kernel(kernel) else {
            println!("skipped: no {kernel:?} here");
            continue;
        };
        let (mut a, mut b) = (portable.stack(), wide.stack());
        let mut r = noise(8);
        for i in 0..20_000 {
            let mut d = v(r(), r(), r());
            if i % 5 == 0 {
                d.x = 0.0;
            }
            let o = v(r(), r(), r()) * 5.0;
            let bits = |h: Option<(f32, u32)>| h.map(|(t, id)| (t.to_bits(), id));
            let far = f32::INFINITY;
            assert_eq!(
                bits(portable.closest(&mut a, o, d, far)),
                bits(wide.closest(&mut b, o, d, far))
            );
            let limit = 3.0 * r().abs();
            assert_eq!(
                portable.occluded(&mut a, o, d, limit),
                wide.occluded(&mut b, o, d, limit)
            );
        }
    }
}

/// Checks that every kernel's results for the bundle equal those of portable single rays.
fn bundles_agree(triangles: &[[Vec3; 3]], from: Vec3, to: &[Vec3]) -> Result<usize, TestCaseError> {
    let single = Bvh::build(triangles).with_kernel(Kernel::Portable).unwrap();
    let mut stack = single.stack();
    let expected: Vec<bool> = to
        .iter()
        .map(|&p| single.occluded(&mut stack, from, p - from, 1.0))
        .collect();
    for kernel in KERNELS {
        let Some(bvh) = Bvh::build(triangles).with_kernel(kernel) else {
            println!("skipped: no {kernel:?} here");
            continue;
        };
        let mut stack = bvh.stack();
        let mut blocked = vec![false; to.len()];
        bvh.occluded_bundle(&mut stack, from, to, &mut blocked);
        prop_assert_eq!(&blocked, &expected, "{:?} from {:?}", kernel, from);
        prop_assert_eq!(stack.rays, to.len() as u64);
    }
    Ok(expected.iter().filter(|&&b| b).count())
}

/// Returns points around `centre`. Some repeat a coordinate of `from` or of each other, so that
/// directions have zeros and ties, and some are `from` itself or not finite.
fn targets(
    from: Vec3,
    centre: Vec3,
    spread: f32,
    count: usize,
    r: &mut impl FnMut() -> f32,
) -> Vec<Vec3> {
    let mut to: Vec<Vec3> = vec![];
    for _ in 0..count {
        let mut p = centre + v(r(), r(), r()) * spread;
        match (r() * 16.0) as i32 {
            3 => p.x = from.x,
            4 => p.y = from.y,
            5 => (p.x, p.z) = (from.x, from.z),
            6 => p = from + v(1.0, 1.0, 1.0) * (p.x - from.x),
            7 => p.z = from.z - (p.y - from.y),
            8 if r() > 0.5 => p = from,
            9 if r() > 0.8 => p.x = f32::INFINITY,
            10 if r() > 0.8 => p.y = f32::NAN,
            11 => p.x = from.x - 1e-30,
            12 if !to.is_empty() => p = to[to.len() / 2],
            _ => {}
        }
        to.push(p);
    }
    to
}

#[test]
fn bundles_in_a_room_of_axis_aligned_walls_agree_with_single_rays() {
    let material = common::grey(0.5);
    let mut objects = common::room(v(-2.0, -1.0, -3.0), v(2.0, 1.5, 1.0), &material);
    objects.extend(common::room(
        v(-0.5, -1.0, -1.5),
        v(0.25, -0.25, -0.75),
        &material,
    ));
    objects.push(sphere(v(1.0, 0.0, -2.0), 0.5, 3, material));
    let triangles: Vec<_> = objects.iter().flat_map(soup).collect();
    let mut r = noise(77);
    let mut mixed = 0;
    for i in 0..300 {
        // Origins are also on walls, vertices and edges, so that segments graze surfaces and end on
        // them.
        let t = triangles[((r() * 0.5 + 0.5) * triangles.len() as f32) as usize % triangles.len()];
        let from = match i % 3 {
            0 => t[0],
            1 => t[0] + (t[1] - t[0]) * 0.5,
            _ => v(1.9 * r(), 1.2 * r(), 2.0 * r() - 1.0),
        };
        let t = triangles[((r() * 0.5 + 0.5) * triangles.len() as f32) as usize % triangles.len()];
        let mut to = targets(from, t[0], 0.3, 20, &mut r);
        for k in 0..50 {
            let (a, b) = (0.02 * k as f32, 0.5 + 0.5 * r());
            to.push(t[0] + (t[1] - t[0]) * a + (t[2] - t[0]) * (b * (1.0 - a)));
        }
        let blocked = bundles_agree(&triangles, from, &to).unwrap();
        mixed += u32::from(blocked > 0 && blocked < to.len());
    }
    assert!(mixed > 50, "{mixed} bundles are partly blocked");
}

#[test]
fn a_fan_through_fine_meshes_agrees_with_single_rays() {
    let mut r = noise(5);
    let mut blocked = 0;
    for (seed, size) in [(11, 0.02), (12, 0.2)] {
        let triangles = random_soup(20_000, size, seed);
        for spread in [0.3, 4.0] {
            for number in [7, 25, 64] {
                let (from, centre) = (v(r(), r(), r()) * 5.0, v(r(), r(), r()) * 5.0);
                let to = targets(from, centre, spread, number, &mut r);
                blocked += bundles_agree(&triangles, from, &to).expect("the same answers");
            }
        }
    }
    assert!((50..350).contains(&blocked), "{blocked} of 384 blocked");
}

#[test]
fn a_bundle_into_an_empty_tree_is_free() {
    let empty = Bvh::build(&[]);
    let mut blocked = [true; 3];
    let to = [v(1.0, 0.0, 0.0), v(0.0, 0.0, 0.0), v(f32::NAN, 0.0, 0.0)];
    empty.occluded_bundle(&mut empty.stack(), Vec3::ZERO, &to, &mut blocked);
    assert_eq!(
        blocked,
        [false, true, true],
        "useless segments count as blocked"
    );
}

#[test]
fn the_nearest_hit_agrees_with_cwbvh() {
    let triangles = random_soup(20_000, 0.2, 11);
    let input: Vec<Triangle> = triangles
        .iter()
        .map(|t| {
            let [a, b, c] = t.map(<[f32; 3]>::from);
            let mut t = Triangle::default();
            (t.v0, t.v1, t.v2) = (a.into(), b.into(), c.into());
            t
        })
        .collect();
    let oracle = build_cwbvh_from_tris(
        &input,
        BvhBuildParams::medium_build(),
        &mut std::time::Duration::default(),
    );
    let bvh = Bvh::build(&triangles);
    let mut stack = bvh.stack();
    let mut r = noise(21);
    let (mut hits, mut differ) = (0, 0);
    for i in 0..20_000 {
        let (o, mut d) = (v(r(), r(), r()) * 5.0, v(r(), r(), r()));
        if i % 9 == 0 {
            d.x = 0.0;
        }
        // The oracle loses rays with a component of −0 (here it gets none); ours treats both zeros
        // alike.
        let negative = v(if d.x == 0.0 { -0.0 } else { d.x }, d.y, d.z);
        assert_eq!(
            bvh.closest(&mut stack, o, negative, f32::INFINITY),
            bvh.closest(&mut stack, o, d, f32::INFINITY)
        );
        let ray = Ray::new_inf(<[f32; 3]>::from(o).into(), <[f32; 3]>::from(d).into());
        let mut hit = RayHit::none();
        let found = oracle.ray_traverse(ray, &mut hit, |ray, id| {
            input[oracle.primitive_indices[id] as usize].intersect(ray)
        });
        match bvh.closest(&mut stack, o, d, f32::INFINITY) {
            Some((t, _)) if found => {
                hits += 1;
                differ += u32::from((t - hit.t).abs() > 1e-4 * t.max(1.0));
            }
            None if !found => {}
            _ => differ += 1,
        }
    }
    // The oracle's test may decide differently for rays that graze an edge.
    assert!(hits > 5_000 && differ <= 2, "{hits} hits, {differ} differ");
}

#[test]
fn rays_that_are_not_finite_are_refused() {
    let bvh = Bvh::build(&random_soup(50, 1.0, 2));
    let mut stack = bvh.stack();
    let good = v(0.1, 0.2, 0.3);
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        for wrong in [v(bad, 0.0, 1.0), v(0.0, bad, 1.0), v(0.0, 1.0, bad)] {
            assert_eq!(bvh.closest(&mut stack, wrong, good, 1.0), None);
            assert_eq!(bvh.closest(&mut stack, good, wrong, 1.0), None);
            assert!(bvh.occluded(&mut stack, wrong, good, 1.0));
        }
    }
    assert_eq!(bvh.closest(&mut stack, good, good, f32::NAN), None);
    assert_eq!(bvh.closest(&mut stack, good, Vec3::ZERO, 1.0), None);
}

#[test]
fn degenerate_duplicate_and_inverted_triangles_do_no_harm() {
    let t = [v(-1.0, -1.0, -2.0), v(1.0, -1.0, -2.0), v(0.0, 1.0, -2.0)];
    let point = [t[0]; 3];
    let line = [t[0], t[1], t[0] + (t[1] - t[0]) * 0.5];
    let nan = [v(f32::NAN, 0.0, 0.0), t[1], t[2]];
    let mut triangles = vec![point, line, nan, [t[0], t[2], t[1]], t];
    triangles.extend(vec![t; 100]);
    let bvh = Bvh::build(&triangles);
    let mut stack = bvh.stack();
    let hit = bvh.closest(&mut stack, Vec3::ZERO, v(0.0, 0.0, -1.0), 10.0);
    assert_eq!(hit, Some((2.0, 3)), "the lowest index wins a tie");
    let empty = Bvh::build(&[point, line]);
    let mut stack = empty.stack();
    assert_eq!(empty.closest(&mut stack, Vec3::ZERO, t[0], 10.0), None);
    assert!(!empty.occluded(&mut stack, Vec3::ZERO, t[0], 10.0));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn a_bundle_gives_what_its_segments_give_alone(
        seed in any::<u32>(),
        count in 1usize..1500,
        size in prop::sample::select(vec![0.02f32, 0.2, 1.0, 6.0]),
        spread in prop::sample::select(vec![0.001f32, 0.1, 0.5, 4.0]),
        scale in prop::sample::select(vec![1.0f32, 1.0, 1e-3, 1e4, 1e-12, 1e12]),
        shift in prop::sample::select(vec![0.0f32, 0.0, 300.0]),
    ) {
        let mut triangles = random_soup(count, size, seed);
        for (i, t) in triangles.iter_mut().enumerate() {
            // Some triangles are in planes of the axes; some are needles or duplicates.
            match i % 8 {
                0 => t.iter_mut().for_each(|p| p.y = 0.5),
                1 => t.iter_mut().for_each(|p| p.x = -0.25),
                2 => t[2] = t[0] + (t[1] - t[0]) * 0.999,
                _ => {}
            }
        }
        let place = |p: Vec3| (p + v(shift, 0.0, -shift)) * scale;
        let placed: Vec<_> = triangles.iter().map(|t| t.map(place)).collect();
        let mut r = noise(seed ^ 1234);
        for i in 0..12 {
            let t = triangles[i % triangles.len()];
            let from = if i % 3 == 0 { t[1] } else { v(r(), r(), r()) * 5.0 };
            let centre = if i % 4 == 0 { t[0] } else { v(r(), r(), r()) * 5.0 };
            let number = [1, 2, 7, 16, 33, 64, 65, 150][i % 8];
            let mut to = targets(from, centre, spread, number, &mut r);
            if i % 2 == 0 {
                to.extend([t[0], t[1], t[2], (t[0] + t[1]) * 0.5]);
            }
            let to: Vec<Vec3> = to.into_iter().map(place).collect();
            bundles_agree(&placed, place(from), &to)?;
        }
    }

    #[test]
    fn the_nearest_hit_is_that_of_a_tree_of_one_triangle_each(seed in any::<u32>(), count in 1usize..60) {
        let triangles = random_soup(count, 1.0, seed);
        let bvh = Bvh::build(&triangles);
        let single: Vec<Bvh> = triangles.iter().map(|t| Bvh::build(&[*t])).collect();
        let mut stack = bvh.stack();
        let mut r = noise(seed ^ 77);
        for _ in 0..200 {
            let (o, d) = (v(r(), r(), r()) * 5.0, v(r(), r(), r()));
            let mut best: Option<(f32, u32)> = None;
            for (i, one) in single.iter().enumerate() {
                let mut s = one.stack();
                if let Some((t, _)) = one.closest(&mut s, o, d, f32::INFINITY)
                    && best.is_none_or(|b| t < b.0)
                {
                    best = Some((t, i as u32));
                }
            }
            prop_assert_eq!(bvh.closest(&mut stack, o, d, f32::INFINITY), best);
        }
    }
}
