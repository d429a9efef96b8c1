//! Converts compressed, sparse and quantised data of a glTF file to plain arrays, which are
//! appended to the file's buffers. Everything that follows reads plain arrays only.

mod packed;

use std::collections::BTreeMap;

use gltf::{
    Semantic,
    accessor::DataType,
    json::{
        self, Index, Root,
        accessor::{ComponentType, GenericComponentType},
        validation::{Checked, USize64},
    },
};

/// The greatest number of bytes of all converted data of one file.
const MAX_BYTES: usize = 1 << 29;
const INSTANCING: &str = "EXT_mesh_gpu_instancing";

/// Converts the data that meshes, skins and instances use.
///
/// # Errors
/// The fault in the file, with its place.
pub(super) fn convert(root: &mut Root, buffers: &mut Vec<Vec<u8>>) -> Result<(), String> {
    let mut plain = Plain {
        buffer: root.buffers.len(),
        root,
        buffers,
        bytes: Vec::new(),
    };
    plain.meshopt_views()?;
    plain.draco_primitives()?;
    let used = plain.used()?;
    for (accessor, as_floats) in used {
        let at = |what: String| format!("accessors[{accessor}]: {what}");
        plain.dense(accessor).map_err(at)?;
        if as_floats {
            plain.floats(accessor).map_err(at)?;
        }
    }
    plain.complete();
    let (bytes, buffer) = (plain.bytes, plain.buffer);
    if !bytes.is_empty() {
        debug_assert_eq!(buffer, buffers.len());
        root.buffers.push(json::Buffer {
            byte_length: USize64::from(bytes.len()),
            name: None,
            // No longer read: it only tells the buffer from a binary chunk.
            uri: Some("data:,".into()),
            extensions: None,
            extras: Default::default(),
        });
        buffers.push(bytes);
    }
    Ok(())
}

struct Plain<'a> {
    root: &'a mut Root,
    buffers: &'a [Vec<u8>],
    /// The index of the buffer of converted data.
    buffer: usize,
    /// Its bytes.
    bytes: Vec<u8>,
}

