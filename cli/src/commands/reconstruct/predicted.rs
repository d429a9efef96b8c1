//! `picofarm reconstruct --spots-from predictions`: times and masks from networks that see a single
//! histogram of all spots (Shoot-Bounce-3D, appendices C and E). No ground truth is used: the input
//! is the histogram and the positions of the spots.

use picofarm_model::{Model, ModelError, cpu, input::Target, masks, scene};
use picofarm_reconstruct::{
    Measured,
    source::{self, CaptureSettings, Given, Times},
};
use picofarm_scene::Scene;
use picofarm_store::published::Manifest as _;
use picofarm_tasks::slant;
use picofarm_transient::{Gate, Rendered, render};
use serde_json::{Value, json};

use super::{fits_memory, flash::AllSpots, refused, watch::Watch};
use crate::{
    args::{GateArgs, Reconstruct},
    commands::{
        dataset::failed,
        model::{WEIGHTS, open},
    },
    error::{CliError, Code, Result},
    signals,
};

/// The networks in use.
pub struct Networks {
    tof: Member,
    shadow: Member,
    specular: Option<Member>,
    gate: Gate,
}

struct Member {
    name: String,
    manifest_sha256: String,
    model: Model,
}

/// Reads the models. Each must predict the quantity of its option, take the same histograms, and
/// fit the images and beams.
///
/// # Errors
/// Fails if a model does not exist or does not fit. The error names the option.
pub async fn read(args: &Reconstruct, beams: usize) -> Result<Networks> {
    let given = &args.networks;
    let needed = |option: &str, value: &Option<String>| {
        value.clone().ok_or_else(|| {
            CliError::input(format!("--spots-from predictions needs {option}")).hint(
                "--models STORE --tof NAME --shadow NAME; `picofarm model list STORE` shows the models that a store keeps",
            )
        })
    };
    let store = needed("--models", &given.models)?;
    let tof = needed("--tof", &given.tof)?;
    let shadow = needed("--shadow", &given.shadow)?;
    let mut wanted = vec![
        ("--tof", tof, Target::Tof),
        ("--shadow", shadow, Target::Shadow),
    ];
    if let Some(name) = &given.specular {
        wanted.push(("--specular", name.clone(), Target::Specular));
    }
    let models = open(&store)?;
    let (mut found, mut gates) = (Vec::new(), Vec::new());
    for (option, name, target) in wanted {
        let wrong = |what: String| CliError::input(format!("{option} {name}: {what}"));
        let manifest = models.manifest(&name).await.map_err(failed)?;
        if manifest.kind != target.name() {
            return Err(wrong(format!(
                "predicts {:?}, expected a model of {:?}",
                manifest.kind,
                target.name()
            )));
        }
        let (knows, multiple) = picofarm_tasks::takes(&manifest).map_err(&wrong)?;
        let sides = [args.resolution.width, args.resolution.height];
        if !sides.iter().all(|side| side.is_multiple_of(multiple)) {
            return Err(wrong(format!(
                "takes images whose sides are multiples of {multiple}, --resolution is {}",
                args.resolution
            )));
        }
        let weights = models.read(&manifest, WEIGHTS).await.map_err(failed)?;
        let model = Model::read(&weights, &cpu()).map_err(|e| wrong(e.to_string()))?;
        let spots = model.question().spots;
        if spots > 0 && spots != beams {
            return Err(wrong(format!(
                "was trained on histograms of {spots} spots, the scene has {beams} beams; \
                 `picofarm scene export --spots {spots}` gives it others"
            )));
        }
        gates.push((option, knows));
        found.push(Member {
            name,
            manifest_sha256: manifest.sha256(),
            model,
        });
    }
    let (_, knows) = gates[0];
    let shown = |g: &Gate| {
        format!(
            "{} bins of {} m from {} m",
            g.bins, g.bin_width_m, g.start_m
        )
    };
    if let Some((option, other)) = gates.iter().find(|(_, g)| *g != knows) {
        return Err(CliError::input(format!(
            "{option} knows histograms of {}, --tof of {}; choose models that were trained on the same",
            shown(other),
            shown(&knows)
        )));
    }
    let asked = args.gate.gate();
    if asked != knows && args.gate != GateArgs::USUAL {
        return Err(CliError::input(format!(
            "the models know histograms of {}, asked for are {}; leave --gate-start-m, --bin-width-m and --bins out",
            shown(&knows),
            shown(&asked)
        )));
    }
    let mut found = found.into_iter();
    let (Some(tof), Some(shadow)) = (found.next(), found.next()) else {
        unreachable!("both were read");
    };
    Ok(Networks {
        tof,
        shadow,
        specular: found.next(),
        gate: knows,
    })
}

