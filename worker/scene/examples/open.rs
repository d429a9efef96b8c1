//! Reads each file named on the command line without any option and prints one line for it: what
//! it holds, or why it is refused. The last line counts both.
//!
//! ```sh
//! find models -name '*.gl*' | xargs cargo run --release -p picofarm-scene --example open
//! ```

use std::{path::PathBuf, time::Instant};

use picofarm_scene::import::{Bounds, ImportOptions, read_scene_with};

fn main() {
    let (mut opened, mut refused) = (0, 0);
    let bounds = Bounds {
        root: Some("/".into()),
        ..Bounds::default()
    };
    for path in std::env::args_os().skip(1).map(PathBuf::from) {
        let start = Instant::now();
        match read_scene_with(&path, &ImportOptions::default(), &bounds) {
            Ok(scene) => {
                opened += 1;
                let notes: Vec<&str> = scene.provenance.notes.keys().map(String::as_str).collect();
                println!(
                    "opened  {}: {} objects, {} triangles, {:.1} s; {}",
                    path.display(),
                    scene.objects.len(),
                    scene.triangle_count(),
                    start.elapsed().as_secs_f64(),
                    notes.join(" ")
                );
            }
            Err(error) => {
                refused += 1;
                println!("refused {error}");
            }
        }
    }
    println!("{opened} opened, {refused} refused");
}
