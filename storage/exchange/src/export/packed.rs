//! Packs several scenes into each object, so that whole data sets stay below the limit of 100,000
//! files on public hosts. Encoded chunks are copied without decoding: this is lossless and cheap.

use bytes::Bytes;
use futures::{StreamExt, TryStreamExt, stream};
use serde_json::{Map, Value, json};

use super::Output;
use picofarm_dataset::ChunkCodec;
use picofarm_dataset::DatasetSpec;
use picofarm_dataset::Element;
use picofarm_dataset::Manifest;
use picofarm_dataset::shard;
use picofarm_dataset::{Dataset, root_metadata};
use picofarm_dataset::{Layout, index_codecs};
use picofarm_dataset::{METADATA, pretty};
use picofarm_store::StorageError;

/// Format version of the packed layout.
const EXPORT_VERSION: u32 = 1;
/// Number of scenes in an object.
pub(super) const PACK: usize = 16;
/// Number of concurrent requests.
const CONCURRENCY: usize = 8;
/// Name of the array with the scenes' indices in the source.
pub(super) const SOURCE_SCENE: &str = "source_scene";

/// Checks that the source can be packed.
pub(super) fn check(source: &Dataset) -> Result<(), StorageError> {
    if source.spec().per_spot {
        let what = "a histogram for each spot is too large to pack; reprocess the data set into one with the spots \
                    you want to share, and export that";
        return Err(StorageError::invalid("spec.per_spot", what));
    }
    Ok(())
}

/// Writes the objects of pack `k` with `scenes`: one per quantity, and one with the scenes'
/// manifests, which are returned.
pub(super) async fn pack(
    source: &Dataset,
    scenes: &[u64],
    k: usize,
    out: &mut Output<'_>,
) -> Result<Vec<Manifest>, StorageError> {
    let reads = scenes.iter().map(|scene| source.manifest(*scene));
    let manifests: Vec<Manifest> = stream::iter(reads.collect::<Vec<_>>())
        .buffered(CONCURRENCY)
        .try_collect()
        .await?;
    for array in source.arrays().iter() {
        let reads = manifests.iter().map(|m| source.encoded_object(array, m));
        let objects: Vec<Bytes> = stream::iter(reads.collect::<Vec<_>>())
            .buffered(CONCURRENCY)
            .try_collect()
            .await?;
        let bytes = packed(&array.layout, &objects)?;
        let zeros = "/0".repeat(array.layout.shape.len());
        let key = format!("{}/c/{k}{zeros}", array.layout.quantity.name());
        out.put(&key, bytes.into()).await?;
    }
    // The manifests are serialized directly to text, like stored ones. Converting them to a `Value`
    // would give 32-bit floats the digits of 64-bit floats.
    let mut text = serde_json::to_vec_pretty(&manifests).expect("manifests are plain data");
    text.push(b'\n');
    out.put(&format!("manifests/{k}.json"), text.into()).await?;
    out.done.scenes += scenes.len() as u64;
    Ok(manifests)
}

/// Names directly below a packed export's folder, other than those of the arrays.
pub(super) const METADATA_NAMES: [&str; 3] = ["manifests", SOURCE_SCENE, METADATA];

/// Returns whether a packed export of a data set uses this name, directly below its folder.
pub(super) fn writes(source: &Dataset, name: &str) -> bool {
    let mut arrays = source.arrays().iter();
    METADATA_NAMES.contains(&name) || arrays.any(|array| array.layout.quantity.name() == name)
}

/// Writes the metadata, the root's last: the group exists only once all packs do.
pub(super) async fn finish(
    source: &Dataset,
    scenes: &[u64],
    out: &mut Output<'_>,
) -> Result<(), StorageError> {
    let spec = DatasetSpec {
        scenes: scenes.len() as u64,
        ..*source.spec()
    };
    let mut all = Map::new();
    for array in source.arrays().iter() {
        let metadata = metadata(&array.layout, spec.scenes);
        all.insert(array.layout.quantity.name().into(), metadata);
    }
    all.insert(SOURCE_SCENE.into(), put_source_scenes(scenes, out).await?);
    for (name, metadata) in &all {
        out.put(&format!("{name}/{METADATA}"), pretty(metadata))
            .await?;
    }
    let mut root = root_metadata(&spec);
    let attributes = root["attributes"].as_object_mut().expect("just made");
    attributes.remove("picofarm");
    attributes.insert(
        "picofarm_export".into(),
        json!({"format": EXPORT_VERSION, "scenes_a_file": PACK, "spec": spec}),
    );
    root["consolidated_metadata"]["metadata"] = Value::Object(all);
    out.put(METADATA, pretty(&rename_manifests(&root))).await
}

