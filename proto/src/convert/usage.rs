//! Usage on the wire.

use crate::{
    messages::{Usage, UsageRow},
    wire,
};

impl From<UsageRow> for wire::UsageRow {
    fn from(m: UsageRow) -> Self {
        wire::UsageRow {
            name: m.name,
            tasks: m.usage.tasks,
            failures: m.usage.failures,
            core_ms: m.usage.core_ms,
            bytes: m.usage.bytes,
        }
    }
}

impl From<wire::UsageRow> for UsageRow {
    fn from(w: wire::UsageRow) -> Self {
        UsageRow {
            name: w.name,
            usage: Usage {
                tasks: w.tasks,
                failures: w.failures,
                core_ms: w.core_ms,
                bytes: w.bytes,
            },
        }
    }
}
