//! `just lab model`: measures the time of a training step, and compares it with other forms
//! and programs in the same run.

use std::{
    fs,
    io::{BufRead, BufReader, Write},
    path::Path,
    process::{Child, ChildStdin, ChildStdout, Command, Stdio},
    time::Instant,
};

use picofarm_model::{
    ModelError,
    device::{self, Gpus},
    input::{Batch, Target},
    memory::RetainedMemory,
    net::{Architecture, NetSpec, Precision, StemForm, Swin, TimeProjection},
    train::Learner,
    trial::{Apart, Trial},
};
use serde::{Deserialize, Serialize};
use tokio_util::sync::CancellationToken;

use crate::args::{Kind, Learns, Model as ModelArgs, Numbers};
use picofarm_cli::{
    error::{CliError, Code, Result, io},
    output::{Output, bytes, table},
};

/// Number of AdamW steps in a record.
const RECORDED: usize = 20;

/// Results of the benchmark.
#[derive(Serialize)]
struct Report {
    trial: Trial,
    parameters: usize,
    /// Multiply-adds of a forward pass per sample, with one-hot channels counted as dense.
    multiply_adds: f64,
    threads: usize,
    /// Name of the GPU, if used; the number of threads is then irrelevant.
    gpu: Option<String>,
    forms: Vec<Form>,
    /// Maximum difference between the outputs of the gather and the dense form.
    forms_differ: Option<f64>,
    /// Deviation from the CPU in 32 bits: norm of the difference over the norm.
    from_cpu: Option<Apart>,
    /// Seconds of picofarm's first step. On a GPU, kernels are selected and compiled in it.
    first_step_s: f64,
}

/// One way to compute the step.
#[derive(Serialize)]
struct Form {
    name: String,
    /// Median over rounds, in seconds.
    step_s: f64,
    samples_per_s: f64,
    /// Median over rounds of this form's time divided by picofarm's: above 1, picofarm is faster.
    times_ours: f64,
    /// Maximum memory beyond that in use before; only for picofarm's own forms.
    peak_bytes: Option<u64>,
}

