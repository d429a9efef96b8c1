//! `picofarm model export --format tensorboard`: exports the metrics of a model's epochs.

use std::path::Path;

use picofarm_proto::show;
use serde_json::json;

use super::open;
use crate::{
    dataset::failed,
    error::{CliError, Code, Result},
    output::Output,
    tensorboard::Run,
};

/// Name of the object with a model's epochs.
const HISTORY: &str = "history.jsonl";

/// Writes the metrics of the model's epochs as a TensorBoard run, into a folder named after the
/// model.
pub async fn run(store: &str, name: &str, out: &Path, output: Output) -> Result<()> {
    let models = open(store)?;
    let manifest = models.manifest(name).await.map_err(failed)?;
    if manifest.object(HISTORY).is_none() {
        let what = format!("{name:?} has no epochs: it was trained elsewhere");
        return Err(
            CliError::input(what).hint("`picofarm model list` says which were trained here")
        );
    }
    let history = models.read(&manifest, HISTORY).await.map_err(failed)?;
    let mut run = Run::default();
    let mut count = 0;
    for line in String::from_utf8_lossy(&history).lines() {
        let line = serde_json::from_str(line);
        let broken = |e| CliError::new(Code::Damaged, format!("{name}: {HISTORY}: {e}"));
        run.line(&line.map_err(broken)?);
        count += 1;
    }
    let folder = out.join(name);
    run.write(&folder)?;
    let facts = json!({"model": name, "tensorboard": folder, "lines": count});
    output.result(&facts, || {
        format!(
            "{count} lines of its history in {}\nlook at them with: tensorboard --logdir {}\n",
            folder.display(),
            show::argument(&out.display().to_string())
        )
    });
    Ok(())
}
