//! Rendered rooms, each spot alone, counted by a sensor: captures whose calibration is known.
#![allow(dead_code, reason = "each user takes its part")]

use picofarm_demultiplex::{Capture, Place, Spot};
use picofarm_scene::{AssetLibrary, Camera, Vec3, furnished};
use picofarm_sensor::{Histograms, PS_PER_M, Scale, Sensor, Values, sense};
use picofarm_settings::Spots;
use picofarm_transient::{self as transient, Budget, Gate, Progress};

struct Unstopped;

impl Progress for Unstopped {
    fn at(&self, _: f32) -> bool {
        true
    }
}

/// Bins of the render in a bin of the capture: light arrives within a bin, not in its middle.
const FINE: u32 = 4;
/// The capture's gate.
pub const GATE: Gate = Gate {
    start_m: 1.0,
    bin_width_m: 0.0384,
    bins: 400,
};

/// A rendered room.
#[derive(Clone)]
pub struct Room {
    /// The gate of `light`.
    pub gate: Gate,
    pub camera: Camera,
    pub laser: Vec3,
    pub directions: Vec<Vec3>,
    pub places: Vec<Place>,
    /// `[spot][row][column][fine bin]`.
    pub light: Vec<Vec<f32>>,
    pub depth: Vec<f32>,
    pub range: Vec<f32>,
    pub specular: Vec<u8>,
    pub visibility: Vec<u8>,
}

impl Room {
    /// Renders the furnished room of a seed with 16 spots and a laser 0.257 m to the right of the
    /// camera.
    pub fn new(seed: u64, side: u32, mirrors: u32) -> Self {
        let fine = Gate {
            bin_width_m: GATE.bin_width_m / f64::from(FINE),
            bins: GATE.bins * FINE,
            ..GATE
        };
        Self::in_gate(seed, side, mirrors, 16, fine)
    }

    /// The same with this number of spots, in the bins of this gate.
    pub fn in_gate(seed: u64, side: u32, mirrors: u32, spots: u32, gate: Gate) -> Self {
        let settings = furnished::FurnishedSettings {
            spots: Spots::Grid(spots),
            laser_m: [0.257, 0.0, 0.0],
            width: side,
            height: side,
            specular_at_least: mirrors,
            ..Default::default()
        };
        let library = AssetLibrary::find("parametric", &[]).expect("built in");
        let scene = furnished::generate(seed, &settings, &library).expect("a room");
        let settings = transient::Settings {
            one_bounce: true,
            seed,
            groups: (0..spots).map(|k| vec![k]).collect(),
            ..transient::Settings::new(gate, Budget::Samples(16))
        };
        let made = transient::render(&scene, &settings, &Unstopped).expect("a render");
        let places = made.spots.iter().map(|s| {
            let s = s.as_ref().expect("the beam meets a wall");
            Place {
                point: s.point,
                path_m: s.path_m,
            }
        });
        Self {
            gate,
            camera: scene.camera,
            laser: scene.laser.origin,
            directions: scene.laser.beams.iter().map(|b| b.direction).collect(),
            places: places.collect(),
            light: made.groups,
            depth: made.truth.depth,
            range: made.truth.range,
            specular: made.truth.specular,
            visibility: made.truth.visibility,
        }
    }

    /// What a sensor counts; `photons` is the brightest bin of the median pixel for one spot.
    pub fn measure(&self, photons: f64, seed: u64, change: impl Fn(&mut Sensor)) -> Capturing {
        self.measure_in(FINE, photons, seed, change)
    }

    /// The same with this number of the render's bins in a bin of the capture. `photons` are those
    /// of the brightest such bin.
    pub fn measure_in(
        &self,
        rebin: u32,
        photons: f64,
        seed: u64,
        change: impl Fn(&mut Sensor),
    ) -> Capturing {
        let mut per_spot = Vec::new();
        let bins = self.gate.bins as usize;
        // One scale for all spots: that of the first.
        let mut tops: Vec<f32> = self.light[0]
            .chunks(bins)
            .map(|h| {
                let sums = h.chunks(rebin as usize).map(|b| b.iter().sum::<f32>());
                sums.fold(0.0, f32::max)
            })
            .collect();
        tops.sort_by(f32::total_cmp);
        let scale = photons / f64::from(tops[tops.len() / 2]);
        for (k, light) in self.light.iter().enumerate() {
            let mut sensor = Sensor {
                scale: Scale::Fixed {
                    photons_per_unit: scale,
                },
                rebin,
                ..Sensor::default()
            };
            change(&mut sensor);
            let light = Histograms {
                transient: light,
                two_bounce: None,
                bins,
                bin_width_ps: self.gate.bin_width_m * PS_PER_M,
            };
            let sensed = sense(&sensor, &light, seed, k as u64).expect("light");
            match sensed.values {
                Values::Counts(all) => per_spot.extend(all.iter().map(|c| *c as f32)),
                Values::Rate(all) => per_spot.extend(all),
            }
        }
        let gate = Gate {
            bin_width_m: self.gate.bin_width_m * f64::from(rebin),
            bins: self.gate.bins / rebin,
            ..self.gate
        };
        Capturing::new(self, gate, per_spot)
    }
}

