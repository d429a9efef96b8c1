//! Who may ask: a key in a cookie, the names in `Host`, and the origin of forms.
//!
//! Every user of this machine can reach its loopback interface, and every web page can make a
//! browser send requests to it. Therefore each start makes a random key. The printed link has it,
//! and the first request exchanges it for a cookie. Scripts cannot read the cookie, and browsers do
//! not send it with forms, pictures or scripts of other sites. `Host` must be a known name, so that
//! a site whose name resolves to 127.0.0.1 (DNS rebinding) gets no answer.

use http::{
    HeaderMap,
    header::{COOKIE, HOST, ORIGIN},
};
use picofarm_store::sha256_hex;
use subtle::ConstantTimeEq;
use uuid::Uuid;

/// The names of this machine's loopback interface.
const LOOPBACK: [&str; 3] = ["127.0.0.1", "localhost", "[::1]"];

/// The key and the known names.
pub struct Guard {
    key: String,
    /// What forms contain: it follows from the key, and does not reveal it.
    form: String,
    hosts: Vec<String>,
    /// Whether browsers are answered with TLS.
    encrypted: bool,
}

impl Guard {
    /// Makes a new random key.
    pub fn new(hosts: Vec<String>, encrypted: bool) -> Self {
        // A version 4 UUID has 122 random bits from the system.
        let key = Uuid::new_v4().simple().to_string();
        let form = sha256_hex(format!("picofarm form {key}").as_bytes());
        Self {
            key,
            form,
            hosts,
            encrypted,
        }
    }

    /// Returns the beginning of links.
    pub fn scheme(&self) -> &'static str {
        match self.encrypted {
            true => "https://",
            false => "http://",
        }
    }

    /// Returns the key of links.
    pub fn key(&self) -> &str {
        &self.key
    }

    /// Returns the hidden value of forms.
    pub fn form(&self) -> &str {
        &self.form
    }

    /// Returns the first name for other machines.
    pub fn first_host(&self) -> Option<&str> {
        self.hosts.first().map(String::as_str)
    }

    /// Returns the cookie that carries the key. Cookies do not depend on ports, so its name has the
    /// beginning of the form's value: two servers on one machine do not replace each other's. With
    /// TLS, browsers send it only encrypted, and `__Host-` lets no other host of the domain set it.
    pub fn cookie(&self) -> String {
        let secure = if self.encrypted { "; Secure" } else { "" };
        format!(
            "{}={}; Path=/; HttpOnly; SameSite=Lax{secure}",
            self.cookie_name(),
            self.key
        )
    }

    fn cookie_name(&self) -> String {
        let host = if self.encrypted { "__Host-" } else { "" };
        format!("{host}picofarm-{}", &self.form[..8])
    }

    /// Returns whether a text is the key.
    pub fn is_key(&self, text: &str) -> bool {
        equal(text, &self.key)
    }

    /// Returns whether the request's cookies have the key.
    pub fn knows(&self, headers: &HeaderMap) -> bool {
        let name = self.cookie_name();
        let lines = headers.get_all(COOKIE).into_iter();
        lines
            .filter_map(|line| line.to_str().ok())
            .flat_map(|line| line.split(';'))
            .filter_map(|pair| pair.trim().split_once('='))
            .any(|(found, value)| found == name && self.is_key(value))
    }

    /// Checks that the request names this server by a known name.
    ///
    /// # Errors
    /// A message with the found name.
    pub fn check_host(&self, headers: &HeaderMap) -> Result<(), String> {
        let mut hosts = headers.get_all(HOST).into_iter();
        let (Some(host), None) = (hosts.next(), hosts.next()) else {
            return Err("expected one Host header".into());
        };
        let host = host.to_str().unwrap_or_default();
        let name = without_port(host);
        let known = |known: &str| known.eq_ignore_ascii_case(name);
        if LOOPBACK.into_iter().any(known) || self.hosts.iter().any(|host| known(host)) {
            return Ok(());
        }
        Err(format!(
            "this server is not known as {name:?}; `picofarm web --host NAME` allows a name"
        ))
    }

    /// Checks that a form was sent by a page of this server.
    ///
    /// # Errors
    /// A message with the reason.
    pub fn check_form(&self, headers: &HeaderMap, token: &str) -> Result<(), String> {
        self.check_origin(headers)?;
        match equal(token, &self.form) {
            true => Ok(()),
            false => Err("the form is of another start of this server; reload the page".into()),
        }
    }

    /// Checks that a request was not sent by a page of another site.
    ///
    /// # Errors
    /// A message with the reason.
    pub fn check_origin(&self, headers: &HeaderMap) -> Result<(), String> {
        let site = headers.get("sec-fetch-site");
        if site.is_some_and(|site| site != "same-origin") {
            return Err("the request was sent by a page of another site".into());
        }
        if let Some(origin) = headers.get(ORIGIN) {
            let host = headers.get(HOST).and_then(|host| host.to_str().ok());
            let origin = origin.to_str().unwrap_or_default();
            // Without TLS here, a tunnel or a proxy in front may speak it.
            let schemes = match self.encrypted {
                true => &["https://"][..],
                false => &["http://", "https://"],
            };
            let own = |scheme: &&str| origin.strip_prefix(scheme) == host;
            if host.is_none() || !schemes.iter().any(own) {
                return Err("the request was sent by a page of another origin".into());
            }
        }
        Ok(())
    }
}

