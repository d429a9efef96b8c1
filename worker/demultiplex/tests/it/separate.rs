//! The methods for separate captures, where times and masks are known in closed form.

use picofarm_demultiplex::{DemultiplexError, Demultiplexed, Separate, separate};
use picofarm_scene::Vec3;
use picofarm_sensor::{Draws, poisson};
use picofarm_settings::Gate;

use crate::common::{Plate, Room, Shape, grid};

const SIDE: u32 = 24;
/// A desk-top box: in a larger room, a pixel's own width would spread its returns.
const SHAPE: Shape = Shape {
    size: 0.3,
    mirror: None,
};
/// Bins of 8 ps.
const GATE: Gate = Gate {
    start_m: 0.3,
    bin_width_m: 8e-12 * 299_792_458.0,
    bins: 1350,
};
/// Standard deviation of the pulse, bins: 128 ps at half its height.
const SIGMA: f32 = 6.8;
/// Photons of a pair with cos·cos/r² = 1, and photons of the background in a bin.
const PHOTONS: f32 = 400.0;
const AMBIENT: f32 = 0.05;
const METHODS: [Separate; 2] = [Separate::MatchedFilter, Separate::Likelihood];

fn plate() -> Plate {
    Plate {
        x: 0.09,
        sides: [-0.12, 0.48, 0.3, 0.72],
    }
}

/// The capture of each spot: a room with this spot alone.
fn rooms(noisy: bool) -> (Room, Vec<Vec<f32>>) {
    let room = |places: &[[f32; 2]]| {
        let laser = Vec3::new(0.08, 0.0, 0.0);
        Room::shaped(SIDE, places, Some(plate()), GATE, laser, SHAPE, |_, _| true)
    };
    let places = grid(3);
    let all = places.iter().enumerate().map(|(k, place)| {
        let one = room(std::slice::from_ref(place));
        let mut draws = Draws::new(5, k as u64, 0, 0);
        let blurred = one.histogram.chunks(GATE.bins as usize).flat_map(blurred);
        let count = |x: f32| match noisy {
            true => poisson(f64::from(PHOTONS * x + AMBIENT), &mut draws) as f32,
            false => PHOTONS * x,
        };
        blurred.map(count).collect()
    });
    let all = all.collect();
    (room(&places), all)
}

/// A histogram behind a Gaussian pulse.
fn blurred(h: &[f32]) -> Vec<f32> {
    let reach = (4.0 * SIGMA) as isize;
    let weight = |k: isize| (-0.5 * (k as f32 / SIGMA).powi(2)).exp();
    let sum: f32 = (-reach..=reach).map(weight).sum();
    let mut out = vec![0.0; h.len()];
    for (bin, x) in h.iter().enumerate().filter(|(_, x)| **x > 0.0) {
        for k in -reach..=reach {
            if let Some(to) = out.get_mut((bin as isize + k) as usize) {
                *to += x * weight(k) / sum;
            }
        }
    }
    out
}

fn found(room: &Room, captures: &[Vec<f32>], method: Separate, known: bool) -> Demultiplexed {
    let beams = room.beams(known);
    let mut read = |k: usize| Ok::<_, DemultiplexError>(captures[k].clone());
    separate(&room.capture(&beams), method, 1.0, &mut read).expect("captures")
}

/// Median error of depth away from edges, metres, and the share of pairs away from edges whose mask
/// is right, among those that can carry light.
fn errors(room: &Room, found: &Demultiplexed) -> (f32, f64) {
    let pixels = (SIDE * SIDE) as usize;
    let plain = vec![0; pixels];
    let off = (0..pixels).filter(|p| room.inner(&plain, *p, 1));
    let mut off: Vec<f32> = off
        .map(|p| (found.depth_m[p] - room.depth[p]).abs())
        .collect();
    off.sort_by(f32::total_cmp);
    let (mut right, mut all) = (0, 0);
    for (k, lit) in room.lit.chunks(pixels).enumerate() {
        for p in (0..pixels).filter(|p| room.faces[k * pixels + p] && room.inner(lit, *p, 1)) {
            all += 1;
            right += usize::from((found.lit[k * pixels + p] >= 0.5) == (lit[p] == 1));
        }
    }
    (off[off.len() / 2], f64::from(right as u32) / f64::from(all))
}

#[test]
fn depth_is_right_to_millimetres_and_masks_are_the_true_ones() {
    for noisy in [false, true] {
        let (room, captures) = rooms(noisy);
        assert!(room.lit.contains(&0) && room.lit.contains(&1));
        for method in METHODS {
            for known in [true, false] {
                let found = found(&room, &captures, method, known);
                let (depth, masks) = errors(&room, &found);
                // A spot that is found by its return is in the middle of a pixel's steps.
                let most = if known { 0.006 } else { 0.02 };
                assert!(depth < most, "{method:?}, noisy {noisy}: {depth} m");
                assert!(masks > 0.95, "{method:?}, noisy {noisy}: {masks}");
                assert_eq!((found.mirror, found.places.len()), (None, 9));
            }
        }
    }
}

