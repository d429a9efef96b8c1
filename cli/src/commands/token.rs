//! `picofarm token`: manages access to a coordinator.

use std::{
    path::Path,
    time::{Duration, Instant, SystemTime},
};

use picofarm_coordinator::auth::{
    BY_CERTIFICATE, BY_DIGEST, Entry, Expiry, Roles, TokenError, Tokens,
};
use picofarm_credentials::CredentialError;
use picofarm_tasks::Access;
use serde_json::json;

use crate::{
    args::Token,
    client::{Standing, standing},
    error::{CliError, Code, Result},
    output::{Output, bytes, printed, table},
    settings::Resolved,
};

/// Maximum time until a coordinator has read the token file again. It checks the file every second.
const NOTICED: Duration = Duration::from_secs(10);
/// Interval between requests.
const PAUSE: Duration = Duration::from_millis(500);

/// Runs one of the commands.
///
/// # Errors
/// Fails if the token file cannot be used, a name is taken, there is no such name, or a coordinator
/// still accepts a revoked token.
pub async fn run(command: Token, resolved: &Resolved, output: Output) -> Result<()> {
    match command {
        Token::Create {
            name,
            role,
            member,
            maintainer,
            expires,
            max_cores,
            max_bytes,
            file,
        } => {
            let projects = (member, maintainer);
            let limits = (expires, max_cores, max_bytes);
            create(&name, role.into(), projects, limits, &file.tokens, output)
        }
        Token::List { file } => {
            list(&file.tokens, output)?;
            Ok(())
        }
        Token::Revoke { name, file } => revoke(&name, &file.tokens, resolved, output).await,
    }
}

fn create(
    name: &str,
    roles: Roles,
    (member, maintainer): (Vec<String>, Vec<String>),
    (expires, max_cores, max_bytes): (Option<Expiry>, Option<u32>, Option<u64>),
    path: &Path,
    output: Output,
) -> Result<()> {
    let said = roles.to_string();
    let token = Tokens::edit_or_create(path, |tokens| {
        let token = tokens.create_until(name, roles, member, maintainer, expires)?;
        tokens.bound(name, max_cores, max_bytes)?;
        Ok(token)
    })
    .map_err(unusable)?;
    let until = expires.map_or_else(String::new, |expires| format!(", until {expires}"));
    output.say(format!(
        "{name} ({said}{until}) is in {}; this is the token, which is shown only now:",
        path.display()
    ));
    output.result(
        &json!({"name": name, "roles": said.split(',').collect::<Vec<_>>(), "expires": expires,
            "max_cores": max_cores, "max_bytes": max_bytes, "token": token.expose()}),
        || token.expose().to_owned(),
    );
    if let Err(unprinted) = printed() {
        // The token was never printed and cannot be recovered.
        Tokens::edit(path, |tokens| Ok(tokens.revoke(name))).map_err(unusable)?;
        return Err(unprinted.hint(format!(
            "{name} was not added; free some space and try again"
        )));
    }
    output.say("set it as PICOFARM_TOKEN, or write it into a file for --token-file");
    Ok(())
}

fn list(path: &Path, output: Output) -> Result<()> {
    let tokens = Tokens::read(path).map_err(unusable)?;
    let now = SystemTime::now();
    let proof = |certificate: &Option<String>| match certificate {
        Some(name) => format!("certificate {name}"),
        None => "token".to_owned(),
    };
    let until = |expires: Option<Expiry>| match expires {
        None => "never expires".to_owned(),
        Some(expires) if expires.is_over(now) => format!("expired {expires}"),
        Some(expires) => format!("expires {expires}"),
    };
    let callers: Vec<_> = tokens
        .entries()
        .iter()
        .map(|e| {
            json!({"name": e.name, "roles": e.roles, "certificate": e.certificate,
                "expires": e.expires, "expired": e.expires.is_some_and(|t| t.is_over(now)),
                "member": e.member, "maintainer": e.maintainer, "max_cores": e.max_cores, "max_bytes": e.max_bytes})
        })
        .collect();
    output.result(&callers, || {
        let rows: Vec<_> = tokens
            .entries()
            .iter()
            .map(|e| {
                let projects = e.member.iter().cloned();
                let kept = e.maintainer.iter().map(|p| format!("{p} (maintainer)"));
                let projects: Vec<_> = projects.chain(kept).collect();
                vec![
                    e.name.clone(),
                    e.roles.to_string(),
                    proof(&e.certificate),
                    until(e.expires),
                    bounds(e),
                    projects.join(", "),
                ]
            })
            .collect();
        table(&rows)
    });
    Ok(())
}

