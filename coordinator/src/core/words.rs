//! Formats durations for messages.

/// Formats a duration: "12 s", "3 min".
pub fn span(ms: i64) -> String {
    let seconds = ms.max(0) as u64 / 1000;
    match seconds {
        0..120 => format!("{seconds} s"),
        120..7200 => format!("{} min", seconds / 60),
        _ => format!("{} h", seconds / 3600),
    }
}
