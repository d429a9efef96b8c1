//! Measures reconstructions of PlatoNeRF's room: L1 of 139 novel views against CPU-seconds.
use std::time::Instant;

use picofarm_reconstruct::{
    Reconstruction, Settings, Shadows, World,
    render::Renderer,
    score::score_views,
    source::{Disturbed, from_truth},
};
use picofarm_scene::plato::{self, PlatoObject, PlatoSettings};
use picofarm_transient::{Budget, Gate, Strategy};

struct Quiet;
impl picofarm_transient::Progress for Quiet {
    fn at(&self, _: f32) -> bool {
        true
    }
}
fn cpu() -> f64 {
    let s = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let f: Vec<&str> = s
        .rsplit(')')
        .next()
        .unwrap_or("")
        .split_whitespace()
        .collect();
    (f[11].parse::<f64>().unwrap() + f[12].parse::<f64>().unwrap()) / 100.0
}
fn main() {
    let arg = |k: &str, d: &str| {
        std::env::args()
            .find_map(|a| a.strip_prefix(&format!("{k}=")).map(str::to_owned))
            .unwrap_or(d.into())
    };
    let num = |k: &str, d: f64| arg(k, &d.to_string()).parse::<f64>().unwrap();
    let object = PlatoObject::ALL
        .iter()
        .find(|o| o.0 == arg("object", "chair"))
        .unwrap()
        .1;
    let px = num("px", 512.0) as u32;
    let scene = plato::generate(&PlatoSettings {
        object,
        spots: num("spots", 16.0) as usize,
        resolution: px,
    })
    .unwrap();
    let t = Instant::now();
    let settings = picofarm_transient::Settings {
        gate: Gate {
            start_m: 0.0,
            bin_width_m: 100.0,
            bins: 1,
        },
        budget: Budget::Samples(1),
        max_bounces: Some(1),
        one_bounce: false,
        seed: 0,
        split: false,
        groups: vec![],
        strategy: Strategy::default(),
    };
    let rendered = picofarm_transient::render(&scene, &settings, &Quiet).unwrap();
    println!("truth {:.1}s", t.elapsed().as_secs_f32());
    let world = World::new(&scene);
    let every = num("every", 7.0) as usize;
    let views: Vec<_> = plato::views(128)
        .into_iter()
        .skip(every / 2)
        .step_by(every)
        .collect();
    let how = Disturbed {
        bin_width_m: num("bin", 0.0384) as f32,
        noise_m: num("noise", 0.0) as f32,
        smooth_m: num("smooth", 0.0) as f32,
        flipped: num("flip", 0.0) as f32,
        seed: 0,
    };
    let measured = if arg("source", "truth") == "truth" {
        from_truth(&scene, &rendered, &how).unwrap()
    } else {
        let t = Instant::now();
        let c = picofarm_reconstruct::source::CaptureSettings {
            gate: Gate {
                start_m: 1.0,
                bin_width_m: 0.0384,
                bins: 391,
            },
            samples: num("samples", 8.0) as u32,
            seed: 0,
        };
        let m = picofarm_reconstruct::source::captures_of(&scene, &c, &|_, _| true).unwrap();
        println!(
            "captures {:.1}s left out {:?}",
            t.elapsed().as_secs_f32(),
            m.left_out
        );
        let tr = from_truth(&scene, &rendered, &how).unwrap();
        let n = m.pixels();
        for (k, s) in m.spots.iter().enumerate() {
            let (mut a, mut b, mut c, mut e, mut u) = (0, 0, 0, 0.0, 0);
            for p in 0..n {
                let q = k * n + p;
                if m.used[q] == 0 || tr.used[q] == 0 {
                    u += 1;
                    continue;
                }
                match (m.lit[q], tr.lit[q]) {
                    (1, 0) => a += 1,
                    (0, 1) => b += 1,
                    (1, 1) => {
                        c += 1;
                        if (m.tau[q] - tr.tau[q]).abs() > 0.06 {
                            e += 1.0
                        }
                    }
                    _ => {}
                }
            }
            println!(
                "  spot {k} off {:.4} m: false lit {:.4} false shadow {:.4} of them wrong times {:.4} unused {:.3}",
                (s.point - rendered.spots[s.beam].unwrap().point).length(),
                a as f32 / n as f32,
                b as f32 / n as f32,
                e / c as f32,
                u as f32 / n as f32
            );
        }
        m
    };
    for n in arg("nodes", "192").split(',') {
        let settings = Settings {
            nodes: n.parse().unwrap(),
            planes: arg("planes", "1") == "1",
            shadows: match &*arg("shadows", "opt") {
                "no" => Shadows::Ignore,
                "carve" => Shadows::Carve,
                _ => Shadows::Optimise,
            },
            iterations: num("iters", 100.0) as u32,
            batch: num("batch", 16384.0) as u32,
            seed: 0,
        };
        struct P(Instant);
        impl picofarm_reconstruct::Progress for P {
            fn at(&self, p: picofarm_reconstruct::Phase, d: f32, l: Option<f64>) -> bool {
                if d == 0.0
                    || p == picofarm_reconstruct::Phase::Optimise && (d * 100.0) as u32 % 25 == 0
                {
                    eprintln!(
                        "  {:6.2} {} {d:.2} {l:?}",
                        self.0.elapsed().as_secs_f32(),
                        p.name()
                    )
                }
                true
            }
        }
        let (c, t) = (cpu(), Instant::now());
        let p = P(t);
        let mut r = Reconstruction::begin(measured.clone(), settings, &p).unwrap();
        r.run(&p).unwrap();
        let out = r.finish();
        let (c, t) = (cpu() - c, t.elapsed().as_secs_f32());
        let dm: Vec<f32> = {
            let mut e: Vec<f32> = out
                .depth
                .range
                .iter()
                .zip(&rendered.truth.range)
                .filter(|(a, _)| a.is_finite())
                .map(|(a, b)| (a - b).abs() * 1e3)
                .collect();
            e.sort_by(f32::total_cmp);
            vec![
                e.iter().sum::<f32>() / e.len() as f32,
                e[e.len() / 2],
                e[e.len() * 99 / 100],
            ]
        };
        println!(
            "  planes {} grid {:?} depth mean/median/p99 {dm:?} mm none {}",
            out.planes.len(),
            out.field.nodes,
            out.depth.range.iter().filter(|r| !r.is_finite()).count()
        );
        let tt = Instant::now();
        let s = score_views(
            &Renderer::new(&out.field),
            &out.measured.camera,
            &world,
            &views,
        );
        println!(
            "n {n}: L1 all {:.4} within {:.4} visible {:.4} occluded {:.4} (objects {:.4}) outside {:.4} | rmse {:.3} psnr {:.1} | cpu {c:.1} wall {t:.1} score {:.1}s | share {:.2} {:.2} {:.2} open filled {:.2}",
            s.all.l1_m,
            s.within_view.l1_m,
            s.visible.l1_m,
            s.occluded.l1_m,
            s.occluded_objects.l1_m,
            s.outside.l1_m,
            s.all.rmse_m,
            s.psnr_db,
            tt.elapsed().as_secs_f32(),
            s.visible.pixels as f64 / s.all.pixels as f64,
            s.occluded.pixels as f64 / s.all.pixels as f64,
            s.outside.pixels as f64 / s.all.pixels as f64,
            s.open_filled
        );
        if arg("mesh", "0") == "1" {
            let tt = Instant::now();
            let m = picofarm_reconstruct::surface(&out.field);
            println!(
                "  mesh {} vertices {:.2}s",
                m.positions.len(),
                tt.elapsed().as_secs_f32()
            );
            println!(
                "  {:?}",
                picofarm_reconstruct::score::mesh_score(&m, &world, &out.field, 0)
            );
            println!(
                "  {:?} {:.2}s",
                picofarm_reconstruct::score::floaters(&out.field, &world, 0),
                tt.elapsed().as_secs_f32()
            );
            if let Some(f) =
                std::env::args().find_map(|a| a.strip_prefix("ply=").map(str::to_owned))
            {
                std::fs::write(f, m.ply()).unwrap();
            }
        }
    }
}
