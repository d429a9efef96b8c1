//! Measures rays per second of CPU time on one thread, in a furnished room and two finer
//! tessellations of it.
//!
//! `just lab rays [--export DIR] [--rounds N] [--only RAYS]
//! [--kernel avx2|portable]`
//! prints a table: mesh, set of rays, millions of rays per CPU second (best round). `--export` also
//! writes the meshes and rays as raw little-endian files, for other ray tracers
//! (`tests/lab/peers/embree_rays.py`).

use std::{
    fs::{self, File},
    io::{BufWriter, Write},
    path::{Path, PathBuf},
    time::Instant,
};

use picofarm_scene::{AssetLibrary, Scene, Vec3, furnished};
use picofarm_transient::{Bvh, Kernel};

/// Image width and height: one primary ray per pixel, in tiles of 8×8 pixels.
const SIDE: u32 = 256;
const TILE: usize = 64;

/// Rays of one kind in tracing order.
enum Rays {
    /// Origin and direction; the nearest hit.
    Closest(Vec<(Vec3, Vec3)>),
    /// From, to; any hit between.
    Single(Vec<(Vec3, Vec3)>),
    /// One point and the range of `points` that it is tested against, per bundle.
    Bundles {
        from: Vec<(Vec3, std::ops::Range<usize>)>,
        points: Vec<Vec3>,
    },
}

#[derive(Clone, Copy)]
struct Hit {
    p: Vec3,
    n: Vec3,
}

/// Prints the table.
pub fn run(arguments: &[String]) {
    let value = |name: &str| {
        let at = arguments.iter().position(|a| a == name)?;
        arguments.get(at + 1).cloned()
    };
    let export = value("--export").map(PathBuf::from);
    let rounds = value("--rounds").map_or(3, |n| n.parse().expect("--rounds takes a number"));
    let kernel = value("--kernel");
    let only = value("--only");
    let settings = furnished::FurnishedSettings {
        width: SIDE,
        height: SIDE,
        ..Default::default()
    };
    let scene = furnished::generate(7, &settings, &AssetLibrary::parametric()).expect("a room");
    let coarse = soup(&scene);
    println!(
        "{:<10} {:<12} {:>9} {:>8}",
        "triangles", "rays", "count", "M/CPU-s"
    );
    for cuts in [1, 3, 5] {
        let triangles: Vec<_> = coarse.iter().flat_map(|t| cut(t, cuts)).collect();
        let bvh = match kernel.as_deref() {
            None => Bvh::build(&triangles),
            Some("portable") => with(&triangles, Kernel::Portable),
            Some("avx2") => with(&triangles, Kernel::Avx2),
            Some(other) => panic!("unknown kernel {other}: choose avx2 or portable"),
        };
        let mesh = format!("{}k", triangles.len() / 1000);
        let sets = rays(&scene, &triangles, &bvh);
        if let Some(folder) = &export {
            write(folder, &mesh, &triangles, &sets).expect("the export folder can be written");
        }
        let mut total = [0.0f64; 2];
        for (name, set) in &sets {
            if only.as_ref().is_some_and(|o| o != name) {
                continue;
            }
            let (count, seconds) = best(&bvh, set, rounds, false);
            row(&mesh, name, count, seconds);
            if let Rays::Bundles { .. } = set {
                let (count, seconds) = best(&bvh, set, rounds, true);
                row(&mesh, &format!("{name}/1"), count, seconds);
            }
            if matches!(*name, "primary" | "spots") {
                total = [total[0] + count as f64, total[1] + seconds];
                if *name == "spots" {
                    row(&mesh, "primary+25", total[0] as usize, total[1]);
                }
            }
        }
    }
}

fn with(triangles: &[[Vec3; 3]], kernel: Kernel) -> Bvh {
    let bvh = Bvh::build(triangles).with_kernel(kernel);
    bvh.expect("this machine has the kernel asked for")
}

fn row(mesh: &str, name: &str, count: usize, seconds: f64) {
    let rate = count as f64 / seconds / 1e6;
    println!("{mesh:<10} {name:<12} {count:>9} {rate:>8.2}");
}

/// Returns the number of rays of a pass and the CPU seconds of the fastest pass.
fn best(bvh: &Bvh, rays: &Rays, rounds: usize, split: bool) -> (usize, f64) {
    let (mut count, mut seconds) = (0, f64::INFINITY);
    for _ in 0..rounds {
        // Run at least 150 ms per round, because the clock ticks every few milliseconds.
        let (start, begun, mut passes) = (cpu_seconds(), Instant::now(), 0u32);
        while begun.elapsed().as_millis() < 150 {
            count = pass(bvh, rays, split);
            passes += 1;
        }
        seconds = seconds.min((cpu_seconds() - start) / f64::from(passes));
    }
    (count, seconds)
}

