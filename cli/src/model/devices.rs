//! `picofarm model devices`: the graphics processors of this machine, each tried.

use picofarm_model::device::{self, RUNTIMES};
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
    /// Why it cannot be used.
    fault: Option<String>,
}

pub fn run(output: Output) -> Result<()> {
    let listed: Vec<Listed> = device::gpus()
        .iter()
        .map(|gpu| {
            let (device, fault) = match gpu.open() {
                Ok(gpu) => (Some(gpu.name), None),
                Err(error) => (None, Some(error.to_string())),
            };
            Listed {
                name: gpu.id().to_owned(),
                kind: match gpu.is_software() {
                    true => "software",
                    false => "card",
                },
                device,
                fault,
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
                gpu.fault
                    .clone()
                    .unwrap_or_else(|| "computes as the CPU does".into()),
            ]
        }));
        table(&rows)
    });
    Ok(())
}