/// A capture with a calibration that a test may disturb.
#[derive(Clone)]
pub struct Capturing {
    pub camera: Camera,
    pub gate: Gate,
    pub laser: Vec3,
    pub spots: Vec<Spot>,
    pub sum: Vec<f32>,
    pub per_spot: Vec<f32>,
}

impl Capturing {
    fn new(room: &Room, gate: Gate, per_spot: Vec<f32>) -> Self {
        let spots = room.places.iter().zip(&room.directions);
        let mut made = Self {
            camera: room.camera,
            gate,
            laser: room.laser,
            spots: spots
                .map(|(place, direction)| Spot {
                    direction: *direction,
                    place: Some(*place),
                })
                .collect(),
            sum: Vec::new(),
            per_spot,
        };
        made.add_up();
        made
    }

    /// Adds the histograms of all spots up.
    pub fn add_up(&mut self) {
        let cells = self.per_spot.len() / self.spots.len();
        self.sum = vec![0.0; cells];
        for h in self.per_spot.chunks(cells) {
            self.sum.iter_mut().zip(h).for_each(|(s, x)| *s += x);
        }
    }

    pub fn capture(&self) -> Capture<'_> {
        Capture {
            histogram: &self.sum,
            gate: self.gate,
            camera: &self.camera,
            laser: self.laser,
            spots: &self.spots,
        }
    }
}

