//! Measures how the time to a given error grows with triangles, spots, bins and pixels. The error
//! is the renderer's own estimate; the ladders show how accurate it is.

use picofarm_scene::Scene;
use picofarm_transient::{Budget, Gate};
use serde::Serialize;
use tokio_util::sync::CancellationToken;

use crate::args::Render as RenderArgs;
use picofarm_cli::{error::Result, output::Output};

use super::{
    curve::{exponent, three_digits},
    measure::{Bench, settings},
    scenes::{load, resize, with_spots},
    tessellate::quadruple,
};

/// The sizes to measure.
struct Sizes {
    pixels: u32,
    most_triangles: usize,
    spots: &'static [u32],
    bins: &'static [u32],
    resolutions: &'static [u32],
}

const FULL: Sizes = Sizes {
    pixels: 256,
    most_triangles: 1_500_000,
    spots: &[1, 4, 25, 100],
    bins: &[159, 318, 637, 1274, 2548],
    resolutions: &[64, 128, 256, 512],
};

const QUICK: Sizes = Sizes {
    pixels: 32,
    most_triangles: 250_000,
    spots: &[1, 4, 25],
    bins: &[159, 637],
    resolutions: &[16, 32, 64],
};

/// Results of the measurement.
#[derive(Debug, Serialize)]
pub struct Scaling {
    pub scene: String,
    pub target: f64,
    pub threads: usize,
    pub base: Size,
    pub axes: Vec<Axis>,
}

/// Growth along one axis, with all other sizes as in the base.
#[derive(Debug, Serialize)]
pub struct Axis {
    pub name: &'static str,
    pub points: Vec<Point>,
    /// k of CPU seconds ~ size^k.
    pub exponent: Option<f64>,
}

/// One size along an axis.
#[derive(Debug, Serialize)]
pub struct Point {
    pub at: u64,
    #[serde(flatten)]
    pub size: Size,
}

/// One render to the target.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Size {
    /// Width and height.
    pub pixels: u32,
    pub bins: u32,
    pub spots: usize,
    pub triangles: usize,
    pub cpu_s: f64,
    pub wall_s: f64,
    pub samples: u32,
    pub claimed: f64,
    pub rays: u64,
}

/// Measures the growth for the first scene that the arguments name.
///
/// # Errors
/// Fails if the renderer rejects the scene, or on an interruption.
pub fn run(args: &RenderArgs, output: Output, stop: &CancellationToken) -> Result<Scaling> {
    let sizes = if args.quick { &QUICK } else { &FULL };
    let mut scene = load(&args.scenes[0], args)?;
    let pixels = args.resolution.unwrap_or(sizes.pixels);
    resize(&mut scene, pixels);
    let study = Study {
        bench: Bench::new(Some(args.threads), output, stop)?,
        output,
        args,
    };
    let base = study.size(&scene, args.gate.bins, "base")?;
    let scale = |n: u32| (n * pixels / sizes.pixels).max(1);
    let resolutions: Vec<u32> = sizes.resolutions.iter().map(|&n| scale(n)).collect();
    let axes = vec![
        study.triangles(&scene, base, sizes.most_triangles)?,
        study.spots(&scene, base, sizes.spots)?,
        study.bins(&scene, base, sizes.bins)?,
        study.pixels(&scene, base, &resolutions)?,
    ];
    Ok(Scaling {
        scene: scene.name,
        target: args.error[0],
        threads: args.threads.max(1),
        base,
        axes,
    })
}

struct Study<'a> {
    bench: Bench<'a>,
    output: Output,
    args: &'a RenderArgs,
}

impl Study<'_> {
    fn size(&self, scene: &Scene, bins: u32, what: &str) -> Result<Size> {
        let target = self.args.error[0];
        let mut settings = settings(self.args, Budget::Error(target), 1);
        settings.gate = with_bins(settings.gate, bins);
        let what = format!("{}: {what}, until {} %", scene.name, target * 100.0);
        let measured = self.bench.render(scene, &settings, &what)?;
        let r = &measured.rendered;
        // A full study takes long, so each result is shown at once.
        let cpu = three_digits(measured.cpu_s);
        self.output.say(format!("{what}: {cpu} CPU s"));
        Ok(Size {
            pixels: r.width,
            bins,
            spots: scene.laser.beams.len(),
            triangles: scene.triangle_count(),
            cpu_s: measured.cpu_s,
            wall_s: measured.wall_s,
            samples: r.error.samples,
            claimed: f64::from(r.error.median_relative),
            rays: r.rays,
        })
    }

    fn triangles(&self, scene: &Scene, base: Size, most: usize) -> Result<Axis> {
        let mut points = vec![(base.triangles as u64, base)];
        let mut scene = scene.clone();
        while scene.triangle_count() * 4 <= most {
            quadruple(&mut scene);
            let count = scene.triangle_count();
            let size = self.size(&scene, base.bins, &format!("{count} triangles"))?;
            points.push((count as u64, size));
        }
        Ok(axis("triangles", points))
    }

    fn spots(&self, scene: &Scene, base: Size, spots: &[u32]) -> Result<Axis> {
        let mut points = vec![];
        for &n in spots {
            let mut scene = scene.clone();
            with_spots(&mut scene, n)?;
            let size = match n as usize == base.spots {
                true => base,
                false => self.size(&scene, base.bins, &format!("{n} spots"))?,
            };
            points.push((u64::from(n), size));
        }
        Ok(axis("spots", points))
    }

    fn bins(&self, scene: &Scene, base: Size, bins: &[u32]) -> Result<Axis> {
        let mut points = vec![];
        for &n in bins {
            let size = match n == base.bins {
                true => base,
                false => self.size(scene, n, &format!("{n} bins"))?,
            };
            points.push((u64::from(n), size));
        }
        Ok(axis("bins", points))
    }

    fn pixels(&self, scene: &Scene, base: Size, resolutions: &[u32]) -> Result<Axis> {
        let mut points = vec![];
        for &n in resolutions {
            let mut scene = scene.clone();
            resize(&mut scene, n);
            let size = match n == base.pixels {
                true => base,
                false => self.size(&scene, base.bins, &format!("{n}x{n} pixels"))?,
            };
            points.push((u64::from(n) * u64::from(n), size));
        }
        Ok(axis("pixels", points))
    }
}

/// Returns the same interval with another number of bins.
fn with_bins(gate: Gate, bins: u32) -> Gate {
    Gate {
        bin_width_m: gate.bin_width_m * f64::from(gate.bins) / f64::from(bins),
        bins,
        ..gate
    }
}

fn axis(name: &'static str, points: Vec<(u64, Size)>) -> Axis {
    let curve: Vec<_> = points.iter().map(|(at, s)| (*at as f64, s.cpu_s)).collect();
    Axis {
        name,
        exponent: exponent(&curve),
        points: points
            .into_iter()
            .map(|(at, size)| Point { at, size })
            .collect(),
    }
}
