//! Allocations that report a lack of memory.

use crate::api::RenderError;

/// Checks that `count` values can be allocated at once.
///
/// # Errors
/// Returns [`RenderError::Memory`] if they cannot.
pub(crate) fn room<T>(count: usize, what: &str) -> Result<(), RenderError> {
    let mut all = Vec::<T>::new();
    all.try_reserve_exact(count)
        .map_err(|_| RenderError::Memory {
            what: what.to_owned(),
            gib: count as f64 * size_of::<T>() as f64 / (1u64 << 30) as f64,
        })
}

/// Returns `count` zeros. Pages that are never written take no memory, so this function does not
/// write them.
///
/// # Errors
/// Returns [`RenderError::Memory`] if the allocation fails.
pub(crate) fn zeros(count: usize, what: &str) -> Result<Vec<f32>, RenderError> {
    room::<f32>(count, what)?;
    Ok(vec![0.0; count])
}