/// A disturbed capture: its name, itself, stated masks.
pub type Disturbed = (&'static str, Capturing, Vec<u8>);

/// Everything wrong that is tried, as far as it is wanted by name.
pub fn faults(room: &Room, plain: &Capturing, wanted: impl Fn(&str) -> bool) -> Vec<Disturbed> {
    let side = room.camera.intrinsics.width as usize;
    let pixels = side * side;
    let bins = GATE.bins as usize;
    let masks = room.visibility.clone();
    let mut all: Vec<Disturbed> = Vec::new();
    let mut add = |name, change: &dyn Fn(&mut Capturing)| {
        if !wanted(name) {
            return;
        }
        let mut made = plain.clone();
        change(&mut made);
        made.add_up();
        all.push((name, made, masks.clone()));
    };
    let laser = |c: &mut Capturing, by: f32| {
        let stated = c.laser;
        c.laser += c.camera.right * by;
        for place in c.spots.iter_mut().filter_map(|s| s.place.as_mut()) {
            place.path_m += (place.point - c.laser).length() - (place.point - stated).length();
        }
    };
    add("nothing", &|_| {});
    add("t0 1 bin late", &|c| c.gate.start_m += GATE.bin_width_m);
    add("t0 5 bins early", &|c| {
        c.gate.start_m -= 5.0 * GATE.bin_width_m
    });
    add("laser 1 cm right", &|c| laser(c, 0.01));
    add("laser 10 cm right", &|c| laser(c, 0.10));
    add("laser 1 cm right, t0 1 bin late", &|c| {
        laser(c, 0.01);
        c.gate.start_m += GATE.bin_width_m;
    });
    add("only directions", &|c| {
        c.spots.iter_mut().for_each(|s| s.place = None)
    });
    add("only directions, t0 1 bin late", &|c| {
        c.spots.iter_mut().for_each(|s| s.place = None);
        c.gate.start_m += GATE.bin_width_m;
    });
    add("only directions, laser 1 cm right", &|c| {
        c.spots.iter_mut().for_each(|s| s.place = None);
        laser(c, 0.01);
    });
    add("two spots swapped", &|c| c.spots.swap(3, 9));
    add("spots shifted by one", &|c| c.spots.rotate_left(1));
    add("spot 5 moved 10 cm", &|c| {
        let laser = c.laser;
        let down = c.camera.down;
        if let Some(place) = c.spots[5].place.as_mut() {
            place.point += down * 0.1;
            place.path_m = (place.point - laser).length();
        }
    });
    let turned = |c: &mut Capturing, map: &dyn Fn(usize, usize) -> (usize, usize)| {
        let from = c.per_spot.clone();
        for k in 0..c.spots.len() {
            for p in 0..pixels {
                let (u, v) = map(p % side, p / side);
                let (a, b) = ((k * pixels + p) * bins, (k * pixels + v * side + u) * bins);
                c.per_spot[b..b + bins].copy_from_slice(&from[a..a + bins]);
            }
        }
    };
    add("mirrored in x", &|c| turned(c, &|u, v| (side - 1 - u, v)));
    add("mirrored in y", &|c| turned(c, &|u, v| (u, side - 1 - v)));
    add("transposed", &|c| turned(c, &|u, v| (v, u)));
    add("one way for there and back", &|c| {
        c.gate.start_m *= 0.5;
        c.gate.bin_width_m *= 0.5;
    });
    add("bins 2 % too wide", &|c| c.gate.bin_width_m *= 1.02);
    add("view 80 instead of 90 degrees", &|c| {
        let side = side as u32;
        c.camera.intrinsics = picofarm_scene::Intrinsics::from_fov(80.0, side, side);
    });
    add("half of the pixels dead", &|c| {
        for (n, h) in c.per_spot.chunks_mut(bins).enumerate() {
            if (n % pixels).is_multiple_of(2) {
                h.fill(0.0);
            }
        }
    });
    add("20 hot pixels", &|c| {
        for (n, h) in c.per_spot.chunks_mut(bins).enumerate() {
            let p = n % pixels;
            if p % (pixels / 20) == 5 {
                h.iter_mut()
                    .enumerate()
                    .for_each(|(b, x)| *x += 40.0 + ((n + b) * 31 % 11) as f32);
            }
        }
    });
    add("counts clipped at 127", &|c| {
        c.per_spot.iter_mut().for_each(|x| *x = x.min(127.0))
    });
    if wanted("masks shifted by one") {
        let mut rolled = masks.clone();
        rolled.rotate_left(pixels);
        all.push(("masks shifted by one", plain.clone(), rolled));
    }
    if wanted("background of 4 counts a bin") {
        let dark = room.measure(100.0, 1, |s| s.dark_per_bin = 1.0);
        all.push(("background of 4 counts a bin", dark, masks.clone()));
    }
    if wanted("pile-up") {
        let dead_time = Some(picofarm_sensor::DeadTime::FirstPhoton { pulses: 2000 });
        let piled = room.measure(100.0, 1, |s| s.dead_time = dead_time);
        all.push(("pile-up", piled, masks));
    }
    all
}

/// Right and wrong calibrations of a capture, and captures without information: whether the stated
/// calibration is right, `None` if nothing can tell. Only histograms of each spot (`apart`) have an
/// order.
pub fn doubts(plain: &Capturing, apart: bool) -> Vec<(&'static str, Capturing, Option<bool>)> {
    let with = |change: &dyn Fn(&mut Capturing)| {
        let mut made = plain.clone();
        change(&mut made);
        made.add_up();
        made
    };
    let cells = plain.per_spot.len() / plain.spots.len();
    let bins = plain.gate.bins as usize;
    let side = plain.camera.intrinsics.width as usize;
    let mut all = vec![
        ("right", plain.clone(), Some(true)),
        (
            "t0 a bin late",
            with(&|c| c.gate.start_m += c.gate.bin_width_m.max(0.0384)),
            Some(false),
        ),
        (
            "laser 10 cm right",
            with(&|c| {
                let stated = c.laser;
                c.laser += c.camera.right * 0.1;
                for place in c.spots.iter_mut().filter_map(|s| s.place.as_mut()) {
                    let way = (place.point - c.laser).length() - (place.point - stated).length();
                    place.path_m += way;
                }
            }),
            Some(false),
        ),
        (
            "mirrored in x",
            with(&|c| {
                for rows in c.per_spot.chunks_mut(side * bins) {
                    for u in 0..side / 2 {
                        let (left, right) = rows.split_at_mut((side - 1 - u) * bins);
                        left[u * bins..][..bins].swap_with_slice(&mut right[..bins]);
                    }
                }
            }),
            Some(false),
        ),
        (
            "pure noise",
            with(&|c| {
                let mut state = 1u64;
                for x in &mut c.per_spot {
                    state = state
                        .wrapping_mul(6_364_136_223_846_793_005)
                        .wrapping_add(1);
                    *x = ((state >> 62) as f32) * (state >> 40 & 3) as f32;
                }
            }),
            None,
        ),
        ("dark", with(&|c| c.per_spot.fill(0.0)), None),
    ];
    if plain.spots.len() > 1 && apart {
        all.push(("spots swapped", with(&|c| c.spots.swap(0, 1)), Some(false)));
        all.push((
            "two equal files",
            with(&|c| c.per_spot.copy_within(0..cells, cells)),
            Some(false),
        ));
    }
    all
}
