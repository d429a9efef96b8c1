//! The code of an own training: read and packed at submission, unpacked on the worker.

use std::{
    fs,
    io::Read,
    path::{Path, PathBuf},
};

use base64::{Engine, engine::general_purpose::STANDARD};
use bytes::Bytes;
use flate2::{Compression, read::ZlibDecoder, read::ZlibEncoder};
use picofarm_proto::spec::{
    SpecError,
    kinds::{
        CodeFile, PythonSettings,
        python::{CODE_BYTES, CODE_FILES},
    },
};
use picofarm_store::sha256_hex;

use crate::{submission::Submission, task::TaskError};

/// Bytes of base64 in a text of a job.
const PIECE: usize = 4000;
/// Most folders between the code's folder and a file.
const DEPTH: usize = 8;

/// Reads the code into the settings, unless it is there already.
pub(super) fn resolve(
    settings: &mut PythonSettings,
    here: &Submission<'_>,
) -> Result<(), SpecError> {
    if !settings.code.is_empty() {
        return Ok(());
    }
    let fail = |what: String| SpecError::new("python.file", what);
    let path = here.path("python.file", &settings.file)?;
    let shown = |path: &Path, e: std::io::Error| fail(format!("{}: {e}", path.display()));
    let found = fs::metadata(&path).map_err(|e| shown(&path, e))?;
    let name = path.file_name().and_then(|name| name.to_str());
    let name = name.ok_or_else(|| fail(format!("{} has no name", path.display())))?;
    let mut files = Vec::new();
    match found.is_dir() {
        true => list(&path, &mut files, DEPTH).map_err(|e| shown(&path, e))?,
        false => files.push(path.clone()),
    }
    files.sort();
    let root = match found.is_dir() {
        true => &*path,
        false => path.parent().unwrap_or(Path::new("/")),
    };
    if files.is_empty() || files.len() > CODE_FILES {
        let n = files.len();
        return Err(fail(format!(
            "{} has {n} files; expected 1 to {CODE_FILES}",
            path.display()
        )));
    }
    let mut total = 0;
    let mut code = Vec::with_capacity(files.len());
    for file in &files {
        total += fs::metadata(file).map_err(|e| shown(file, e))?.len();
        if total > CODE_BYTES as u64 {
            let what = format!(
                "{} has more than {} MiB; name the files of the code only",
                path.display(),
                CODE_BYTES >> 20
            );
            return Err(fail(what));
        }
        let bytes = fs::read(file).map_err(|e| shown(file, e))?;
        let below = file.strip_prefix(root).unwrap_or(file);
        let below = below
            .to_str()
            .ok_or_else(|| fail(format!("{} is no UTF-8; rename the file", file.display())))?;
        code.push(pack(below, &bytes).map_err(|e| shown(file, e))?);
    }
    settings.entry = entry(&settings.entry, name, found.is_dir(), &code)?;
    name.clone_into(&mut settings.file);
    settings.code = code;
    Ok(())
}

/// Returns the full form of an entry: `module:function`, or a file that runs as a script.
fn entry(written: &str, name: &str, folder: bool, code: &[CodeFile]) -> Result<String, SpecError> {
    let fail = |what: String| Err(SpecError::new("python.entry", what));
    let has = |path: &str| code.iter().any(|file| file.path == path);
    let Some(stem) = (match folder {
        true => Some(""),
        false => name.strip_suffix(".py"),
    }) else {
        let what = format!("{name:?} is no Python file (.py)");
        return Err(SpecError::new("python.file", what));
    };
    match (written.split_once(':'), folder) {
        (Some((module, function)), _) => {
            let path = module.replace('.', "/");
            let known = has(&format!("{path}.py")) || has(&format!("{path}/__init__.py"));
            match known && !function.is_empty() {
                true => Ok(written.to_owned()),
                false => fail(format!("{written:?}: the code has no module {module:?}")),
            }
        }
        (None, false) if written.is_empty() => Ok(name.to_owned()),
        (None, false) => Ok(format!("{stem}:{written}")),
        (None, true) if has(written) => Ok(written.to_owned()),
        (None, true) => fail(format!(
            "{written:?}: for a folder, write module:function, or a file in it"
        )),
    }
}

