//! `picofarm model devices`: lists and tests the GPUs of this machine.

use picofarm_model::device::{self, OpenGpu, RUNTIMES};
use serde::Serialize;

use crate::{
    error::Result,
    output::{Output, table},
};

#[derive(Serialize)]
struct Listed {
    /// Name for `--gpus`.
    name: String,
    /// A card, or a driver that computes on the CPU.
    kind: &'static str,
    /// Name reported by the device; `None` if it cannot be opened or computes wrongly.
    device: Option<String>,
    /// Maximum deviation of a product, a convolution and their gradients from the CPU's results,
    /// relative to the largest value of each.
    apart: Option<f32>,
    /// The reason why it cannot be used.
    fault: Option<String>,
    /// Result of the test as text.
    #[serde(skip)]
    tried: String,
}

pub fn run(output: Output) -> Result<()> {
    let listed: Vec<Listed> = device::gpus()
        .iter()
        .map(|gpu| {
            let opened = gpu.open().map_err(|error| error.to_string());
            let tried = opened.as_ref().map_or_else(Clone::clone, OpenGpu::accuracy);
            Listed {
                name: gpu.id().to_owned(),
                kind: match gpu.is_software() {
                    true => "software",
                    false => "card",
                },
                device: opened.as_ref().ok().map(|gpu| gpu.name.clone()),
                apart: opened.as_ref().ok().map(|gpu| gpu.apart),
                fault: opened.err(),
                tried,
            }
        })
        .collect();
    output.result(&listed, || {
        if RUNTIMES.is_empty() {
            return "none: this program was built without --features wgpu or cuda\n".into();
        }
        if listed.is_empty() {
            return format!("none: no driver lists one ({})\n", RUNTIMES.join(", "));
        }
        let mut rows = vec![
            ["name", "kind", "device", "tried"]
                .map(str::to_owned)
                .to_vec(),
        ];
        rows.extend(listed.iter().map(|gpu| {
            vec![
                gpu.name.clone(),
                gpu.kind.to_owned(),
                gpu.device.clone().unwrap_or_default(),
                gpu.tried.clone(),
            ]
        }));
        table(&rows)
    });
    Ok(())
}