fn pass(bvh: &Bvh, rays: &Rays, split: bool) -> usize {
    let mut stack = bvh.stack();
    let mut found = 0usize;
    match rays {
        Rays::Closest(list) => {
            for &(o, d) in list {
                found += usize::from(bvh.closest(&mut stack, o, d, f32::INFINITY).is_some());
            }
        }
        Rays::Single(list) => {
            for &(a, b) in list {
                found += usize::from(bvh.occluded(&mut stack, a, b - a, 1.0));
            }
        }
        Rays::Bundles { from, points } => {
            let mut blocked = [false; TILE];
            for (a, range) in from {
                let to = &points[range.clone()];
                if split {
                    for &b in to {
                        found += usize::from(bvh.occluded(&mut stack, *a, b - *a, 1.0));
                    }
                } else {
                    let blocked = &mut blocked[..to.len()];
                    bvh.occluded_bundle(&mut stack, *a, to, blocked);
                    found += blocked.iter().filter(|&&b| b).count();
                }
            }
        }
    }
    std::hint::black_box(found);
    stack.rays as usize
}

/// Returns the CPU time of this thread.
fn cpu_seconds() -> f64 {
    let text = fs::read_to_string("/proc/thread-self/schedstat").unwrap_or_default();
    let nanoseconds = text.split(' ').next().and_then(|t| t.parse::<f64>().ok());
    nanoseconds.expect("the kernel tells CPU times in /proc/thread-self/schedstat") * 1e-9
}

fn soup(scene: &Scene) -> Vec<[Vec3; 3]> {
    let place = |o: &picofarm_scene::Object, t: &[u32; 3]| {
        t.map(|i| o.to_world.point(o.mesh.positions[i as usize]))
    };
    let objects = scene.objects.iter();
    objects
        .flat_map(|o| o.mesh.triangles.iter().map(move |t| place(o, t)))
        .collect()
}

/// Cuts a triangle into n² of the same shape.
fn cut(t: &[Vec3; 3], n: u32) -> Vec<[Vec3; 3]> {
    let at = |i: u32, j: u32| {
        t[0] + (t[1] - t[0]) * (i as f32 / n as f32) + (t[2] - t[0]) * (j as f32 / n as f32)
    };
    let mut parts = vec![];
    for i in 0..n {
        for j in 0..n - i {
            parts.push([at(i, j), at(i + 1, j), at(i, j + 1)]);
            if i + j + 1 < n {
                parts.push([at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)]);
            }
        }
    }
    parts
}

/// Returns a generator of numbers in [0, 1).
fn noise(seed: u32) -> impl FnMut() -> f32 {
    let mut s = u64::from(seed).wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    move || {
        s = s
            .wrapping_mul(6_364_136_223_846_793_005)
            .wrapping_add(1_442_695_040_888_963_407);
        (s >> 40) as f32 / 16_777_216.0
    }
}

/// Returns a cosine-distributed direction about `n`.
fn scatter(n: Vec3, r: &mut dyn FnMut() -> f32) -> Vec3 {
    loop {
        let s = Vec3::new(r(), r(), r()) * 2.0 - Vec3::splat(1.0);
        let square = s.dot(s);
        if square > 0.01 && square < 1.0 {
            let d = n + s / square.sqrt();
            if d.dot(d) > 1e-4 {
                return d.normalized();
            }
        }
    }
}