/// Lists the files below a folder, without hidden ones, links and compiled code.
fn list(folder: &Path, files: &mut Vec<PathBuf>, depth: usize) -> std::io::Result<()> {
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        let name = entry.file_name();
        let name = name.to_string_lossy();
        let kind = entry.file_type()?;
        if name.starts_with('.') || name == "__pycache__" || files.len() > CODE_FILES {
            continue;
        }
        match (kind.is_dir(), depth) {
            (true, 0) => {
                let what = format!("{}: the folders are too deep", entry.path().display());
                return Err(std::io::Error::other(what));
            }
            (true, _) => list(&entry.path(), files, depth - 1)?,
            (false, _) if kind.is_file() => files.push(entry.path()),
            _ => {}
        }
    }
    Ok(())
}

fn pack(path: &str, bytes: &[u8]) -> std::io::Result<CodeFile> {
    let mut packed = Vec::new();
    ZlibEncoder::new(bytes, Compression::best()).read_to_end(&mut packed)?;
    let text = STANDARD.encode(packed);
    let pieces = text.as_bytes().chunks(PIECE);
    Ok(CodeFile {
        path: path.to_owned(),
        sha256: sha256_hex(bytes),
        packed: pieces
            .map(|piece| String::from_utf8_lossy(piece).into_owned())
            .collect(),
    })
}

/// Returns the files of the code, after checking their hashes.
pub(super) fn unpack(settings: &PythonSettings) -> Result<Vec<(String, Bytes)>, TaskError> {
    let mut left = CODE_BYTES as u64;
    let mut files = Vec::with_capacity(settings.code.len());
    for (i, file) in settings.code.iter().enumerate() {
        let fail =
            |what: &str| TaskError::User(format!("python.code[{i}]: {what}; submit the job again"));
        let packed = STANDARD
            .decode(file.packed.concat())
            .map_err(|e| fail(&format!("is no base64 ({e})")))?;
        let mut bytes = Vec::new();
        ZlibDecoder::new(&*packed)
            .take(left + 1)
            .read_to_end(&mut bytes)
            .map_err(|e| fail(&format!("cannot be unpacked ({e})")))?;
        let Some(rest) = left.checked_sub(bytes.len() as u64) else {
            return Err(fail("unpacks to more than 1 MiB"));
        };
        left = rest;
        if sha256_hex(&bytes) != file.sha256 {
            return Err(fail("has another SHA-256 than the job says"));
        }
        files.push((file.path.clone(), bytes.into()));
    }
    Ok(files)
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn settings(file: &str, entry: &str) -> PythonSettings {
        serde_json::from_value(json!({"file": file, "entry": entry, "model": "m"})).unwrap()
    }

    #[test]
    fn a_file_and_a_folder_come_back_as_they_were_and_pin_their_bytes() {
        let dir = tempfile::tempdir().unwrap();
        let long = "x = 1\n".repeat(20_000);
        fs::create_dir_all(dir.path().join("net/parts/__pycache__")).unwrap();
        for (name, text) in [
            ("train.py", "def main(): pass\n"),
            ("net/go.py", &long),
            ("net/parts/a.py", "a = 'ä'\n"),
            ("net/parts/__pycache__/a.pyc", "no"),
            ("net/.hidden", "no"),
        ] {
            fs::write(dir.path().join(name), text).unwrap();
        }
        let here = Submission {
            base: dir.path(),
            assets: &[],
        };
        let resolved = |file: &str, entry: &str| {
            let mut settings = settings(file, entry);
            resolve(&mut settings, &here).map(|()| settings)
        };
        assert_eq!(resolved("train.py", "").unwrap().entry, "train.py");
        let one = resolved("train.py", "main").unwrap();
        assert_eq!((&*one.entry, &*one.file), ("train:main", "train.py"));
        assert_eq!(&unpack(&one).unwrap()[0].1[..], b"def main(): pass\n");
        let all = resolved("net", "parts.a:main").unwrap();
        let files = unpack(&all).unwrap();
        let names: Vec<&str> = files.iter().map(|(name, _)| &**name).collect();
        assert_eq!(names, ["go.py", "parts/a.py"]);
        assert_eq!(files[0].1, long.as_bytes());
        assert_eq!(resolved("net", "go.py").unwrap().entry, "go.py");
        for (file, entry, what) in [
            ("net", "", "python.entry"),
            ("net", "other:main", "no module \"other\""),
            ("nothing.py", "", "python.file"),
            ("net/.hidden", "", "no Python file"),
        ] {
            let refused = resolved(file, entry).unwrap_err().to_string();
            assert!(refused.contains(what), "{file} {entry}: {refused}");
        }
        // Code that was changed on the way is refused.
        let mut changed = one;
        changed.code[0].sha256 = "0".repeat(64);
        let refused = unpack(&changed).unwrap_err().to_string();
        assert!(refused.contains("another SHA-256"), "{refused}");
    }
}
