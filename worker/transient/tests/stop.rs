//! A render that is asked to stop does so wherever it is.

use std::sync::atomic::{AtomicU64, Ordering};

use picofarm_scene::{
    AssetLibrary,
    furnished::{self, FurnishedSettings},
};
use picofarm_transient::{Budget, Gate, Progress, RenderError, Settings, Strategy, render};

/// Counts how often it is asked, and says stop from one of them on.
struct Asked {
    times: AtomicU64,
    stop_at: u64,
}

impl Asked {
    fn until(stop_at: u64) -> Self {
        Self {
            times: AtomicU64::new(0),
            stop_at,
        }
    }

    fn times(&self) -> u64 {
        self.times.load(Ordering::Relaxed)
    }
}

impl Progress for Asked {
    fn at(&self, _: f32) -> bool {
        self.times.fetch_add(1, Ordering::Relaxed) < self.stop_at
    }
}

fn settings(budget: Budget) -> Settings {
    Settings {
        gate: Gate {
            start_m: 1.0,
            bin_width_m: 0.384,
            bins: 64,
        },
        budget,
        max_bounces: None,
        one_bounce: true,
        seed: 7,
        split: false,
        groups: vec![],
        strategy: Strategy {
            caustics: Some(true),
            ellipsoidal: Some(true),
            ..Strategy::default()
        },
    }
}

#[test]
fn a_render_stops_within_a_few_questions_wherever_it_is() {
    let library = AssetLibrary::find("parametric", &[]).unwrap();
    let side = 48;
    let room = FurnishedSettings {
        spots: 4,
        width: side,
        height: side,
        ..FurnishedSettings::default()
    };
    let scene = furnished::generate(5, &room, &library).unwrap();
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(2)
        .build()
        .unwrap();
    for budget in [Budget::Samples(4), Budget::Error(0.3)] {
        let settings = settings(budget);
        let run = |asked: &Asked| pool.install(|| render(&scene, &settings, asked).map(|_| ()));
        let whole = Asked::until(u64::MAX);
        run(&whole).unwrap();
        // Each row of what the centres see, of each spot's visibility and of the picture; each pixel of the tiles.
        let rows = u64::from(side) * (1 + 4 + 1);
        let all = whole.times();
        assert!(all > rows + u64::from(side * side), "{all}");
        let mut at = 0;
        while at < all {
            let asked = Asked::until(at);
            let ended = run(&asked);
            assert!(
                matches!(ended, Err(RenderError::Stopped)),
                "{at} of {all}: {ended:?}"
            );
            // Rows and tiles that others have begun each ask once.
            let more = asked.times() - at;
            assert!(
                more < 4 * u64::from(side),
                "asked {more} times after the {at}th"
            );
            at += 1 + at / 3;
        }
    }
}
