//! A render ends when it is asked to stop, and when its time is over.

use std::sync::atomic::{AtomicU64, Ordering};

use picofarm_scene::{
    AssetLibrary,
    furnished::{self, FurnishedSettings},
};
use picofarm_settings::Spots;
use picofarm_transient::{
    Budget, Gate, Progress, RenderError, Rendered, Settings, Strategy, render, render_within,
};

/// Counts the progress calls, and requests a stop from the call `stop_at` on.
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
    let gate = Gate {
        start_m: 1.0,
        bin_width_m: 0.384,
        bins: 64,
    };
    Settings {
        one_bounce: true,
        seed: 7,
        strategy: Strategy {
            caustics: Some(true),
            ellipsoidal: Some(true),
            ..Strategy::default()
        },
        ..Settings::new(gate, budget)
    }
}

#[test]
fn a_render_stops_within_a_few_questions_wherever_it_is() {
    let library = AssetLibrary::find("parametric", &[]).unwrap();
    let side = 48;
    let room = FurnishedSettings {
        spots: Spots::Grid(4),
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
        // Each row of the centres' hits, of each spot's visibility and of the picture; each pixel
        // of the tiles.
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
            // Rows and tiles that other threads have begun each make one call.
            let more = asked.times() - at;
            assert!(
                more < 4 * u64::from(side),
                "asked {more} times after the {at}th"
            );
            at += 1 + at / 3;
        }
    }
}

/// Renders with a clock that advances by a second per reading.
fn within(seconds: u64, budget: Budget) -> Rendered {
    let library = AssetLibrary::find("parametric", &[]).unwrap();
    let room = FurnishedSettings {
        spots: Spots::Grid(4),
        width: 16,
        height: 16,
        ..FurnishedSettings::default()
    };
    let scene = furnished::generate(5, &room, &library).unwrap();
    let looks = AtomicU64::new(0);
    let left = || seconds as f64 - looks.fetch_add(1, Ordering::Relaxed) as f64;
    render_within(&scene, &settings(budget), &left, &Asked::until(u64::MAX)).unwrap()
}

#[test]
fn a_render_bound_in_time_uses_what_there_is_and_states_the_error_reached() {
    let budget = Budget::Samples(1 << 20);
    let (short, long) = (within(1, budget), within(6, budget));
    assert_eq!(short.error.samples, 2);
    // Rounds of one second each, of up to three times the passes of all before: 2, 6, 24.
    assert!(long.error.samples >= 8, "{}", long.error.samples);
    assert!(long.error.median_relative < 0.8 * short.error.median_relative);
    assert_eq!(long.transient, within(6, budget).transient);
}

#[test]
fn a_render_bound_in_time_ends_sooner_where_its_error_or_its_samples_are_reached() {
    assert_eq!(within(1000, Budget::Samples(21)).error.samples, 21);
    let r = within(1000, Budget::Error(0.3));
    assert!(r.error.median_relative <= 0.3, "{:?}", r.error);
    assert!(r.error.samples < 1000, "{:?}", r.error);
}

#[test]
fn the_last_round_of_a_render_to_an_error_leaves_the_error_as_well_known_as_a_single_one() {
    let library = AssetLibrary::find("parametric", &[]).unwrap();
    let room = FurnishedSettings {
        spots: Spots::Grid(16),
        width: 24,
        height: 24,
        ..FurnishedSettings::default()
    };
    let scene = furnished::generate(8, &room, &library).unwrap();
    let wide = |budget| Settings {
        strategy: Strategy::default(),
        ..settings(budget)
    };
    let mut ends = vec![];
    for k in 0..40 {
        let error = |budget| {
            let found = render(&scene, &wide(budget), &Asked::until(u64::MAX));
            found.unwrap().error
        };
        let r = error(Budget::Error(0.06 + 0.0025 * f64::from(k)));
        ends.push(r.samples);
        let single = error(Budget::Samples(r.samples));
        let (pixels, whole) = (
            r.median_relative / single.median_relative,
            r.total_relative / single.total_relative,
        );
        assert!((pixels - 1.0).abs() < 0.15, "{r:?}: {pixels}");
        assert!((whole - 1.0).abs() < 0.3, "{r:?}: {whole}");
    }
    ends.dedup();
    assert!(ends.len() > 6, "{ends:?}");
}
