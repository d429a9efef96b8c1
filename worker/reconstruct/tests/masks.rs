//! Shadow masks from rendered captures.

mod common;

use common::{Unstopped, measured, room};
use picofarm_reconstruct::{
    Measured,
    source::{CaptureSettings, Captures, LIT_THRESHOLD},
};
use picofarm_scene::plato::PlatoObject;
use picofarm_transient::{Gate, render};

#[test]
fn fewer_pixels_are_falsely_lit_than_by_the_plain_threshold() {
    let (scene, rendered) = room(PlatoObject::Chair, 8, 64);
    let truth = measured(&scene, &rendered);
    let settings = CaptureSettings {
        gate: Gate {
            start_m: 0.0,
            bin_width_m: 0.0384,
            bins: 391,
        },
        samples: 1,
        seed: 3,
    };
    let laser = scene.laser.clone();
    let mut both =
        [(); 2].map(|()| Captures::new(scene.camera, laser.clone(), settings.gate, LIT_THRESHOLD));
    let mut alone = scene.clone();
    for (beam, of) in scene.laser.beams.iter().enumerate() {
        alone.laser.beams = vec![*of];
        let capture = render(&alone, &settings.render_settings(), &Unstopped).unwrap();
        for captures in &mut both {
            captures.add(beam, &capture.transient).unwrap();
        }
    }
    let [plain, expected] = both;
    let (plain, expected) = (plain.finish_plain(), expected.finish());
    assert_eq!(expected.spots.len(), truth.spots.len());
    let count = |of: &Measured, lit: u8| {
        let wrong = |q: &usize| {
            truth.used[*q] != 0 && of.used[*q] != 0 && truth.lit[*q] == 1 - lit && of.lit[*q] == lit
        };
        (0..truth.lit.len()).filter(wrong).count()
    };
    let falsely_lit = [&plain, &expected].map(|m| count(m, 1));
    assert!(falsely_lit[1] * 2 < falsely_lit[0], "{falsely_lit:?}");
    // Most pixels still take part.
    let used = [&plain, &expected].map(|m| m.used.iter().filter(|u| **u != 0).count());
    assert!(used[1] * 10 > used[0] * 8, "{used:?}");
    expected.check().unwrap();
}