fn rays(scene: &Scene, triangles: &[[Vec3; 3]], bvh: &Bvh) -> Vec<(&'static str, Rays)> {
    let mut stack = bvh.stack();
    let mut trace = |o: Vec3, d: Vec3| -> Option<Hit> {
        let (t, id) = bvh.closest(&mut stack, o, d, f32::INFINITY)?;
        let [a, b, c] = triangles[id as usize];
        let n = (b - a).cross(c - a).normalized();
        let n = if n.dot(d) > 0.0 { -n } else { n };
        Some(Hit {
            p: o + d * t + n * 1e-4,
            n,
        })
    };
    let mut r = noise(1);
    let eye = scene.camera.origin;
    let primary: Vec<(Vec3, Vec3)> = (0..SIDE * SIDE)
        .map(|i| {
            let (tile, k) = (i / 64, i % 64);
            let (x, y) = (tile % (SIDE / 8) * 8 + k % 8, tile / (SIDE / 8) * 8 + k / 8);
            (eye, scene.camera.ray(x as f32 + r(), y as f32 + r()))
        })
        .collect();
    let next = |from: &[Option<Hit>], r: &mut dyn FnMut() -> f32| -> Vec<(Vec3, Vec3)> {
        let hits = from.iter().flatten();
        hits.map(|h| (h.p, scatter(h.n, r))).collect()
    };
    let first: Vec<_> = primary.iter().map(|&(o, d)| trace(o, d)).collect();
    let bounce1 = next(&first, &mut r);
    let second: Vec<_> = bounce1.iter().map(|&(o, d)| trace(o, d)).collect();
    let bounce2 = next(&second, &mut r);
    let third: Vec<_> = bounce2.iter().filter_map(|&(o, d)| trace(o, d)).collect();
    let beams = &scene.laser.beams;
    let spots: Vec<Vec3> = beams
        .iter()
        .filter_map(|b| trace(scene.laser.origin, b.direction).map(|h| h.p))
        .collect();
    let one_of = |n: usize, r: &mut dyn FnMut() -> f32| ((r() * n as f32) as usize).min(n - 1);
    let shadow = third
        .iter()
        .map(|h| (h.p, spots[one_of(spots.len(), &mut r)]))
        .collect();
    // Bundles to each tile's points from every spot and from vertices of paths that start in the
    // tile, and to a quarter of a tile (such as a pixel's samples) from such a vertex.
    let (mut points, mut starts) = (vec![], vec![0]);
    for tile in first.chunks(TILE) {
        points.extend(tile.iter().flatten().map(|h| h.p));
        starts.push(points.len());
    }
    let bundles = |from: Vec<(Vec3, std::ops::Range<usize>)>| Rays::Bundles {
        from,
        points: points.clone(),
    };
    let tiles: Vec<_> = starts.windows(2).map(|w| w[0]..w[1]).collect();
    let tiles = tiles.into_iter().filter(|t| !t.is_empty());
    let (mut lit, mut reused, mut quarter) = (vec![], vec![], vec![]);
    for t in tiles {
        lit.extend(spots.iter().map(|&s| (s, t.clone())));
        for _ in 0..16 {
            // `second` is indexed like the existing points.
            let k = t.start + one_of(t.len(), &mut r);
            let Some(y) = second[k] else { continue };
            reused.push((y.p, t.clone()));
            let step = t.len().div_ceil(4);
            quarter.extend(
                t.clone()
                    .step_by(step)
                    .map(|a| (y.p, a..(a + step).min(t.end))),
            );
        }
    }
    vec![
        ("primary", Rays::Closest(primary)),
        ("spots", bundles(lit)),
        ("bounce1", Rays::Closest(bounce1)),
        ("bounce2", Rays::Closest(bounce2)),
        ("shadow", Rays::Single(shadow)),
        ("reuse64", bundles(reused)),
        ("reuse16", bundles(quarter)),
    ]
}

/// Writes `MESH.triangles` (nine f32 each) and, for each set, `MESH.NAME.closest` or `.any`:
/// origin, direction and limit of each ray, seven f32.
fn write(
    folder: &Path,
    mesh: &str,
    triangles: &[[Vec3; 3]],
    sets: &[(&str, Rays)],
) -> std::io::Result<()> {
    fs::create_dir_all(folder)?;
    let put = |f: &mut BufWriter<File>, v: Vec3| {
        let floats = <[f32; 3]>::from(v);
        floats
            .iter()
            .try_for_each(|x| f.write_all(&x.to_le_bytes()))
    };
    let open = |name: String| File::create(folder.join(name)).map(BufWriter::new);
    let mut f = open(format!("{mesh}.triangles"))?;
    triangles
        .iter()
        .flatten()
        .try_for_each(|&p| put(&mut f, p))?;
    f.flush()?;
    for (name, rays) in sets {
        let (kind, limit, list) = match rays {
            Rays::Closest(list) => ("closest", f32::INFINITY, list.clone()),
            Rays::Single(list) => ("any", 1.0, list.iter().map(|&(a, b)| (a, b - a)).collect()),
            Rays::Bundles { from, points } => {
                let segments = from
                    .iter()
                    .flat_map(|(a, range)| points[range.clone()].iter().map(|&b| (*a, b - *a)));
                ("any", 1.0, segments.collect())
            }
        };
        let mut f = open(format!("{mesh}.{name}.{kind}"))?;
        for (o, d) in list {
            put(&mut f, o)?;
            put(&mut f, d)?;
            f.write_all(&f32::to_le_bytes(limit))?;
        }
        f.flush()?;
    }
    Ok(())
}
