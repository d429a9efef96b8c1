//! `picofarm figure`: figures of a render for papers.

#[cfg(feature = "figures")]
mod convert;
mod panels;
mod source;
#[cfg(feature = "figures")]
use convert::convert;

use std::path::{Path, PathBuf};

use picofarm_figures::{
    inferno,
    paper::{self, Drawn, Panel},
    scene::flight,
    viridis,
};
use serde_json::json;

use self::source::Source;
use crate::{
    args::{ColoursArg, Figure, PanelArg},
    error::{CliError, Code, Result},
    output::{Output, files::write_atomically},
};

/// A file format of figures.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Format {
    Svg,
    Pdf,
    Png,
}

/// The least side of an animation, in pixels.
const ANIMATED: usize = 320;

/// `figure`.
///
/// # Errors
/// Fails for a render that cannot be read or lacks what a panel shows, and for a file that exists.
pub async fn run(args: Figure, output: Output) -> Result<()> {
    let files = match &args.output {
        Some(path) => formats(path)?,
        None => vec![],
    };
    let mut targets: Vec<(&str, &Path)> = files
        .iter()
        .map(|(_, path)| ("--output", path.as_path()))
        .collect();
    targets.extend(args.animate.as_deref().map(|path| ("--animate", path)));
    for (option, path) in &targets {
        check_target(option, path, args.overwrite)?;
    }
    let source = Source::read(&args).await?;
    let work = move || -> Result<Made> {
        let drawn = match files.is_empty() {
            true => None,
            false => Some(draw(&args, &source)?),
        };
        let mut written = Vec::new();
        if let Some((drawn, _)) = &drawn {
            for (format, path) in files {
                let bytes = match format {
                    Format::Svg => drawn.svg.clone().into_bytes(),
                    other => convert(drawn, other, args.dpi)?,
                };
                write_atomically(&path, &bytes)?;
                written.push(path);
            }
        }
        if let Some(path) = &args.animate {
            let side = ANIMATED.div_ceil(source.view.width.max(source.view.height).max(1));
            write_atomically(path, &flight(&source.view, map(args.colours), side))?;
            written.push(path.clone());
        }
        Ok(Made { drawn, written })
    };
    let made = tokio::task::spawn_blocking(work)
        .await
        .map_err(|e| CliError::new(Code::Failed, format!("drawing broke: {e}")))??;
    let size = made.drawn.as_ref().map(|(drawn, panels)| {
        let (width, height) = (drawn.width_mm, drawn.height_mm);
        json!({"width_mm": width, "height_mm": height, "panels": panels})
    });
    let mut facts = size.unwrap_or_else(|| json!({}));
    facts["files"] = json!(made.written);
    output.result(&facts, || {
        let lines = made
            .written
            .iter()
            .map(|path| format!("{}\n", path.display()));
        let size = made
            .drawn
            .as_ref()
            .map_or(String::new(), |(drawn, panels)| {
                let (width, height) = (drawn.width_mm, drawn.height_mm);
                format!("{panels} panels, {width} x {height:.1} mm\n")
            });
        lines.collect::<String>() + &size
    });
    Ok(())
}

struct Made {
    /// The figure and its number of panels, if one was asked for.
    drawn: Option<(Drawn, usize)>,
    written: Vec<PathBuf>,
}

/// Returns the figure and its number of panels.
fn draw(args: &Figure, source: &Source) -> Result<(Drawn, usize)> {
    let mut panels: Vec<Panel> = Vec::new();
    for panel in &args.panels {
        panels.extend(panels::panels(*panel, args, source)?);
    }
    let columns = args
        .columns
        .unwrap_or_else(|| paper::columns(args.width, panels.len()));
    let drawn = paper::draw(&panels, args.width, columns).map_err(|least| {
        CliError::input(format!(
            "--width {} mm: {columns} panels in a row need {least} mm",
            args.width
        ))
        .hint("choose a larger --width or fewer --columns")
    })?;
    Ok((drawn, panels.len()))
}

fn map(colours: ColoursArg) -> fn(f32) -> [u8; 3] {
    match colours {
        ColoursArg::Viridis => viridis,
        ColoursArg::Inferno => inferno,
    }
}

/// Returns the files that an `--output` names.
fn formats(path: &Path) -> Result<Vec<(Format, PathBuf)>> {
    let one = |format| Ok(vec![(format, path.to_owned())]);
    match path.extension().and_then(|e| e.to_str()) {
        Some("svg") => one(Format::Svg),
        Some("pdf") => one(Format::Pdf),
        Some("png") => one(Format::Png),
        None if path.file_name().is_some() => {
            let all = [
                (Format::Svg, "svg"),
                (Format::Pdf, "pdf"),
                (Format::Png, "png"),
            ];
            Ok(all.map(|(f, e)| (f, path.with_extension(e))).to_vec())
        }
        _ => Err(
            CliError::input(format!("--output {}: names no format", path.display()))
                .hint("end it in .svg, .pdf or .png, or leave out the extension for all three"),
        ),
    }
}

/// Checks early that a file can be written.
fn check_target(option: &str, path: &Path, overwrite: bool) -> Result<()> {
    let shown = path.display();
    if path.is_dir() {
        return Err(
            CliError::input(format!("{option} {shown}: is a folder")).hint("name a file in it")
        );
    }
    if option == "--animate" && path.extension().is_none_or(|e| e != "gif") {
        return Err(CliError::input(format!(
            "{option} {shown}: expected a name in .gif"
        )));
    }
    if path.exists() && !overwrite {
        return Err(
            CliError::input(format!("{option} {shown}: the file exists"))
                .hint("name another file, or add --overwrite"),
        );
    }
    let folder = path.parent().filter(|p| !p.as_os_str().is_empty());
    match folder {
        Some(folder) if !folder.is_dir() => Err(CliError::input(format!(
            "{option} {shown}: there is no folder {}",
            folder.display()
        ))
        .hint("make it first")),
        _ => Ok(()),
    }
}

#[cfg(not(feature = "figures"))]
fn convert(_: &Drawn, _: Format, _: u32) -> Result<Vec<u8>> {
    let error = crate::error::not_built("figures", "PDF and PNG of figures");
    Err(error.hint("--output FILE.svg needs no feature"))
}

/// Returns whether panels need the renderer's own errors.
fn needs_errors(panels: &[PanelArg]) -> bool {
    panels.contains(&PanelArg::Error)
}
