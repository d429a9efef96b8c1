use proptest::prelude::*;

use super::*;
use crate::api::Unstopped;

fn pane(ior: f32, transmittance: f32, face: bool) -> Material {
    Material {
        bsdf: Bsdf::ThinDielectric {
            ior,
            transmittance,
            face,
        },
        rgb: [transmittance, 0.5 * transmittance, 0.0],
        ..Material::glass("pane")
    }
}

#[test]
fn a_pane_lets_through_what_fresnel_says() {
    // Window glass reflects 4 % at each face at normal incidence. At Brewster's angle one
    // polarisation is fully transmitted.
    assert!((clear(1.5, 1.0) - 0.96 / 1.04).abs() < 1e-6);
    let brewster = libm::atanf(1.5);
    let r = ((1.0f32 - 1.5 * 1.5) / (1.0 + 1.5 * 1.5)).powi(2);
    let expected = 0.5 * (1.0 + (1.0 - r) / (1.0 + r));
    assert!((clear(1.5, libm::cosf(brewster)) - expected).abs() < 1e-6);
    assert!(clear(1.5, 0.0).abs() < 1e-6);
    assert!(clear(1.5, 1e-3) < 0.01);
    for cos in [1.0, 0.3, 1e-6, 1e-18] {
        assert_eq!(clear(1.0, cos), 1.0, "{cos}");
    }
    assert_eq!(clear(1.0, 0.0), 0.0);
}

#[test]
fn two_faces_are_a_pane() {
    let whole = Glass::new(&pane(1.5, 0.6, false)).unwrap();
    let face = Glass::new(&pane(1.5, 0.6, true)).unwrap();
    for cos in [1.0, 0.5, 0.1] {
        for (whole, face) in whole.through(cos).into_iter().zip(face.through(cos)) {
            assert!((face * face - whole).abs() < 1e-6);
        }
    }
}

fn built(triangles: &[[Vec3; 3]], materials: &[Material]) -> Panes {
    let materials: Vec<&Material> = materials.iter().collect();
    let panes = Panes::new(triangles, &materials, Stop(&Unstopped)).expect("nobody stops it");
    panes.expect("there is glass")
}

fn corner() -> impl Strategy<Value = Vec3> {
    [-4.0f32..4.0, -4.0f32..4.0, -4.0f32..4.0].prop_map(Vec3::from)
}

proptest! {
    /// Compares with an independent test of every triangle in f64.
    #[test]
    fn a_way_meets_every_pane_across_it(
        triangles in prop::collection::vec([corner(), corner(), corner()], 1..40),
        (a, b) in (corner(), corner()),
    ) {
        let materials: Vec<Material> = (0..triangles.len())
            .map(|k| pane(1.0, 0.3 + 0.6 * (k as f32 / 40.0), k % 3 == 0))
            .collect();
        let panes = built(&triangles, &materials);
        let mut stack = panes.bvh.stack();
        let wide = |v: Vec3| [f64::from(v.x), f64::from(v.y), f64::from(v.z)];
        let sub = |a: [f64; 3], b: [f64; 3]| [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
        let dot = |a: [f64; 3], b: [f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
        let cross = |a: [f64; 3], b: [f64; 3]| {
            [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
        };
        let (o, d) = (wide(a), sub(wide(b), wide(a)));
        let (mut expected, mut unsure, mut places) = (1.0f64, false, vec![]);
        for (t, m) in triangles.iter().zip(&materials) {
            let [p, q, r] = t.map(wide);
            let (e, f, s) = (sub(q, p), sub(r, p), sub(o, p));
            let n = cross(d, f);
            let det = dot(e, n);
            let (u, w) = (dot(s, n) / det, dot(d, cross(s, e)) / det);
            let t = dot(f, cross(s, e)) / det;
            let close = |x: f64| x.abs() < 1e-3;
            unsure |= close(det) || close(u) || close(w) || close(1.0 - u - w) || close(t) || close(1.0 - t);
            if u >= 0.0 && w >= 0.0 && u + w <= 1.0 && (0.0..=1.0).contains(&t) {
                expected *= f64::from(Glass::new(m).unwrap().through(0.5)[0]);
                places.push(t);
            }
        }
        places.sort_by(f64::total_cmp);
        unsure |= places.windows(2).any(|p| p[1] - p[0] < 1e-4);
        prop_assume!(!unsure);
        let found = panes.through(&mut stack, a, b);
        prop_assert!((f64::from(found) - expected).abs() < 1e-4, "{found} {expected}");
        let back = panes.through(&mut stack, b, a);
        prop_assert!((back - found).abs() < 1e-4, "{back} {found}");
    }
}

proptest! {
    #[test]
    fn a_bundle_passes_as_each_way_of_it_does(
        triangles in prop::collection::vec([corner(), corner(), corner()], 1..40),
        from in corner(),
        to in prop::collection::vec(corner(), 0..150),
    ) {
        let materials: Vec<Material> = (0..triangles.len())
            .map(|k| pane(1.5, 0.3 + 0.6 * (k as f32 / 40.0), k % 3 == 0))
            .collect();
        let panes = built(&triangles, &materials);
        let (mut alone, mut together) = (panes.bvh.stack(), panes.bvh.stack());
        let expected: Vec<f32> = to.iter().map(|&to| panes.through(&mut alone, from, to)).collect();
        let mut found = vec![1.0; to.len()];
        panes.through_bundle(&mut together, from, &to, |k, share| found[k] = share);
        prop_assert_eq!(found, expected);
        prop_assert_eq!(together.rays, alone.rays);
    }
}

#[test]
fn an_edge_between_two_triangles_is_met_once() {
    let at = |x: f32, y: f32| Vec3::new(x, y, 1.0);
    let square = [
        [at(-1.0, -1.0), at(1.0, -1.0), at(1.0, 1.0)],
        [at(-1.0, -1.0), at(1.0, 1.0), at(-1.0, 1.0)],
    ];
    let glass = pane(1.0, 0.5, false);
    let panes = built(&square, &[glass.clone(), glass]);
    let mut stack = panes.bvh.stack();
    // Along the diagonal, including the corners of the square.
    for k in -8i16..=8 {
        let x = 0.125 * f32::from(k);
        let through = panes.through(&mut stack, Vec3::ZERO, at(x, x) * 2.0);
        assert_eq!(through, 0.5, "{x}");
    }
    assert_eq!(panes.through(&mut stack, Vec3::ZERO, at(1.5, 0.0)), 1.0);
    assert_eq!(
        panes.through(&mut stack, Vec3::ZERO, at(0.0, 0.5) * 0.9),
        1.0
    );
    assert_eq!(
        panes.tint(&mut stack, Vec3::ZERO, at(0.2, 0.1) * 2.0),
        [0.5, 0.25, 0.0]
    );
}