pub fn run(args: &ModelArgs, output: Output, stop: &CancellationToken) -> Result<()> {
    let trial = trial(args);
    let opened = match &args.gpu {
        Some(name) => {
            let named = Gpus::Named(vec![name.clone()]);
            device::open(&named).map_err(of_model)?.pop()
        }
        None => None,
    };
    let device = match &opened {
        Some(gpu) => gpu.device.clone(),
        None => picofarm_model::cpu(),
    };
    if let Some(path) = &args.record {
        let record = trial.record(RECORDED, &device).map_err(of_model)?;
        fs::write(path, record).map_err(|e| io(format!("--record {}", path.display()), &e))?;
        let wrote = serde_json::json!({ "record": path, "trial": trial });
        output.result(&wrote, || {
            format!(
                "wrote {}; python3 tests/lab/peers/model_torch.py parity {} compares",
                path.display(),
                path.display()
            )
        });
        return Ok(());
    }
    let mut peers = Vec::new();
    let folder = tempfile::tempdir().map_err(|e| io("a temporary folder", &e))?;
    if !args.peer.is_empty() {
        let path = folder.path().join("record.safetensors");
        let record = trial.record(0, &device).map_err(of_model)?;
        fs::write(&path, record).map_err(|e| io(path.display(), &e))?;
        for command in &args.peer {
            peers.push(Peer::start(command, &path)?);
        }
    }
    let mut forms: Vec<(String, Learner, Batch)> = Vec::new();
    let (learner, batch) = trial.begin(&device).map_err(of_model)?;
    let parameters = learner.parameters().learned();
    let mut forms_differ = None;
    let name = if trial.net.one_hot > 0 {
        "ours (gather)"
    } else {
        "ours"
    };
    if trial.net.one_hot > 0 && trial.net.architecture == Architecture::Unet2d {
        let (dense, wide) = trial.dense(&device).map_err(of_model)?;
        let (a, b) = (learner.predict(&batch), dense.predict(&wide));
        let differ = a.iter().zip(&b).map(|(a, b)| f64::from((a - b).abs()));
        forms_differ = Some(differ.fold(0.0, f64::max));
        forms.push((name.into(), learner, batch));
        forms.push(("ours (dense one-hot)".into(), dense, wide));
    } else {
        forms.push((name.into(), learner, batch));
    }
    let mut peaks = Vec::new();
    let mut first = Vec::new();
    for (_, learner, batch) in &mut forms {
        let before = reset_peak();
        let begun = Instant::now();
        learner
            .step(vec![batch.clone()], trial.pace())
            .map_err(of_model)?;
        learner.wait().map_err(of_driver)?;
        first.push(begun.elapsed().as_secs_f64());
        peaks.push(before.and_then(|b| Some(peak()?.saturating_sub(b))));
    }
    // As in a worker's training. Called only here, so that memory retained from earlier steps does
    // not hide the memory of one step.
    let _kept = RetainedMemory::from_now();
    for peer in &mut peers {
        peer.steps(1)?;
    }
    let mut seconds: Vec<Vec<f64>> = vec![Vec::new(); forms.len() + peers.len()];
    for round in 0..args.rounds {
        output.say(format!("round {} of {}", round + 1, args.rounds));
        for ((_, learner, batch), to) in forms.iter_mut().zip(&mut seconds) {
            // In a worker's training, its loader prepares the batches.
            let batches: Vec<Batch> = (0..args.steps).map(|_| batch.clone()).collect();
            let begun = Instant::now();
            learner
                .steps_along(batches, trial.pace())
                .map_err(of_model)?;
            learner.wait().map_err(of_driver)?;
            to.push(begun.elapsed().as_secs_f64() / args.steps as f64);
        }
        for (peer, to) in peers.iter_mut().zip(&mut seconds[forms.len()..]) {
            to.push(peer.steps(args.steps)? / args.steps as f64);
        }
        if stop.is_cancelled() {
            return Err(CliError::new(Code::Interrupted, "stopped"));
        }
    }
    let from_cpu = match args.compare {
        true => Some(trial.from_cpu(&device).map_err(of_model)?),
        false => None,
    };
    let names = forms.iter().map(|(name, ..)| name.clone());
    let names: Vec<String> = names.chain(peers.iter().map(|p| p.name.clone())).collect();
    let report = Report {
        parameters,
        multiply_adds: trial.net.multiply_adds(trial.side),
        threads: rayon::current_num_threads(),
        gpu: opened.map(|gpu| gpu.to_string()),
        forms: names
            .into_iter()
            .enumerate()
            .map(|(i, name)| {
                let step_s = median(&seconds[i]);
                let ratios: Vec<f64> = seconds[i]
                    .iter()
                    .zip(&seconds[0])
                    .map(|(a, b)| a / b)
                    .collect();
                Form {
                    name,
                    step_s,
                    samples_per_s: trial.batch as f64 / step_s,
                    times_ours: median(&ratios),
                    peak_bytes: peaks.get(i).copied().flatten(),
                }
            })
            .collect(),
        forms_differ,
        from_cpu,
        first_step_s: first[0],
        trial,
    };
    output.result(&report, || text(&report));
    Ok(())
}

fn trial(args: &ModelArgs) -> Trial {
    let target = match args.target {
        Learns::Tof => Target::Tof,
        Learns::Shadow => Target::Shadow,
        Learns::Specular => Target::Specular,
    };
    let dense = args.bins as usize;
    Trial {
        target,
        net: NetSpec {
            architecture: match args.net {
                Kind::Unet2d => Architecture::Unet2d,
                Kind::Unet25d => Architecture::Unet25d,
                Kind::Swinir => Architecture::Swinir,
                Kind::Embeddings => Architecture::Embeddings,
                Kind::Nlost => Architecture::Nlost,
            },
            dense,
            one_hot: if target == Target::Shadow { dense } else { 0 },
            outputs: 1,
            width: args.width as usize,
            levels: args.levels as usize,
            stem: args.stem as usize,
            stem_form: match args.linear_stem {
                false => StemForm::Block,
                true => StemForm::Linear,
            },
            time: args.time as usize,
            time_projection: match args.separate_streams {
                false => TimeProjection::Shared,
                true => TimeProjection::Each,
            },
            swin: Swin {
                groups: args.groups,
                depth: args.depth,
                heads: args.heads,
                window: args.window,
            },
            added: false,
            frozen: false,
            precision: match args.precision {
                Numbers::F32 => Precision::F32,
                Numbers::Bf16 => Precision::Bf16,
            },
        },
        batch: args.batch as usize,
        side: args.side as usize,
        learning_rate: 2e-4,
        decay: 1e-3,
        seed: 1,
    }
}

fn of_driver(what: String) -> CliError {
    CliError::new(Code::Failed, format!("the device failed: {what}"))
}

fn of_model(error: ModelError) -> CliError {
    CliError::input(error.to_string())
}

