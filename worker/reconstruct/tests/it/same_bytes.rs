//! The bits of a result depend neither on threads nor on stops.

use crate::common;

use std::sync::atomic::{AtomicU32, Ordering};

use common::{measured, room, small};
use picofarm_reconstruct::{
    Measured, Phase, Progress, ReconstructError, Reconstructed, Reconstruction, Unwatched,
    reconstruct, surface,
};
use picofarm_scene::plato::PlatoObject;

fn chair() -> Measured {
    let (scene, rendered) = room(PlatoObject::Chair, 4, 64);
    measured(&scene, &rendered)
}

fn bits(made: &Reconstructed) -> (Vec<u32>, Vec<u8>) {
    let logits = made.field.logit.iter().map(|u| u.to_bits()).collect();
    (logits, surface(&made.field).ply())
}

#[test]
fn one_two_and_three_threads_give_the_same_bytes() {
    let input = chair();
    let with = |threads| {
        let pool = rayon::ThreadPoolBuilder::new()
            .num_threads(threads)
            .build()
            .unwrap();
        pool.install(|| bits(&reconstruct(input.clone(), small(), &Unwatched).unwrap()))
    };
    let one = with(1);
    assert!(one == with(2), "two threads");
    assert!(one == with(3), "three threads");
}

/// Stops after the given number of iterations.
struct StopAfter(AtomicU32);

impl Progress for StopAfter {
    fn at(&self, phase: Phase, _: f32, _: Option<f64>) -> bool {
        phase != Phase::Optimise || self.0.fetch_sub(1, Ordering::Relaxed) > 0
    }
}

#[test]
fn stopped_and_resumed_is_undisturbed() {
    let input = chair();
    let whole = bits(&reconstruct(input.clone(), small(), &Unwatched).unwrap());
    let mut under_way = Reconstruction::begin(input.clone(), small(), &Unwatched).unwrap();
    assert!(
        !under_way.run(&StopAfter(AtomicU32::new(7))).unwrap(),
        "it was stopped"
    );
    let kept = under_way.checkpoint();
    // Resumes in the same process.
    assert!(under_way.run(&Unwatched).unwrap());
    assert!(bits(&under_way.finish()) == whole, "after a stop");
    // Resumes from bytes, and stops again.
    let mut again = Reconstruction::resume(input.clone(), small(), &kept, &Unwatched).unwrap();
    assert!(!again.run(&StopAfter(AtomicU32::new(1))).unwrap());
    let kept = again.checkpoint();
    let mut last = Reconstruction::resume(input, small(), &kept, &Unwatched).unwrap();
    assert!(last.run(&Unwatched).unwrap());
    assert!(bits(&last.finish()) == whole, "after two checkpoints");
}

#[test]
fn a_checkpoint_of_something_else_is_refused() {
    let input = chair();
    let begun = Reconstruction::begin(input.clone(), small(), &Unwatched).unwrap();
    let kept = begun.checkpoint();
    let other = picofarm_reconstruct::Settings { seed: 9, ..small() };
    let said = |settings, bytes: &[u8]| match Reconstruction::resume(
        input.clone(),
        settings,
        bytes,
        &Unwatched,
    ) {
        Err(ReconstructError::Invalid { field, what }) => format!("{field}: {what}"),
        Err(e) => panic!("{e}"),
        Ok(_) => panic!("it was taken"),
    };
    assert!(said(other, &kept).contains("other measurements or settings"));
    assert!(said(small(), b"nonsense").contains("is none"));
    assert!(said(small(), &kept[..10]).contains("cut off"));
    let mut longer = kept.clone();
    longer.push(0);
    assert!(said(small(), &longer).contains("cut off"));
}

#[test]
fn a_stop_before_the_optimisation_is_told() {
    struct Never;
    impl Progress for Never {
        fn at(&self, _: Phase, _: f32, _: Option<f64>) -> bool {
            false
        }
    }
    let stopped = Reconstruction::begin(chair(), small(), &Never);
    assert!(matches!(stopped, Err(ReconstructError::Stopped)));
}
