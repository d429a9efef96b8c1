//! Measures the cost of a data set's rooms: furnished rooms of seeds that were not used for tuning,
//! rendered to an error on one thread.

use std::path::PathBuf;

use picofarm_scene::{
    AssetLibrary,
    furnished::{self, FurnishedSettings},
};
use picofarm_settings::Spots;
use picofarm_transient::Budget;

/// The first seed.
const FIRST: u64 = 98_001;
const SPOTS: u32 = 25;
/// Number of scenes in the data set that the mean is scaled to.
const DATA_SET: f64 = 97_432.0;

/// Renders `count` rooms with a library's furniture, and prints the cost of each, with mean and
/// spread over all. `folder` contains the library's files, unless they are in their installed
/// place.
pub fn run(library: &str, folder: Option<&String>, (count, pixels): (u32, u32), error: f64) {
    let folders: Vec<PathBuf> = folder.map(PathBuf::from).into_iter().collect();
    let library = AssetLibrary::find(library, &folders).unwrap_or_else(|e| {
        eprintln!("rooms: {e}");
        std::process::exit(1);
    });
    let settings = FurnishedSettings {
        spots: Spots::Grid(SPOTS),
        width: pixels,
        height: pixels,
        assets: library.name().into(),
        ..FurnishedSettings::default()
    };
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build();
    let pool = pool.expect("a thread can be started");
    println!("seed  triangles  CPU s  M rays  paths  says %");
    let mut found = vec![];
    for seed in FIRST..FIRST + u64::from(count) {
        let scene = furnished::generate(seed, &settings, &library).expect("sound settings");
        let each = scene.objects.iter();
        let triangles: usize = each.map(|o| o.mesh.triangles.len()).sum();
        let before = super::cpu_seconds();
        let r = pool.install(|| super::render_once(&scene, Budget::Error(error), seed));
        let row = [
            super::cpu_seconds() - before,
            r.rays as f64 / 1e6,
            f64::from(r.error.samples),
            100.0 * f64::from(r.error.median_relative),
        ];
        let [cpu_s, rays, paths, says] = row;
        println!("{seed}  {triangles}  {cpu_s:.1}  {rays:.0}  {paths}  {says:.2}");
        found.push(row);
    }
    let n = found.len() as f64;
    let names = ["CPU s", "M rays", "paths", "says %"];
    for (k, name) in names.into_iter().enumerate() {
        let all = || found.iter().map(|row| row[k]);
        let mean = all().sum::<f64>() / n;
        let spread = (all().map(|x| (x - mean).powi(2)).sum::<f64>() / (n - 1.0).max(1.0)).sqrt();
        let least = all().fold(f64::INFINITY, f64::min);
        let most = all().fold(0.0, f64::max);
        println!("{name}: mean {mean:.1}, standard deviation {spread:.1}, {least:.1} to {most:.1}");
    }
    let mean = found.iter().map(|row| row[0]).sum::<f64>() / n;
    println!(
        "{DATA_SET} rooms: {:.0} CPU hours",
        mean * DATA_SET / 3600.0
    );
}
