//! Weights as safetensors, by PyTorch's names and in its shapes:
//! `torch.load_state_dict(safetensors.torch.load_file(…))`.

use std::collections::{BTreeMap, HashMap};

use half::{bf16, f16};
use safetensors::{Dtype, SafeTensors, tensor::TensorView};

pub use crate::parameters::Named;
use crate::{ModelError, net::ONE_HOT, parameters::Declared};

/// Encodes tensors as safetensors, in the order of their names, with metadata.
pub fn write(named: &Named, metadata: &BTreeMap<String, String>) -> Vec<u8> {
    let views = named.iter().map(|(name, (shape, values))| {
        let bytes = bytemuck::cast_slice(values);
        let view = TensorView::new(Dtype::F32, shape.clone(), bytes);
        (name.clone(), view.expect("shapes belong to their values"))
    });
    let metadata: HashMap<String, String> = metadata.clone().into_iter().collect();
    let metadata = (!metadata.is_empty()).then_some(metadata);
    safetensors::serialize(views, metadata).expect("the names differ and the shapes fit")
}

/// Decodes the tensors and metadata of safetensors. Values in f16, bf16, f64 and integers are
/// converted to f32.
///
/// # Errors
/// [`ModelError::File`] if the bytes are not valid.
pub fn read(bytes: &[u8]) -> Result<(Named, BTreeMap<String, String>), ModelError> {
    let broken = |e: safetensors::SafeTensorError| {
        ModelError::file(format!("these are no whole safetensors: {e}"))
    };
    let tensors = SafeTensors::deserialize(bytes).map_err(broken)?;
    let (_, header) = SafeTensors::read_metadata(bytes).map_err(broken)?;
    let mut named = Named::new();
    for (name, view) in tensors.tensors() {
        let data = view.data();
        let values: Vec<f32> = match view.dtype() {
            Dtype::F32 => each(data, f32::from_le_bytes),
            Dtype::F64 => each(data, |b| f64::from_le_bytes(b) as f32),
            Dtype::I64 => each(data, |b| i64::from_le_bytes(b) as f32),
            Dtype::F16 => each(data, |b| f16::from_le_bytes(b).to_f32()),
            Dtype::BF16 => each(data, |b| bf16::from_le_bytes(b).to_f32()),
            other => {
                let what =
                    format!("{name:?} is stored as {other:?}; expected F32, F64, F16, BF16 or I64");
                return Err(ModelError::file(what));
            }
        };
        // PyTorch stores a count of batches as a scalar.
        let shape = match view.shape() {
            [] => vec![1],
            shape => shape.to_vec(),
        };
        named.insert(name, (shape, values));
    }
    let metadata = header.metadata().clone().unwrap_or_default();
    Ok((named, metadata.into_iter().collect()))
}

/// Checks that a network can compute with these values.
///
/// # Errors
/// [`ModelError::Values`] naming the first tensor that contains a non-finite number or a
/// variance below zero.
pub fn check(named: &Named) -> Result<(), ModelError> {
    for (name, (_, values)) in named {
        let odd = |refused: &dyn Fn(f32) -> bool| {
            let at = values.iter().position(|value| refused(*value))?;
            Some((at, values[at]))
        };
        if let Some((at, value)) = odd(&|value| !value.is_finite()) {
            let what = format!("{name:?} holds {value} (value {at}); expected finite numbers");
            return Err(ModelError::Values { what });
        }
        if name.ends_with("running_var")
            && let Some((at, value)) = odd(&|value| value < 0.0)
        {
            let what = format!(
                "{name:?} holds {value} (value {at}); expected 0 or more: a variance cannot be negative"
            );
            return Err(ModelError::Values { what });
        }
    }
    Ok(())
}

fn each<const N: usize>(bytes: &[u8], to: impl Fn([u8; N]) -> f32) -> Vec<f32> {
    let whole = bytes.as_chunks::<N>().0;
    whole.iter().map(|b| to(*b)).collect()
}

/// Converts our parameters to PyTorch's: one-hot channels join the dense channels in front of them.
pub fn to_torch(mut named: Named) -> Named {
    let apart: Vec<String> = named
        .keys()
        .filter(|n| n.ends_with(ONE_HOT))
        .cloned()
        .collect();
    for name in apart {
        let (second, late) = named.remove(&name).expect("listed above");
        let joined = name.trim_end_matches(ONE_HOT).to_owned();
        let (first, early) = named.remove(&joined).expect("declared beside it");
        let values = interleave(&early, first[1] * 9, &late, second[1] * 9);
        let shape = vec![first[0], first[1] + second[1], 3, 3];
        named.insert(joined, (shape, values));
    }
    named
}

/// Converts PyTorch's parameters (a state dict, also one of a wrapped or combined model) to ours.
///
/// # Errors
/// [`ModelError::Weights`] if a joined weight has too few channels.
pub fn from_torch(named: Named, declared: &[Declared], part: &str) -> Result<Named, ModelError> {
    let mut out = Named::new();
    for (name, value) in named {
        let name = name.strip_prefix("module.").unwrap_or(&name);
        let name = match name.split_once("_model.") {
            Some((which, rest)) if which == part => rest,
            Some(_) => continue,
            None => name,
        };
        out.insert(name.to_owned(), value);
    }
    for d in declared.iter().filter(|d| d.name.ends_with(ONE_HOT)) {
        let joined = d.name.trim_end_matches(ONE_HOT);
        let Some((shape, values)) = out.remove(joined) else {
            continue;
        };
        let late = d.shape[1];
        if shape.len() != 4 || shape[1] <= late {
            let what =
                format!("{joined:?} has shape {shape:?}: too few channels for {late} one-hot ones");
            return Err(ModelError::weights(what));
        }
        let early = shape[1] - late;
        let (mut first, mut second) = (Vec::new(), Vec::new());
        for row in values.chunks_exact(shape[1] * 9) {
            first.extend_from_slice(&row[..early * 9]);
            second.extend_from_slice(&row[early * 9..]);
        }
        out.insert(joined.to_owned(), (vec![shape[0], early, 3, 3], first));
        out.insert(d.name.clone(), (vec![shape[0], late, 3, 3], second));
    }
    Ok(out)
}

fn interleave(a: &[f32], of_a: usize, b: &[f32], of_b: usize) -> Vec<f32> {
    let rows = a.chunks_exact(of_a).zip(b.chunks_exact(of_b));
    rows.flat_map(|(a, b)| [a, b].concat()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn half_precision_is_read_as_the_numbers_it_stands_for() {
        let values = [1.0f32, -0.5, 65504.0, 6e-8];
        let half: Vec<u8> = values
            .iter()
            .flat_map(|v| f16::from_f32(*v).to_le_bytes())
            .collect();
        let brain: Vec<u8> = values
            .iter()
            .flat_map(|v| bf16::from_f32(*v).to_le_bytes())
            .collect();
        let view = |dtype, bytes| TensorView::new(dtype, vec![4], bytes).unwrap();
        let views = [
            ("half", view(Dtype::F16, &half[..])),
            ("brain", view(Dtype::BF16, &brain[..])),
        ];
        let bytes = safetensors::serialize(views, None).unwrap();
        let (named, _) = read(&bytes).unwrap();
        let expected = values.map(|v| f16::from_f32(v).to_f32());
        assert_eq!(named["half"], (vec![4], expected.to_vec()));
        let expected = values.map(|v| bf16::from_f32(v).to_f32());
        assert_eq!(named["brain"], (vec![4], expected.to_vec()));
    }
}
