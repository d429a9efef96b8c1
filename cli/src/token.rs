//! `picofarm token`: who may use a coordinator.

use std::path::Path;

use picofarm_coordinator::auth::{Roles, TokenError, Tokens};
use serde_json::json;

use crate::{
    args::Token,
    error::{CliError, Code, Result},
    output::{Output, table},
};

/// Runs one of the commands.
///
/// # Errors
/// The token file cannot be used, a name is taken, or there is no such name.
pub fn run(command: Token, output: Output) -> Result<()> {
    match command {
        Token::Create {
            name,
            role,
            member,
            maintainer,
            file,
        } => {
            let projects = (member, maintainer);
            create(&name, role.into(), projects, &file.tokens, output)
        }
        Token::List { file } => {
            list(&file.tokens, output)?;
            Ok(())
        }
        Token::Revoke { name, file } => revoke(&name, &file.tokens, output),
    }
}

fn create(
    name: &str,
    roles: Roles,
    (member, maintainer): (Vec<String>, Vec<String>),
    path: &Path,
    output: Output,
) -> Result<()> {
    let mut tokens = if path.exists() {
        Tokens::read(path).map_err(unusable)?
    } else {
        Tokens::default()
    };
    let said = roles.to_string();
    let token = tokens
        .create(name, roles, member, maintainer)
        .map_err(|what| CliError::input(format!("{}: {what}", path.display())))?;
    tokens.write(path).map_err(unusable)?;
    output.say(format!(
        "{name} ({said}) is in {}; this is the token, which is shown only now:",
        path.display()
    ));
    output.result(
        &json!({"name": name, "roles": said.split(',').collect::<Vec<_>>(), "token": token.expose()}),
        || token.expose().to_owned(),
    );
    output.say("set it as PICOFARM_TOKEN, or write it into a file for --token-file");
    Ok(())
}

fn list(path: &Path, output: Output) -> Result<()> {
    let tokens = Tokens::read(path).map_err(unusable)?;
    let proof = |certificate: &Option<String>| match certificate {
        Some(name) => format!("certificate {name}"),
        None => "token".to_owned(),
    };
    let callers: Vec<_> = tokens
        .entries()
        .iter()
        .map(|e| {
            json!({"name": e.name, "roles": e.roles, "certificate": e.certificate,
                "member": e.member, "maintainer": e.maintainer})
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
                    projects.join(", "),
                ]
            })
            .collect();
        table(&rows)
    });
    Ok(())
}

fn revoke(name: &str, path: &Path, output: Output) -> Result<()> {
    let mut tokens = Tokens::read(path).map_err(unusable)?;
    if !tokens.revoke(name) {
        return Err(
            CliError::input(format!("{}: there is no caller {name:?}", path.display()))
                .hint("see `picofarm token list`"),
        );
    }
    tokens.write(path).map_err(unusable)?;
    output.result(&json!({"revoked": name}), || {
        format!("{name} has no access any more; running coordinators notice within seconds")
    });
    Ok(())
}

fn unusable(error: TokenError) -> CliError {
    let code = match error {
        TokenError::Write { .. } => Code::Resource,
        _ => Code::Input,
    };
    CliError::new(code, error)
}