#[test]
fn without_a_pulse_later_bounces_light_nothing_for_the_matched_filter() {
    let laser = Vec3::new(0.08, 0.0, 0.0);
    let gate = Gate {
        bin_width_m: 0.006,
        bins: 540,
        ..GATE
    };
    let room = |places: &[[f32; 2]]| {
        Room::shaped(SIDE, places, Some(plate()), gate, laser, SHAPE, |_, _| true)
    };
    let capture = |place: &[f32; 2]| {
        let mut all = room(std::slice::from_ref(place)).histogram;
        let bins = gate.bins as usize;
        let mut usual: Vec<f32> = all.chunks(bins).map(|h| h.iter().sum()).collect();
        usual.sort_by(f32::total_cmp);
        let usual = usual[usual.len() / 2];
        // Every pixel sees light of three and more bounces, over 60 bins.
        for h in all.chunks_mut(bins) {
            let later = h.iter_mut().skip(240).take(60);
            later.for_each(|x| *x += 0.3 * usual / 60.0);
        }
        all
    };
    let captures: Vec<Vec<f32>> = grid(3).iter().map(capture).collect();
    let room = room(&grid(3));
    let found = found(&room, &captures, Separate::MatchedFilter, true);
    let (depth, masks) = errors(&room, &found);
    assert!(depth < 0.006, "{depth} m");
    assert!(masks > 0.95, "{masks}");
}

#[test]
fn a_spot_in_the_dark_lights_nothing_and_the_others_answer() {
    let (room, mut captures) = rooms(false);
    captures[4].fill(0.0);
    let pixels = (SIDE * SIDE) as usize;
    for method in METHODS {
        let found = found(&room, &captures, method, true);
        assert!(found.lit[4 * pixels..][..pixels].iter().all(|p| *p < 0.5));
        let (depth, _) = errors(&room, &found);
        assert!(depth < 0.006, "{method:?}: {depth} m");
    }
}

#[test]
fn bins_of_32_ps_change_hardly_a_mask() {
    let (mut room, captures) = rooms(false);
    let fine = found(&room, &captures, Separate::MatchedFilter, true);
    // Two of the 1,350 bins are left over.
    let (bins, whole) = (GATE.bins as usize, GATE.bins as usize / 4 * 4);
    let sums = |h: &Vec<f32>| {
        let pixels = h.chunks(bins).flat_map(|pixel| pixel[..whole].chunks(4));
        pixels.map(|b| b.iter().sum()).collect()
    };
    let coarse: Vec<Vec<f32>> = captures.iter().map(sums).collect();
    room.gate.bin_width_m *= 4.0;
    room.gate.bins /= 4;
    let coarse = found(&room, &coarse, Separate::MatchedFilter, true);
    let pairs = fine.lit.iter().zip(&coarse.lit);
    let other = pairs.filter(|(a, b)| (**a - **b).abs() > 0.5).count();
    assert!(
        100 * other < fine.lit.len(),
        "{other} of {}",
        fine.lit.len()
    );
}

#[test]
fn the_number_of_threads_changes_no_bit() {
    let (room, captures) = rooms(true);
    for method in METHODS {
        let on = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads);
            let pool = pool.build().expect("a pool");
            pool.install(|| found(&room, &captures, method, true))
        };
        assert_eq!(on(1), on(5));
    }
}

#[test]
fn captures_that_cannot_be_are_refused_by_name() {
    let (room, captures) = rooms(false);
    let beams = room.beams(true);
    let refused = |photons: f32, captures: &[Vec<f32>]| {
        let mut read = |k: usize| Ok::<_, DemultiplexError>(captures[k].clone());
        let method = Separate::MatchedFilter;
        let made = separate(&room.capture(&beams), method, photons, &mut read);
        made.expect_err("refused").to_string()
    };
    let error = refused(0.0, &captures);
    assert!(
        error.contains("photons: is 0, expected a positive"),
        "{error}"
    );
    let mut short = captures.clone();
    short[3].pop();
    let error = refused(1.0, &short);
    assert!(
        error.contains("capture of spot 3: histogram: has"),
        "{error}"
    );
    let dark = vec![vec![0.0; captures[0].len()]; 9];
    let error = refused(1.0, &dark);
    assert!(
        error.contains("no pixel has a two-bounce return"),
        "{error}"
    );
}

#[test]
fn an_error_of_the_reader_is_passed_on() {
    #[derive(Debug, PartialEq)]
    struct Lost;
    impl From<DemultiplexError> for Lost {
        fn from(e: DemultiplexError) -> Self {
            panic!("{e}")
        }
    }
    let (room, _) = rooms(false);
    let beams = room.beams(true);
    let made = separate(
        &room.capture(&beams),
        Separate::Likelihood,
        1.0,
        &mut |_| Err(Lost),
    );
    assert_eq!(made.expect_err("lost"), Lost);
}