fn equal(a: &str, b: &str) -> bool {
    a.as_bytes().ct_eq(b.as_bytes()).into()
}

/// The host of `host:port`; IPv6 addresses are in brackets.
fn without_port(host: &str) -> &str {
    let end = host.rfind(']').map_or(0, |end| end + 1);
    match host[end..].find(':') {
        Some(colon) => &host[..end + colon],
        None => host,
    }
}

/// Returns whether a text is a host name or an address, without a port.
pub fn is_host(text: &str) -> bool {
    let address = text.strip_prefix('[').and_then(|t| t.strip_suffix(']'));
    match address {
        Some(address) => address.parse::<std::net::Ipv6Addr>().is_ok(),
        None => {
            let letter = |c: char| c.is_ascii_alphanumeric() || "-._".contains(c);
            !text.is_empty() && text.len() <= 253 && text.chars().all(letter)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn headers(pairs: &[(&'static str, &str)]) -> HeaderMap {
        let mut map = HeaderMap::new();
        for (name, value) in pairs {
            map.append(*name, value.parse().unwrap());
        }
        map
    }

    #[test]
    fn only_loopback_and_the_given_names_are_hosts_whatever_their_port() {
        let guard = Guard::new(vec!["farm.example".into()], false);
        for host in [
            "127.0.0.1:7421",
            "localhost",
            "LOCALHOST:99",
            "[::1]:7421",
            "farm.example:80",
        ] {
            assert_eq!(guard.check_host(&headers(&[("host", host)])), Ok(()));
        }
        for host in ["evil.example", "127.0.0.1.evil.example:7421", "", "[::2]"] {
            assert!(guard.check_host(&headers(&[("host", host)])).is_err());
        }
        assert!(guard.check_host(&HeaderMap::new()).is_err());
        let two = headers(&[("host", "localhost"), ("host", "evil.example")]);
        assert!(guard.check_host(&two).is_err());
    }

    #[test]
    fn a_key_is_known_by_its_cookie_alone() {
        let guard = Guard::new(Vec::new(), false);
        let cookie = guard.cookie();
        let pair = cookie.split(';').next().unwrap();
        assert!(guard.knows(&headers(&[("cookie", &format!("a=b; {pair}"))])));
        let other = Guard::new(Vec::new(), false);
        assert!(!other.knows(&headers(&[("cookie", pair)])));
        assert!(!guard.knows(&HeaderMap::new()));
        assert!(!cookie.contains(guard.form()) && !guard.form().contains(guard.key()));
    }

    #[test]
    fn with_tls_the_cookie_is_sent_only_encrypted_and_origins_are_encrypted() {
        let guard = Guard::new(Vec::new(), true);
        let cookie = guard.cookie();
        assert!(cookie.starts_with("__Host-picofarm-"), "{cookie}");
        assert!(cookie.ends_with("; Secure"), "{cookie}");
        assert!(!cookie.contains("Domain"), "{cookie}");
        let origin = |origin| headers(&[("host", "localhost:1"), ("origin", origin)]);
        let check = |text| guard.check_form(&origin(text), guard.form());
        assert_eq!(check("https://localhost:1"), Ok(()));
        assert!(check("http://localhost:1").is_err());
    }

    #[test]
    fn forms_of_other_sites_origins_and_starts_are_refused() {
        let guard = Guard::new(Vec::new(), false);
        let form = guard.form();
        let own = &[
            ("host", "localhost:1"),
            ("origin", "http://localhost:1"),
            ("sec-fetch-site", "same-origin"),
        ];
        assert_eq!(guard.check_form(&headers(own), form), Ok(()));
        let behind_tls = &[("host", "localhost:1"), ("origin", "https://localhost:1")];
        assert_eq!(guard.check_form(&headers(behind_tls), form), Ok(()));
        assert!(guard.check_form(&headers(own), "").is_err());
        for (name, value) in [
            ("origin", "http://localhost:2"),
            ("origin", "null"),
            ("origin", "ftp://localhost:1"),
            ("sec-fetch-site", "cross-site"),
            ("sec-fetch-site", "same-site"),
        ] {
            let foreign = headers(&[("host", "localhost:1"), (name, value)]);
            assert!(guard.check_form(&foreign, form).is_err(), "{name} {value}");
        }
    }

    #[test]
    fn hosts_are_names_or_addresses_without_ports() {
        for host in ["farm.example", "10.0.0.7", "[2001:db8::1]"] {
            assert!(is_host(host), "{host}");
        }
        for host in ["", "farm:80", "http://farm", "a b", "[::1", "::1"] {
            assert!(!is_host(host), "{host}");
        }
    }
}
