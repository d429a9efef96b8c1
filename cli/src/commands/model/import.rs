//! `picofarm model import`: stores a network that was trained elsewhere as a model.

use picofarm_store::published::Manifest as _;
use std::path::Path;

use picofarm_tasks::{ImportFor, NotImported, imported};
use serde_json::json;

use super::open;
use crate::{
    commands::dataset::{self, failed},
    error::{CliError, Result},
    files,
    output::{Output, bytes},
};

pub(super) async fn run(
    store: &str,
    name: &str,
    (file, settings): (&Path, &Path),
    dataset: &str,
    output: Output,
) -> Result<()> {
    let models = open(store)?;
    let place = format!("{}/{dataset}", store.trim_end_matches('/'));
    let rooms = dataset::open(&place).await?;
    let first = rooms.scenes_present().await.map_err(failed)?;
    let Some(first) = first.into_iter().min() else {
        let what =
            format!("{place} has no scene yet, by whose manifest models know what was measured");
        return Err(CliError::input(what).hint("render one, or choose another --dataset"));
    };
    let scene = rooms.manifest(first).await.map_err(failed)?;
    let text = files::read_text(settings, files::SETTINGS)?;
    let table: toml::Table = toml::from_str(&text)
        .map_err(|e| CliError::input(format!("{}: {e}", settings.display())))?;
    let mut wanted = serde_json::to_value(table)
        .map_err(|e| CliError::input(format!("{}: {e}", settings.display())))?;
    wanted["model"] = json!(name);
    let weights = files::read(file, files::WEIGHTS)?;
    let called = file.file_name().unwrap_or_default().to_string_lossy();
    let of = ImportFor {
        dataset,
        spec: rooms.spec(),
        scene: &scene,
    };
    let new = imported(&weights, wanted, of, &called).map_err(|what| {
        let hint = hint(&what);
        let what = format!("{} as {}: {what}", file.display(), settings.display());
        CliError::input(what).hint(hint)
    })?;
    let published = models.publish(new, false).await.map_err(failed)?;
    let manifest = &published.manifest;
    let facts = json!({"model": name, "kind": manifest.kind, "bytes": manifest.total_bytes(),
                       "place": models.place(name)});
    output.result(&facts, || {
        format!(
            "{}: predicts {}, {}; evaluate it in a job, `evaluate = {{ models = [\"{name}\"] }}`",
            models.place(name),
            manifest.kind,
            bytes(manifest.total_bytes())
        )
    });
    Ok(())
}

/// Returns the remedy for a refusal.
fn hint(refused: &NotImported) -> &'static str {
    match refused {
        NotImported::Settings(_) => {
            "correct the settings file; its fields are those of `train` in a job file, which `picofarm job init --kind train` writes"
        }
        NotImported::File(_) => {
            "save the weights again, in PyTorch: safetensors.torch.save_file(network.state_dict(), \"network.safetensors\")"
        }
        NotImported::Tensors(_) => {
            "the file must hold the tensors of the network that the settings describe, by PyTorch's names; `picofarm model export` \
             of a model of such a network shows which they are"
        }
        NotImported::Values(_) => {
            "take an earlier checkpoint of the training, or convert the weights again: a conversion to F16 overflows above 65504"
        }
    }
}