impl Plain<'_> {
    /// Returns bytes of a buffer.
    fn part(&self, buffer: usize, offset: usize, length: usize) -> Result<&[u8], String> {
        let whole = match buffer == self.buffer {
            true => Some(&self.bytes),
            false => self.buffers.get(buffer),
        };
        let whole = whole.ok_or_else(|| format!("there is no buffers[{buffer}]"))?;
        let end = offset.checked_add(length);
        end.and_then(|end| whole.get(offset..end)).ok_or_else(|| {
            format!(
                "{length} bytes from {offset} do not fit buffers[{buffer}] of {} bytes; the file is damaged, export it again",
                whole.len()
            )
        })
    }

    fn view(&self, index: usize) -> Result<&[u8], String> {
        let view = self.root.buffer_views.get(index);
        let view = view.ok_or_else(|| format!("there is no bufferViews[{index}]"))?;
        let offset = view.byte_offset.map_or(0, |o| o.0 as usize);
        self.part(view.buffer.value(), offset, view.byte_length.0 as usize)
    }

    /// Checks that this number of bytes may be added.
    fn room(&self, count: usize, each: usize) -> Result<usize, String> {
        count
            .checked_mul(each)
            .filter(|bytes| self.bytes.len() + bytes <= MAX_BYTES)
            .ok_or_else(|| {
                format!("{count} elements: more than {MAX_BYTES} bytes of compressed data in all; split the scene")
            })
    }

    /// Appends bytes and returns their offset.
    fn append(&mut self, bytes: &[u8]) -> usize {
        let offset = self.bytes.len();
        self.bytes.extend_from_slice(bytes);
        self.bytes.resize(self.bytes.len().next_multiple_of(4), 0);
        offset
    }

    /// Appends bytes as a view of their own.
    fn append_view(&mut self, bytes: &[u8]) -> Index<json::buffer::View> {
        let offset = self.append(bytes);
        self.root.buffer_views.push(json::buffer::View {
            buffer: Index::new(self.buffer as u32),
            byte_length: USize64::from(bytes.len()),
            byte_offset: Some(USize64::from(offset)),
            byte_stride: None,
            name: None,
            target: None,
            extensions: None,
            extras: Default::default(),
        });
        Index::new(self.root.buffer_views.len() as u32 - 1)
    }

    /// Returns the accessors that are read, each with whether it must have floats.
    fn used(&self) -> Result<BTreeMap<usize, bool>, String> {
        let mut used: BTreeMap<usize, bool> = BTreeMap::new();
        let mut add = |index: usize, floats: bool| *used.entry(index).or_default() |= floats;
        for primitive in self.root.meshes.iter().flat_map(|m| &m.primitives) {
            for (semantic, accessor) in &primitive.attributes {
                if let Checked::Valid(semantic) = semantic
                    && is_read(semantic)
                {
                    let floats = matches!(semantic, Semantic::Positions | Semantic::TexCoords(_));
                    add(accessor.value(), floats);
                }
            }
            if let Some(indices) = primitive.indices {
                add(indices.value(), false);
            }
            let targets = primitive.targets.iter().flatten();
            targets
                .filter_map(|t| t.positions)
                .for_each(|a| add(a.value(), true));
        }
        for skin in &self.root.skins {
            if let Some(inverse) = skin.inverse_bind_matrices {
                add(inverse.value(), false);
            }
        }
        for node in &self.root.nodes {
            let extension = node
                .extensions
                .as_ref()
                .and_then(|e| e.others.get(INSTANCING));
            let attributes = extension.and_then(|e| e.get("attributes")?.as_object());
            for (name, accessor) in attributes.into_iter().flatten() {
                if ["TRANSLATION", "ROTATION", "SCALE"].contains(&&**name)
                    && let Some(index) = accessor.as_u64()
                {
                    add(index as usize, true);
                }
            }
        }
        // Others are reported where they are used.
        used.retain(|index, _| *index < self.root.accessors.len());
        Ok(used)
    }

    /// Gives an accessor without a view, or with sparse replacements, a view of its own.
    fn dense(&mut self, index: usize) -> Result<(), String> {
        let accessor = &self.root.accessors[index];
        if accessor.buffer_view.is_some() && accessor.sparse.is_none() {
            return Ok(());
        }
        let (_, size) = shape(accessor)?;
        let count = accessor.count.0 as usize;
        self.room(count, size)?;
        let mut bytes = match accessor.buffer_view {
            None => vec![0; count * size],
            Some(_) => self.packed(accessor, size)?,
        };
        if let Some(sparse) = &accessor.sparse {
            let Checked::Valid(kind) = sparse.indices.component_type else {
                return Err("sparse.indices: has an unknown componentType".into());
            };
            let (each, replaced) = (kind.0.size(), sparse.count.0 as usize);
            let inner = |view: usize, offset: u64, each: usize| {
                let view = self.view(view)?;
                let length = replaced.checked_mul(each);
                let end = length.and_then(|l| l.checked_add(offset as usize));
                end.and_then(|end| view.get(offset as usize..end))
                    .ok_or_else(|| {
                        format!("sparse: {replaced} elements do not fit their bufferView")
                    })
            };
            let places = &sparse.indices;
            let places = inner(places.buffer_view.value(), places.byte_offset.0, each)?;
            let values = inner(
                sparse.values.buffer_view.value(),
                sparse.values.byte_offset.0,
                size,
            )?;
            for (place, value) in places.chunks_exact(each).zip(values.chunks_exact(size)) {
                let mut wide = [0u8; 8];
                wide[..each].copy_from_slice(place);
                let place = usize::try_from(u64::from_le_bytes(wide)).unwrap_or(usize::MAX);
                let old = place
                    .checked_mul(size)
                    .and_then(|at| bytes.get_mut(at..at + size));
                old.ok_or_else(|| format!("sparse: index {place} points past {count} elements"))?
                    .copy_from_slice(value);
            }
        }
        let view = self.append_view(&bytes);
        let accessor = &mut self.root.accessors[index];
        (accessor.buffer_view, accessor.byte_offset, accessor.sparse) = (Some(view), None, None);
        Ok(())
    }

    /// Gives the accessors that nothing reads a view, because the crate's validation wants one.
    fn complete(&mut self) {
        let bare = |a: &json::Accessor| a.buffer_view.is_none() && a.sparse.is_none();
        if !self.root.accessors.iter().any(bare) {
            return;
        }
        let view = self.append_view(&[0; 4]);
        for accessor in self.root.accessors.iter_mut().filter(|a| bare(a)) {
            accessor.buffer_view = Some(view);
        }
    }

    /// Returns the elements of an accessor without gaps.
    fn packed(&self, accessor: &json::Accessor, size: usize) -> Result<Vec<u8>, String> {
        let Some(view) = accessor.buffer_view else {
            return Err("has no bufferView".into());
        };
        let bytes = self.view(view.value())?;
        let stride = self.root.buffer_views[view.value()].byte_stride;
        let stride = stride.map_or(size, |s| s.0);
        let offset = accessor.byte_offset.map_or(0, |o| o.0 as usize);
        let count = accessor.count.0 as usize;
        let last = count.checked_sub(1).and_then(|n| {
            n.checked_mul(stride)?
                .checked_add(offset)?
                .checked_add(size)
        });
        if count > 0 && (stride < size || last.is_none_or(|end| end > bytes.len())) {
            return Err(format!(
                "{count} elements do not fit its bufferView of {} bytes; the file is damaged, export it again",
                bytes.len()
            ));
        }
        let mut packed = Vec::with_capacity(count * size);
        for k in 0..count {
            let at = offset + k * stride;
            packed.extend_from_slice(&bytes[at..at + size]);
        }
        Ok(packed)
    }

    /// Converts the integers of an accessor to floats (`KHR_mesh_quantization`).
    fn floats(&mut self, index: usize) -> Result<(), String> {
        let accessor = &self.root.accessors[index];
        let (kind, size) = shape(accessor)?;
        let normalized = accessor.normalized;
        let integers = [DataType::I8, DataType::U8, DataType::I16, DataType::U16];
        if !integers.contains(&kind) {
            return Ok(());
        }
        self.room(accessor.count.0 as usize, size * 4)?;
        let packed = self.packed(accessor, size)?;
        let float = |x: f32, most: f32| match normalized {
            true => (x / most).max(-1.0),
            false => x,
        };
        let numbers: Vec<u8> = match kind {
            DataType::I8 => packed
                .iter()
                .flat_map(|b| float(f32::from(*b as i8), 127.0).to_le_bytes())
                .collect(),
            DataType::U8 => packed
                .iter()
                .flat_map(|b| float(f32::from(*b), 255.0).to_le_bytes())
                .collect(),
            DataType::I16 => {
                let words = packed
                    .as_chunks::<2>()
                    .0
                    .iter()
                    .map(|b| i16::from_le_bytes(*b));
                words
                    .flat_map(|x| float(f32::from(x), 32767.0).to_le_bytes())
                    .collect()
            }
            _ => {
                let words = packed
                    .as_chunks::<2>()
                    .0
                    .iter()
                    .map(|b| u16::from_le_bytes(*b));
                words
                    .flat_map(|x| float(f32::from(x), 65535.0).to_le_bytes())
                    .collect()
            }
        };
        let view = self.append_view(&numbers);
        let accessor = &mut self.root.accessors[index];
        (accessor.buffer_view, accessor.byte_offset) = (Some(view), None);
        accessor.component_type = component(ComponentType::F32);
        accessor.normalized = false;
        Ok(())
    }
}

fn component(kind: ComponentType) -> Checked<GenericComponentType> {
    Checked::Valid(GenericComponentType(kind))
}

/// Returns whether an attribute is read at all.
fn is_read(semantic: &Semantic) -> bool {
    !matches!(
        semantic,
        Semantic::Normals | Semantic::Tangents | Semantic::Extras(_)
    )
}

/// Returns the type of an accessor's numbers and the size of its elements, bytes.
fn shape(accessor: &json::Accessor) -> Result<(DataType, usize), String> {
    match (accessor.component_type, accessor.type_) {
        (Checked::Valid(kind), Checked::Valid(each)) => {
            Ok((kind.0, kind.0.size() * each.multiplicity()))
        }
        _ => Err("has an unknown type or componentType; export the file again".into()),
    }
}
