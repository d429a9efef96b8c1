//! Prints the agreement of consistent and of wrong measurements in many rooms, a line each;
//! arguments are scene files. The limits of `src/agreement.rs` were chosen with the sets `right`
//! and `tuned`; the set `kept` was only evaluated afterwards.
//!
//! In the environment, `QUICK` omits times, `CAPTURES` also renders captures, `FIT` shows held-out
//! losses instead, and `ROOMS=4` takes every fourth room.

use picofarm_reconstruct::{
    Measured, Reconstruction, Settings, Unwatched, reconstruct,
    source::{CaptureSettings, Disturbed, captures_of, from_truth, truth_of},
};
use picofarm_scene::{
    Scene, Vec3, furnished,
    import::read_scene,
    plato::{self, PlatoObject, PlatoSettings},
    primitive,
};
use picofarm_settings::{Jitter, Pulse, Scale, Sensor};
use picofarm_transient::{Gate, Progress};

struct Unstopped;

impl Progress for Unstopped {
    fn at(&self, _: f32) -> bool {
        true
    }
}

const SIDE: u32 = 96;

fn rooms(files: &[String]) -> Vec<(String, Scene)> {
    let mut all = Vec::new();
    for (name, object) in PlatoObject::ALL {
        let settings = PlatoSettings {
            object,
            spots: 16,
            resolution: SIDE,
        };
        all.push((
            format!("plato-{name}"),
            plato::generate(&settings).expect("a room"),
        ));
    }
    for seed in 0..8 {
        let settings = primitive::PrimitiveSettings {
            width: SIDE,
            height: SIDE,
            ..Default::default()
        };
        if let Ok(scene) = primitive::generate(seed, &settings) {
            all.push((format!("primitive-{seed}"), scene));
        }
    }
    let library = picofarm_scene::AssetLibrary::parametric();
    for seed in 0..8 {
        let settings = furnished::FurnishedSettings {
            width: SIDE,
            height: SIDE,
            ..Default::default()
        };
        if let Ok(scene) = furnished::generate(seed, &settings, &library) {
            all.push((format!("furnished-{seed}"), scene));
        }
    }
    for file in files {
        let mut scene = read_scene(std::path::Path::new(file)).expect("a scene");
        let i = &mut scene.camera.intrinsics;
        *i = i.resized(SIDE, SIDE);
        all.push((file.rsplit('/').next().unwrap_or(file).to_owned(), scene));
    }
    all
}

type Wrong = (&'static str, &'static str, fn(&mut Measured));

const WRONG: [Wrong; 15] = [
    ("tuned", "swap 0 1", |m| swap(m, 0, 1)),
    ("tuned", "mirror x", |m| {
        mirror(m, |_, q| Vec3::new(-q.x, q.y, q.z))
    }),
    ("tuned", "t0 +10cm", |m| late(m, 0.1)),
    ("kept", "gate +10cm", |m| gate(m, 0.1)),
    ("kept", "gate -10cm", |m| gate(m, -0.1)),
    ("kept", "mirror y", |m| {
        mirror(m, |_, q| Vec3::new(q.x, -q.y, q.z))
    }),
    ("kept", "swap 5 9", |m| swap(m, 5, 9)),
    ("kept", "scale 1.1", |m| {
        for s in &mut m.spots {
            s.point = m.camera.origin + (s.point - m.camera.origin) * 1.1;
        }
    }),
    ("kept", "start -3cm", |m| late(m, -0.03)),
    ("kept", "start +3cm", |m| late(m, 0.03)),
    ("kept", "start -10cm", |m| late(m, -0.1)),
    ("kept", "masks inverted", |m| {
        // Known times are not changed.
        for q in 0..m.lit.len() {
            m.lit[q] = 1 - m.lit[q];
            if m.lit[q] != 0 && m.tau[q] <= m.spots[q / m.pixels()].path_m {
                m.used[q] = 0;
            }
        }
    }),
    ("kept", "columns mirrored", |m| {
        let w = m.camera.intrinsics.width as usize;
        for row in m.tau.chunks_mut(w) {
            row.reverse();
        }
        for row in m.lit.chunks_mut(w) {
            row.reverse();
        }
        for row in m.used.chunks_mut(w) {
            row.reverse();
        }
        clean(m);
    }),
    ("kept", "fx 10 % off", |m| m.camera.intrinsics.fx *= 1.1),
    ("kept", "times scaled 1.1", |m| {
        for t in &mut m.tau {
            *t *= 1.1;
        }
        clean(m);
    }),
];

/// Excludes impossible measurements, as sources do.
fn clean(m: &mut Measured) {
    let pixels = m.pixels();
    for q in 0..m.lit.len() {
        let s = &m.spots[q / pixels];
        if m.lit[q] != 0 && m.tau[q] <= s.path_m + (s.point - m.camera.origin).length() {
            m.used[q] = 0;
        }
    }
}

fn swap(m: &mut Measured, a: usize, b: usize) {
    if m.spots.len() <= a.max(b) {
        return;
    }
    m.spots.swap(a, b);
    clean(m);
}

fn mirror(m: &mut Measured, by: impl Fn(&picofarm_scene::Camera, Vec3) -> Vec3) {
    let c = m.camera;
    for s in &mut m.spots {
        let q = by(&c, c.to_camera(s.point));
        s.point = c.origin + c.right * q.x + c.down * q.y + c.forward * q.z;
        s.direction = (s.point - m.laser).normalized();
    }
    clean(m);
}

