//! Who calls, and what they may do. [`Guard`] stands before every service: it knows the caller by a token or a client
//! certificate, holds what the method needs against the caller's roles, and hands the [`Caller`] on to the handlers.

mod access;
pub(crate) mod caller;
mod gate;
mod guard;
mod quota;
mod rights;
mod roles;
mod tls;
mod tokens;

pub use access::Access;
pub use caller::Caller;
pub(crate) use gate::Gate;
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
