//! The bits of a fit depend neither on threads nor on stops.

use std::sync::atomic::{AtomicU32, Ordering};

use picofarm_reconstruct::{Phase, Progress, Unwatched};

use super::{room, small};
use crate::Training;

fn whole() -> Vec<u8> {
    let mut training = Training::begin(room(), small()).unwrap();
    assert!(training.run(&Unwatched).unwrap());
    assert_eq!(training.state().step, 12);
    training.checkpoint()
}

#[test]
fn one_two_and_three_threads_give_the_same_bytes() {
    let with = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
        pool.unwrap().install(|| {
            // The layers are wide enough for matrix products on several threads.
            let settings = crate::Settings {
                width: 128,
                distance_steps: 2,
                shadow_steps: 2,
                ..small()
            };
            let mut training = Training::begin(room(), settings).unwrap();
            assert!(training.run(&Unwatched).unwrap());
            training.checkpoint()
        })
    };
    let one = with(1);
    assert!(one == with(2), "two threads");
    assert!(one == with(3), "three threads");
}

/// Stops at the n-th call: a step calls it once for each part of its batch.
struct StopAfter(AtomicU32);

impl Progress for StopAfter {
    fn at(&self, phase: Phase, done: f32, _: Option<f64>) -> bool {
        assert!(phase == Phase::Optimise && (0.0..=1.0).contains(&done));
        self.0.fetch_sub(1, Ordering::Relaxed) > 0
    }
}

#[test]
fn stopped_and_resumed_is_undisturbed() {
    let undisturbed = whole();
    for stops in [1, 8, 15] {
        let mut training = Training::begin(room(), small()).unwrap();
        assert!(!training.run(&StopAfter(AtomicU32::new(stops))).unwrap());
        let kept = training.checkpoint();
        assert!(training.run(&Unwatched).unwrap());
        assert!(training.checkpoint() == undisturbed, "in the same process");
        let mut resumed = Training::resume(room(), small(), &kept).unwrap();
        assert!(
            resumed.checkpoint() == kept,
            "a checkpoint says all there is"
        );
        assert!(resumed.run(&Unwatched).unwrap());
        assert!(resumed.checkpoint() == undisturbed, "from a checkpoint");
    }
}

#[test]
fn a_checkpoint_of_something_else_is_refused() {
    let training = Training::begin(room(), small()).unwrap();
    let kept = training.checkpoint();
    let refused = |settings, bytes: &[u8]| {
        let e = Training::resume(room(), settings, bytes).unwrap_err();
        e.to_string()
    };
    assert!(refused(small(), b"nothing").contains("begin anew"));
    assert!(refused(small(), &kept[..kept.len() - 1]).contains("is cut off"));
    let other = crate::Settings { seed: 5, ..small() };
    assert!(refused(other, &kept).contains("other measurements or settings"));
}