fn late(m: &mut Measured, by: f32) {
    for (t, lit) in m.tau.iter_mut().zip(&m.lit) {
        if *lit != 0 {
            *t += by;
        }
    }
    clean(m);
}

/// Delays all light by this amount, one-bounce light included. The spots of captures, which are
/// located by it, are then farther away.
fn gate(m: &mut Measured, by: f32) {
    late(m, by);
    for s in &mut m.spots {
        s.path_m += 0.5 * by;
        s.point += s.direction * (0.5 * by);
    }
    clean(m);
}

fn show(set: &str, room: &str, kind: &str, measured: Measured) {
    if std::env::var_os("FIT").is_some() {
        let settings = Settings {
            nodes: 48,
            iterations: 60,
            batch: 4096,
            accept_inconsistent: true,
            ..Settings::default()
        };
        match reconstruct(measured, settings, &Unwatched) {
            Ok(made) => println!(
                "{set:8} {room:22} {kind:22} {:?} held-out loss {:.3}",
                made.agreement.verdict,
                made.held_out_loss.unwrap_or(f64::NAN)
            ),
            Err(e) => println!("{set:8} {room:22} {kind:22} refused: {e}"),
        }
        return;
    }
    let settings = Settings {
        nodes: 48,
        shadows: picofarm_settings::Shadows::Ignore,
        accept_inconsistent: true,
        ..Settings::default()
    };
    match Reconstruction::begin(measured, settings, &Unwatched) {
        Ok(begun) => {
            let a = begun.agreement();
            println!(
                "{set:8} {room:22} {kind:22} {:?} res {:.4} worst {:?} offset {:+.4} off {:.4} shadows {:.4} light {:.4} n {} unlit {:.4}",
                a.verdict,
                a.time_residual_m.unwrap_or(f32::NAN),
                a.worst_spot,
                a.time_offset_m.unwrap_or(f32::NAN),
                a.spots_off_surface_m.unwrap_or(f32::NAN),
                a.shadows_without_cause.unwrap_or(f32::NAN),
                a.light_through_surfaces.unwrap_or(f32::NAN),
                a.times,
                a.unlit_pixels.unwrap_or(f32::NAN)
            );
        }
        Err(e) => println!("{set:8} {room:22} {kind:22} refused: {e}"),
    }
}

/// Prints a line for each room and measurement.
pub fn run(files: &[String]) {
    let some = std::env::var("ROOMS").ok().and_then(|n| n.parse().ok());
    for (room, scene) in rooms(files).into_iter().step_by(some.unwrap_or(1)) {
        let rendered = truth_of(&scene, &Unstopped).expect("truth");
        let of = |how: Disturbed| from_truth(&scene, &rendered, &how).expect("measured");
        let bins = Disturbed {
            bin_width_m: 0.0384,
            ..Disturbed::default()
        };
        let noisy = Disturbed {
            noise_m: 0.02,
            flipped: 0.02,
            seed: 1,
            ..bins
        };
        let predicted = Disturbed {
            smooth_m: 0.02,
            flipped: 0.03,
            seed: 2,
            ..Disturbed::default()
        };
        show("right", &room, "exact", of(Disturbed::default()));
        show("right", &room, "bins", of(bins));
        show("right", &room, "noisy", of(noisy));
        show("right", &room, "predicted", of(predicted));
        if std::env::var_os("CAPTURES").is_some() {
            for photons in [None, Some(200.0)] {
                let settings = CaptureSettings {
                    gate: Gate {
                        start_m: 0.5,
                        bin_width_m: 0.0384,
                        bins: 637,
                    },
                    samples: 2,
                    seed: 3,
                    sensor: photons.map(|photons| Sensor {
                        pulse: Pulse::None {},
                        jitter: Jitter::Gaussian { fwhm_ps: 0.0 },
                        scale: Scale::Peak { photons },
                        ..Sensor::default()
                    }),
                };
                if let Ok(m) = captures_of(&scene, &settings, &|_, _| true) {
                    show(
                        "right",
                        &room,
                        if photons.is_some() {
                            "photons"
                        } else {
                            "captures"
                        },
                        m,
                    );
                }
            }
        }
        let quick = std::env::var_os("QUICK").is_some();
        let hows: &[Disturbed] = if quick { &[] } else { &[bins, noisy] };
        for how in hows {
            for (set, name, wrong) in WRONG {
                let mut m = of(*how);
                wrong(&mut m);
                let kind = format!("{name}{}", if how.noise_m > 0.0 { " noisy" } else { "" });
                show(set, &room, &kind, m);
            }
        }
        // Masks alone: times follow from depth.
        for (set, name, wrong) in WRONG {
            if ![
                "swap 0 1",
                "swap 5 9",
                "mirror x",
                "mirror y",
                "masks inverted",
            ]
            .contains(&name)
            {
                continue;
            }
            let mut m = of(Disturbed::default());
            wrong(&mut m);
            let (pixels, eye) = (m.pixels(), m.camera.origin);
            for q in 0..m.lit.len() {
                let (s, p) = (m.spots[q / pixels], q % pixels);
                let range = rendered.truth.range[p];
                let x = eye + m.ray(p) * range;
                m.tau[q] = s.path_m + (x - s.point).length() + range;
                m.used[q] = u8::from(range > 0.0 && m.tau[q] > s.path_m);
            }
            show(set, &room, &format!("{name} by depth"), m);
        }
    }
}