/// Describes the bounds of a caller.
fn bounds(entry: &Entry) -> String {
    let cores = entry.max_cores.map(|n| format!("{n} cores"));
    let stored = entry.max_bytes.map(bytes);
    let both: Vec<String> = cores.into_iter().chain(stored).collect();
    match both.is_empty() {
        true => String::new(),
        false => format!("at most {}", both.join(", ")),
    }
}

async fn revoke(name: &str, path: &Path, resolved: &Resolved, output: Output) -> Result<()> {
    let urls = configured(resolved);
    let access = Access {
        ca: resolved.settings.ca.clone(),
        certificate: resolved.settings.cert.clone(),
        key: resolved.settings.key.clone(),
        token: None,
    };
    let entry = Tokens::edit(path, |tokens| {
        let entry = tokens.by_name(name).cloned();
        let entry = entry.ok_or_else(|| format!("there is no caller {name:?}"))?;
        tokens.revoke(name);
        Ok(entry)
    })
    .map_err(|e| unusable(e).hint("see `picofarm token list`"))?;
    let proof = proof(&entry);
    let asked = urls.iter().map(async |url| {
        let standing = refused_soon(url, &access, &proof).await;
        (*url, standing)
    });
    let asked = futures::future::join_all(asked).await;
    let answers: Vec<_> = asked
        .iter()
        .map(|(url, standing)| {
            let (answer, why) = match standing {
                Standing::Accepted(why) => ("accepted", why),
                Standing::Refused(why) => ("refused", why),
                Standing::Unknown(why) => ("unknown", why),
            };
            json!({"url": url, "answer": answer, "reason": why})
        })
        .collect();
    let document = json!({"revoked": name, "file": path, "coordinators": answers});
    output.result(&document, || describe_revocation(name, path, &asked));
    let accepting: Vec<_> = asked
        .iter()
        .filter(|(_, standing)| matches!(standing, Standing::Accepted(_)))
        .map(|(url, _)| *url)
        .collect();
    if accepting.is_empty() {
        return Ok(());
    }
    Err(CliError::new(
        Code::Coordinator,
        format!("{name} still has access at {}", accepting.join(", ")),
    )
    .hint(format!(
        "is {} the file that its --tokens names? Its log says when it read that file, or why it could not; stop it if \
         {name} must not have access",
        path.display()
    )))
}

/// Returns the coordinators that the user has configured; the default URL is only a guess.
fn configured(resolved: &Resolved) -> Vec<&str> {
    let named = resolved
        .sources
        .iter()
        .any(|(name, source)| *name == "coordinator" && source != "default");
    match named {
        true => resolved
            .settings
            .coordinator
            .split(',')
            .map(str::trim)
            .collect(),
        false => Vec::new(),
    }
}

/// Returns the proof for a question about a caller: the SHA-256 of its token or the name in its
/// certificate. The token itself is not stored.
fn proof(entry: &Entry) -> String {
    match (&entry.sha256, &entry.certificate) {
        (_, Some(name)) => format!("{BY_CERTIFICATE} {name}"),
        (sha256, None) => format!("{BY_DIGEST} {}", sha256.as_deref().unwrap_or_default()),
    }
}

/// Repeats the request until the coordinator refuses the proof, or has had time to notice.
async fn refused_soon(url: &str, access: &Access, proof: &str) -> Standing {
    let since = Instant::now();
    loop {
        let now = standing(url, access, proof).await;
        if !matches!(now, Standing::Accepted(_)) || since.elapsed() > NOTICED {
            return now;
        }
        tokio::time::sleep(PAUSE).await;
    }
}

fn describe_revocation(name: &str, path: &Path, asked: &[(&str, Standing)]) -> String {
    let mut text = format!("{name} is no longer in {}\n", path.display());
    if asked.is_empty() {
        text += "only the file was changed: no coordinator is configured, so none was asked; name them with \
                 --coordinator to have them asked\n";
    }
    for (url, standing) in asked {
        text += &match standing {
            Standing::Refused(why) => format!("{url} refuses {name} now: {why}\n"),
            Standing::Accepted(why) => format!("{url} STILL ACCEPTS {name}: {why}\n"),
            Standing::Unknown(why) => {
                format!("{url} could not be asked, so only the file was changed: {why}\n")
            }
        };
    }
    text
}

fn unusable(error: TokenError) -> CliError {
    let code = match error {
        TokenError::File(CredentialError::Write { .. }) => Code::Resource,
        _ => Code::Input,
    };
    CliError::new(code, error)
}