/// Renders the histogram and runs the networks. Returns the measurements, and the quality of the
/// predictions for metrics.json.
///
/// # Errors
/// Fails on a failed render, unsuitable models, or an interruption.
pub fn measure(
    args: &Reconstruct,
    scene: &Scene,
    networks: &Networks,
    threads: usize,
    watch: &Watch,
) -> Result<(Measured, Value)> {
    let settings = CaptureSettings {
        gate: networks.gate,
        samples: args.samples,
        seed: args.seed,
        sensor: None,
    };
    fits_memory(&settings, scene, threads)?;
    let rendered = render(scene, &settings.render_settings(), &AllSpots(watch))
        .map_err(|e| refused(e.into()))?;
    let mut shown = seen(scene, &rendered);
    let failed = |member: &Member, e: ModelError| {
        CliError::new(Code::Failed, format!("model {:?}: {e}", member.name))
    };
    let tof = &networks.tof;
    let depth = tof.model.depth_m(&shown).map_err(|e| failed(tof, e))?;
    shown.seen_depth_m = Some(depth.clone());
    let ask = |member: &Member| -> Result<Vec<u8>> {
        let mut tell = |done: usize, of: usize| {
            watch.step(
                &format!("{} {done} of {of}", member.name),
                done as f32 / of as f32,
            )
        };
        masks(&member.model, &shown, &mut tell)
            .map_err(|e| failed(member, e))?
            .map(|said| said.into_iter().map(|p| u8::from(p >= 128)).collect())
            .ok_or_else(|| signals::interrupted("nothing was written"))
    };
    let lit = ask(&networks.shadow)?;
    let mirror = match &networks.specular {
        Some(member) => ask(member)?,
        None => vec![0; depth.len()],
    };
    let range: Vec<f32> = (0..depth.len())
        .map(|p| depth[p] * slant(&scene.camera, p))
        .collect();
    let spots: Vec<_> = rendered
        .spots
        .iter()
        .map(|s| s.as_ref().map(|s| (s.point, s.path_m)))
        .collect();
    let beams: Vec<u32> = (0..spots.len() as u32).collect();
    let measured = source::given(&Given {
        camera: scene.camera,
        laser: scene.laser.origin,
        spots: &spots,
        beams: &beams,
        times: Times::Range(&range),
        lit: &lit,
        mirror: &mirror,
    })
    .map_err(refused)?;
    let named = |m: &Member| json!({"name": m.name, "manifest_sha256": m.manifest_sha256});
    let facts = json!({
        "models": {
            "tof": named(&networks.tof), "shadow": named(&networks.shadow),
            "specular": networks.specular.as_ref().map(named),
        },
        "depth_mae_m": depth_error(&depth, &rendered),
        "lit_iou": iou(&lit, &rendered.truth.visibility),
        "lit_share": share(&rendered.truth.visibility),
    });
    Ok((measured, facts))
}

/// Returns the scene as a network's input, with no ground truth except the spots.
fn seen(scene: &Scene, rendered: &Rendered) -> scene::Scene {
    let i = &scene.camera.intrinsics;
    let pixels = (i.width * i.height) as usize;
    let spots = rendered.spots.iter();
    scene::Scene {
        seen_depth_m: None,
        evidence: Vec::new(),
        height: i.height as usize,
        width: i.width as usize,
        bins: rendered.gate.bins as usize,
        first_m: rendered.gate.start_m,
        bin_width_m: rendered.gate.bin_width_m,
        histogram: rendered.transient.clone(),
        order: scene::Order::Pixels,
        depth_m: vec![f32::INFINITY; pixels],
        specular: vec![0; pixels],
        lit: vec![0; pixels * rendered.spots.len()],
        spots: spots
            .clone()
            .map(|s| {
                let place = |s: &picofarm_scene::Spot| scene.camera.to_camera(s.point).into();
                s.as_ref().map_or([f32::NAN; 3], place)
            })
            .collect(),
        beams_m: spots
            .map(|s| s.as_ref().map_or(f32::NAN, |s| s.path_m))
            .collect(),
        intrinsics: [i.fx, i.fy, i.cx, i.cy].map(f64::from),
    }
}

/// Returns the mean error of z-depth over the pixels with a surface, in metres.
fn depth_error(depth: &[f32], rendered: &Rendered) -> f64 {
    let there = rendered
        .truth
        .depth
        .iter()
        .zip(depth)
        .filter(|(z, _)| **z > 0.0);
    let (sum, n) = there.fold((0.0, 0usize), |(sum, n), (z, found)| {
        (sum + f64::from((z - found).abs()), n + 1)
    });
    sum / n.max(1) as f64
}

/// Returns the intersection over union of the lit pixels; 1 if no pixel is lit and none is
/// predicted.
fn iou(said: &[u8], truth: &[u8]) -> f64 {
    let pairs = || said.iter().zip(truth).map(|(a, b)| (*a != 0, *b != 0));
    let both = pairs().filter(|(a, b)| *a && *b).count();
    let either = pairs().filter(|(a, b)| *a || *b).count();
    match either {
        0 => 1.0,
        _ => both as f64 / either as f64,
    }
}

fn share(mask: &[u8]) -> f64 {
    mask.iter().filter(|m| **m != 0).count() as f64 / mask.len().max(1) as f64
}