async fn put_source_scenes(scenes: &[u64], out: &mut Output<'_>) -> Result<Value, StorageError> {
    let codecs =
        json!([{"name": "bytes", "configuration": {"endian": "little"}}, {"name": "crc32c"}]);
    let n = scenes.len() as u64;
    // A data set has at most 2³² scenes.
    let values: Vec<u32> = scenes.iter().map(|s| *s as u32).collect();
    let codec = ChunkCodec::plain(&codecs, &[n], Element::U32);
    let bytes = codec.encode(bytemuck::cast_slice(&values))?;
    out.put(&format!("{SOURCE_SCENE}/c/0"), bytes.into())
        .await?;
    Ok(json!({
        "zarr_format": 3,
        "node_type": "array",
        "shape": [n],
        "data_type": Element::U32.name(),
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [n]}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "fill_value": 0,
        "codecs": codecs,
        "attributes": {"long_name": "index of the scene in the data set that this was exported from"},
        "dimension_names": ["scene"],
    }))
}

/// Joins the chunks of several scenes' objects in one shard.
fn packed(layout: &Layout, objects: &[Bytes]) -> Result<Vec<u8>, StorageError> {
    let each = inner_chunks(layout);
    let mut chunks: Vec<(usize, &[u8])> = Vec::with_capacity(PACK * each);
    for (scene, bytes) in objects.iter().enumerate() {
        if layout.inner.is_none() {
            chunks.push((scene, bytes));
            continue;
        }
        let Some(start) = bytes.len().checked_sub(shard::index_len(each)) else {
            let what = format!("{} bytes are too few", bytes.len());
            return Err(StorageError::codec("cannot read a shard's index", what));
        };
        let index = shard::parse_index(&bytes[start..], each, bytes.len() as u64)?;
        let mut own: Vec<_> = index.into_iter().enumerate().collect();
        // As in the data set, so that neighbouring chunks stay neighbours.
        own.sort_by_key(|(_, range)| range.as_ref().map(|r| r.start));
        chunks.extend(own.into_iter().filter_map(|(place, range)| {
            let range = range?;
            let bytes = &bytes[range.start as usize..range.end as usize];
            Some((scene * each + place, bytes))
        }));
    }
    shard::assemble(PACK * each, chunks.into_iter())
}

/// Returns the number of inner chunks of one scene.
fn inner_chunks(layout: &Layout) -> usize {
    match &layout.inner {
        None => 1,
        Some(inner) => {
            let sizes = layout.object_shape.iter().zip(inner);
            sizes.map(|(o, i)| (o / i) as usize).product()
        }
    }
}

/// Returns an array's `zarr.json`, with shards of [`PACK`] scenes.
fn metadata(layout: &Layout, scenes: u64) -> Value {
    let with_scenes = |first: u64, rest: &[u64]| -> Vec<u64> {
        std::iter::once(first).chain(rest.iter().copied()).collect()
    };
    let inner = layout.inner.as_ref().unwrap_or(&layout.object_shape);
    let mut metadata = layout.metadata(scenes);
    metadata["chunk_grid"]["configuration"]["chunk_shape"] =
        json!(with_scenes(PACK as u64, &layout.object_shape));
    metadata["codecs"] = json!([{"name": "sharding_indexed", "configuration": {
        "chunk_shape": with_scenes(1, inner),
        "codecs": layout.chunk_codecs(),
        "index_codecs": index_codecs(),
        "index_location": "end",
    }}]);
    rename_manifests(&metadata)
}

/// Replaces the location of a scene's manifest in texts by its location in the export.
fn rename_manifests(value: &Value) -> Value {
    let now = format!("manifests/<i//{PACK}>.json[i%{PACK}]");
    match value {
        Value::String(text) => {
            let text = text.replace("manifests/<i>.json", &now);
            let read = "manifests/{i}.json').read_text())";
            let there = format!("manifests/{{i // {PACK}}}.json').read_text())[i % {PACK}]");
            let text = text.replace(read, &there);
            Value::String(text.replace("manifests/<scene>.json", &now))
        }
        Value::Array(all) => all.iter().map(rename_manifests).collect(),
        Value::Object(all) => {
            let each = all.iter().map(|(k, v)| (k.clone(), rename_manifests(v)));
            Value::Object(each.collect())
        }
        other => other.clone(),
    }
}