fn median(values: &[f64]) -> f64 {
    let mut values = values.to_vec();
    values.sort_by(f64::total_cmp);
    let mid = values.len() / 2;
    if values.len() % 2 == 1 {
        values[mid]
    } else {
        f64::midpoint(values[mid - 1], values[mid])
    }
}

fn text(report: &Report) -> String {
    let mut rows = vec![
        ["form", "step", "samples/s", "time ÷ ours", "peak memory"]
            .map(String::from)
            .to_vec(),
    ];
    for form in &report.forms {
        rows.push(vec![
            form.name.clone(),
            format!("{:.1} ms", 1e3 * form.step_s),
            format!("{:.2}", form.samples_per_s),
            format!("{:.2}", form.times_ours),
            form.peak_bytes.map_or_else(String::new, bytes),
        ]);
    }
    let mut out = format!("{} parameters", report.parameters);
    let macs = report.multiply_adds;
    let rate = 3.0 * macs * report.forms[0].samples_per_s / 1e9;
    out += &format!(
        ", {:.2} G multiply-adds a sample forward; ours: {rate:.0} G a second with both gradients",
        macs / 1e9
    );
    let on = match &report.gpu {
        Some(gpu) => gpu.clone(),
        None => format!("{} threads", report.threads),
    };
    out += &format!(", {on}\n\n{}", table(&rows));
    if report.gpu.is_some() {
        out += &format!(
            "\nfirst step of ours: {:.1} s (kernels are chosen and compiled in it)",
            report.first_step_s
        );
    }
    if let Some(apart) = report.from_cpu {
        out += &format!(
            "\nfrom the CPU in 32 bits: outputs {:.1e}, gradient {:.1e} (length of the difference over the length)",
            apart.output, apart.gradient
        );
    }
    if let Some(differ) = report.forms_differ {
        out += &format!("\nlargest difference between gather and dense form: {differ:.1e}");
    }
    out
}

/// Another program that performs steps on request.
struct Peer {
    name: String,
    child: Child,
    to: ChildStdin,
    from: BufReader<ChildStdout>,
}

#[derive(Deserialize)]
struct Hello {
    tool: String,
}

impl Peer {
    fn start(command: &str, record: &Path) -> Result<Self> {
        let mut words = command.split_whitespace();
        let failed = |what: String| {
            CliError::input(format!("--peer {command:?}: {what}"))
                .hint("for PyTorch: --peer \"python3 tests/lab/peers/model_torch.py bench\"")
        };
        let program = words.next().ok_or_else(|| failed("no command".into()))?;
        let mut child = Command::new(program)
            .args(words)
            .arg(record)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .map_err(|e| failed(e.to_string()))?;
        let to = child.stdin.take().expect("asked for");
        let from = BufReader::new(child.stdout.take().expect("asked for"));
        let mut peer = Self {
            name: String::new(),
            child,
            to,
            from,
        };
        let hello: Hello = serde_json::from_str(&peer.line().map_err(failed)?)
            .map_err(|e| failed(format!("it did not say its name: {e}")))?;
        peer.name = hello.tool;
        Ok(peer)
    }

    fn line(&mut self) -> std::result::Result<String, String> {
        let mut line = String::new();
        match self.from.read_line(&mut line) {
            Ok(0) => Err("it ended before it answered".into()),
            Ok(_) => Ok(line),
            Err(e) => Err(e.to_string()),
        }
    }

    /// Makes the program run `steps` steps, and returns the seconds that it reports.
    fn steps(&mut self, steps: u64) -> Result<f64> {
        let name = self.name.clone();
        let failed = |what: String| CliError::new(Code::Failed, format!("{name}: {what}"));
        writeln!(self.to, "{steps}").map_err(|e| failed(e.to_string()))?;
        let line = self.line().map_err(failed)?;
        line.trim()
            .parse()
            .map_err(|_| failed(format!("expected seconds, got {line:?}")))
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        // The end of its input should end it; otherwise it is killed.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Resets the peak of memory use, and returns the memory in use now, if the system reports it.
fn reset_peak() -> Option<u64> {
    fs::write("/proc/self/clear_refs", "5").ok()?;
    status("VmRSS:")
}

fn peak() -> Option<u64> {
    status("VmHWM:")
}

fn status(field: &str) -> Option<u64> {
    let text = fs::read_to_string("/proc/self/status").ok()?;
    let line = text.lines().find_map(|l| l.strip_prefix(field))?;
    let kib: u64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(kib * 1024)
}
