//! Identifies callers by a token or a client certificate, and decides what each may do. The layer
//! that asks for this before every call is in `edge`.

mod access;
mod caller;
mod expiry;
mod gate;
mod own_code;
mod quota;
mod rights;
mod roles;
mod tls;
mod tokens;
mod trust;

pub use access::{ACCEPTED, Access, BY_CERTIFICATE, BY_DIGEST};
pub use caller::Caller;
pub use expiry::Expiry;
pub(crate) use gate::Gate;
pub use own_code::OwnCode;
pub use quota::Quotas;
pub(crate) use quota::{Throttle, WorkerIds};
pub use rights::Visibility;
pub(crate) use rights::not_owner;
pub(crate) use roles::act;
pub use roles::{METHODS, Needs, Role, Roles, needs};
pub(crate) use tls::Loaded;
pub use tls::TlsFiles;
pub use tokens::{Entry, TOKEN_PREFIX, TokenError, Tokens};
pub(crate) use trust::{CredentialFile, FileTrouble, FileVerdict, GRACE, Judge, Reader, too_slow};
