//! Tokens, their files and their changes.

use super::*;
use crate::auth::Role;

#[test]
fn a_token_made_is_known_again_and_revoked_is_not() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("deep/tokens.toml");
    let mut tokens = Tokens::default();
    let ada = tokens
        .create(
            "ada",
            vec![Role::Work, Role::Submit].into(),
            vec!["lidar".into()],
            vec![],
        )
        .unwrap();
    let mut view = |name, project: &str| {
        tokens.create(name, vec![Role::View].into(), vec![], vec![project.into()])
    };
    let bob = view("bob", "tof").unwrap();
    for (name, project, says) in [
        ("ada", "tof", "already"),
        ("a b", "tof", "no name"),
        ("eve", "a,b", "\"a,b\" is not the name of a project"),
        ("eve", "", "not the name of a project"),
    ] {
        let said = view(name, project).unwrap_err();
        assert!(said.contains(says), "{said}");
    }
    tokens.write(&path).unwrap();

    let text = std::fs::read_to_string(&path).unwrap();
    assert!(!text.contains(ada.expose()) && !text.contains(&ada.expose()[3..]));
    let mut back = Tokens::read(&path).unwrap();
    assert_eq!(back, tokens);
    let entry = back.by_token(ada.expose()).unwrap();
    assert_eq!(
        (entry.name.as_str(), entry.roles.to_string()),
        ("ada", "submit,work".into())
    );
    assert_eq!(entry.member, ["lidar"]);
    assert!(back.by_token("").is_none() && back.by_token("pf-00").is_none());
    assert!(back.revoke("ada") && !back.revoke("ada"));
    assert!(back.by_token(ada.expose()).is_none());
    assert_eq!(back.by_token(bob.expose()).unwrap().name, "bob");
}

#[test]
fn changes_at_the_same_moment_are_all_kept() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("tokens.toml");
    let create = |name: String| {
        Tokens::edit_or_create(&path, |tokens| {
            tokens.create(&name, vec![Role::View].into(), vec![], vec![])
        })
        .unwrap();
    };
    for i in 0..5 {
        create(format!("old-{i}"));
    }
    std::thread::scope(|scope| {
        for i in 0..5 {
            scope.spawn(move || create(format!("new-{i}")));
            let path = &path;
            scope.spawn(move || {
                let revoke = |tokens: &mut Tokens| Ok(tokens.revoke(&format!("old-{i}")));
                assert!(Tokens::edit(path, revoke).unwrap());
            });
        }
    });
    let mut names: Vec<_> = Tokens::read(&path).unwrap().entries;
    names.sort_by(|a, b| a.name.cmp(&b.name));
    let names: Vec<_> = names.iter().map(|e| &*e.name).collect();
    assert_eq!(names, ["new-0", "new-1", "new-2", "new-3", "new-4"]);
}

#[test]
fn a_change_that_is_refused_leaves_the_file_as_it_was() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("tokens.toml");
    let refused = |_: &mut Tokens| Err::<(), _>("no".to_owned());
    assert!(Tokens::edit_or_create(&path, refused).is_err());
    assert!(!path.exists());
    Tokens::default().write(&path).unwrap();
    let before = std::fs::read(&path).unwrap();
    let said = Tokens::edit(&path, refused).unwrap_err().to_string();
    assert!(said.ends_with("tokens.toml: no"), "{said}");
    assert_eq!(std::fs::read(&path).unwrap(), before);
}

#[test]
fn an_expiry_is_read_with_and_without_quotes() {
    let digest = "00".repeat(32);
    for expires in [
        "\"2027-03-01T08:00:00Z\"",
        "2027-03-01T08:00:00Z",
        "2027-03-01 08:00:00Z",
    ] {
        let text = format!(
            "[[caller]]\nname = \"a\"\nroles = [\"work\"]\nsha256 = \"{digest}\"\nexpires = {expires}\n"
        );
        let tokens = Tokens::parse(&text).unwrap();
        let expires = tokens.entries[0].expires.unwrap();
        assert_eq!(expires.to_string(), "2027-03-01T08:00:00Z");
        assert_eq!(Tokens::parse(&tokens.to_text()).unwrap(), tokens);
    }
    let text = format!(
        "[[caller]]\nname = \"a\"\nroles = [\"work\"]\nsha256 = \"{digest}\"\nexpires = \"soon\"\n"
    );
    let said = Tokens::parse(&text).unwrap_err();
    assert!(said.contains("\"soon\" is not a time"), "{said}");
}

#[test]
fn a_token_file_open_to_everyone_is_refused() {
    use std::os::unix::fs::PermissionsExt;
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("tokens.toml");
    Tokens::default().write(&path).unwrap();
    std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o644)).unwrap();
    let said = Tokens::read(&path).unwrap_err().to_string();
    assert!(
        said.contains("tokens.toml") && said.contains("chmod o-rwx"),
        "{said}"
    );
}

#[test]
fn entries_that_make_no_sense_are_named() {
    let digest = "00".repeat(32);
    for (text, says) in [
        (
            "name = \"a\"\nroles = [\"work\"]\n".to_owned(),
            "either sha256 or certificate",
        ),
        (
            format!("name = \"a\"\nroles = []\nsha256 = \"{digest}\"\n"),
            "no roles",
        ),
        (
            "name = \"a\"\nroles = [\"work\"]\nsha256 = \"pf-12\"\n".to_owned(),
            "not the token",
        ),
        (
            format!("name = \"a b\"\nroles = [\"work\"]\nsha256 = \"{digest}\"\n"),
            "no name",
        ),
        (
            format!("name = \"a\"\nroles = [\"boss\"]\nsha256 = \"{digest}\"\n"),
            "boss",
        ),
        (
            format!("name = \"a\"\nrole = [\"work\"]\nsha256 = \"{digest}\"\n"),
            "role",
        ),
        (
            format!("name = \"a\"\nroles = [\"work\"]\nsha256 = \"{digest}\"\nmax_cores = 0\n"),
            "at least 1",
        ),
        (
            format!(
                "name = \"a\"\nroles = [\"work\"]\nsha256 = \"{digest}\"\nmember = [\"x y\"]\n"
            ),
            "\"x y\" is not the name of a project",
        ),
    ] {
        let said = Tokens::parse(&format!("[[caller]]\n{text}")).unwrap_err();
        assert!(said.contains(says), "{said}");
    }
    let one = format!("[[caller]]\nname = \"a\"\nroles = [\"work\"]\nsha256 = \"{digest}\"\n");
    assert!(
        Tokens::parse(&format!("{one}{one}"))
            .unwrap_err()
            .contains("twice")
    );
}

#[test]
fn a_bound_on_cores_is_kept_in_the_file_and_changes_no_access() {
    let mut tokens = Tokens::default();
    let roles = vec![Role::Submit].into();
    tokens.create("ada", roles, vec![], vec![]).unwrap();
    let before = tokens.entries()[0].clone();
    tokens.bound("ada", Some(64), Some(5_000)).unwrap();
    assert!(tokens.bound("eve", Some(64), None).is_err());
    let read = Tokens::parse(&tokens.to_text()).unwrap();
    let after = &read.entries()[0];
    assert_eq!((after.max_cores, after.max_bytes), (Some(64), Some(5_000)));
    assert!(after.gives_access_of(&before));
    let other = Entry {
        member: vec!["light".into()],
        ..before.clone()
    };
    assert!(!other.gives_access_of(&before));
}
