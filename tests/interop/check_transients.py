"""Compares what docs/python/transients.py reads of a data set with its packed export, decoded by the lines that the export
states: check_transients.py DATASET EXPORT [CONVERTED...]. CONVERTED are folders that docs/python/convert.py wrote.

Prints how many scenes and saturated bins there were, as JSON.
"""

import io
import json
import pathlib
import sys
import tarfile

import h5py
import numpy
import zarr

sys.path.insert(0, str(pathlib.Path(__file__).parents[2] / "docs" / "python"))
from transients import Transients

ARRAYS = ("transient", "depth", "intensity", "specular", "visibility", "spots", "intrinsics")


def same(what, found, expected):
    if found.dtype != expected.dtype or not numpy.array_equal(found, expected, equal_nan=expected.dtype.kind == "f"):
        sys.exit(f"{what}: {found.dtype} {found.shape} is not {expected.dtype} {expected.shape}, or has other values")


def decoded(export, group, i):
    """Arrays of scene i of an export."""
    names = {"zarr": zarr, "numpy": numpy, "json": json, "pathlib": pathlib, "location": export, "i": i}
    exec("\n".join(group["transient"].attrs["decode_zarr_python"]), names)
    lit = numpy.unpackbits(group["visibility"][i], axis=0, bitorder="little", count=group["visibility"].attrs["spots"])
    stored = {name: group[name][i] for name in ("depth", "intensity", "specular", "spots", "intrinsics")}
    return stored | {"transient": names["h"], "visibility": lit}


def converted(folder):
    """Scenes of a folder with HDF5 files or tar files, in their order."""
    for path in sorted(folder.glob("*.h5")):
        with h5py.File(path) as file:
            assert file.attrs["scene"] == int(path.stem)
            yield {name: values[()] for name, values in file.items()}
    for path in sorted(folder.glob("*.tar")):
        with tarfile.open(path) as file:
            for name in file.getnames():
                arrays = numpy.load(io.BytesIO(file.extractfile(name).read()))
                assert arrays["scene"] == int(name.removesuffix(".npz"))
                yield {name: arrays[name] for name in ARRAYS}


location, export = sys.argv[1:3]
scenes, group = Transients(location), zarr.open_group(export, mode="r")
indices = group["source_scene"][:]
assert len(scenes) == len(indices) > 0, (scenes.scenes, indices)
others = [list(converted(pathlib.Path(folder))) for folder in sys.argv[3:]]
saturated = 0
for i, index in enumerate(indices):
    scene = scenes[i]
    assert scene["scene"] == index
    manifest = json.loads((pathlib.Path(export) / "manifests" / f"{i // 16}.json").read_text())[i % 16]
    saturated += len(manifest["overflow"])
    want = decoded(export, group, i)
    for name in ARRAYS:
        same(f"scene {index}: {name}", scene[name], want[name])
        for other in others:
            same(f"scene {index}: converted {name}", other[i][name], want[name])

    row, column, height, width, first, end = 5, 3, 20, 17, 7, 40
    rows, columns = slice(row, row + height), slice(column, column + width)
    part = scenes.read(scene["scene"], crop=(row, column, height, width), bins=(first, end))
    same("crop", part["transient"], want["transient"][rows, columns, first:end])
    for name in ("depth", "intensity", "specular"):
        same(f"crop of {name}", part[name], want[name][rows, columns])
    same("crop of visibility", part["visibility"], want["visibility"][:, rows, columns])
    same("intrinsics of a crop", part["intrinsics"], want["intrinsics"] - numpy.array([0, 0, column, row], "float32"))
for other in others:
    assert len(other) == len(indices), len(other)
print(json.dumps({"scenes": len(scenes), "saturated": saturated}))
