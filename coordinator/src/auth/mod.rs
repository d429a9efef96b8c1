//! Authentication and authorization. `Guard` precedes every service. It identifies the caller by
//! a token or a client certificate, compares the caller's roles with the method's requirement, and
//! passes the [`Caller`] to the handlers.

mod access;
pub(crate) mod caller;
mod expiry;
mod gate;
mod guard;
mod quota;
mod rights;
mod roles;
mod tls;
mod tokens;
mod trust;

pub use access::Access;
pub use caller::Caller;
pub use expiry::Expiry;
pub(crate) use gate::Gate;
pub use guard::{ACCEPTED, BY_CERTIFICATE, BY_DIGEST};
pub(crate) use guard::{Guard, SameMachine};
pub use quota::Quotas;
pub(crate) use quota::{Throttle, WorkerIds};
pub use rights::Visibility;
pub(crate) use rights::not_yours;
pub(crate) use roles::act;
pub use roles::{METHODS, Needs, Role, Roles, needs};
pub(crate) use tls::Loaded;
pub use tls::TlsFiles;
pub use tokens::{Entry, TOKEN_PREFIX, TokenError, Tokens};
pub(crate) use trust::{GRACE, Judge, Reader, Source, Trouble, Verdict, too_slow};
