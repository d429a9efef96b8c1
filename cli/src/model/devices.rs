//! `picofarm model devices`: the graphics processors of this machine, each tried.

use picofarm_model::device::{self, OpenGpu, RUNTIMES};
use serde::Serialize;

use crate::{
    error::Result,
    output::{Output, table},
};

#[derive(Serialize)]
struct Listed {
    /// As `--gpus` takes it.
    name: String,
    /// A card, or a driver that computes on the CPU.
    kind: &'static str,
    /// As it calls itself; none where it cannot be opened or computes wrongly.
    device: Option<String>,
    /// How far a product, a convolution and their gradients lie from the CPU's at most, over the greatest value of each.
    apart: Option<f32>,
    /// Why it cannot be used.
    fault: Option<String>,
    /// For people.
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
