"""Compares what the Python package reads with what the program exports: check_transients.py DATASET HDF5-FOLDER.

Prints how many saturated bins there were, as JSON.
"""

import json
import pathlib
import sys

import h5py
import numpy

import picofarm


def same(what, found, expected):
    if found.dtype != expected.dtype or not numpy.array_equal(found, expected, equal_nan=expected.dtype.kind == "f"):
        sys.exit(f"{what}: {found.dtype} {found.shape} is not {expected.dtype} {expected.shape}, or has other values")


location, exported = sys.argv[1], pathlib.Path(sys.argv[2])
scenes = picofarm.open(location)
files = sorted(exported.glob("*.h5"))
assert len(files) == len(scenes) > 0, (files, scenes.scenes)
saturated = 0
for index, path in enumerate(files):
    scene = scenes[index]
    with h5py.File(path) as file:
        assert file.attrs["scene"] == scene["scene"] == int(path.stem)
        saturated += len(json.loads(file["manifest"][0])["overflow"])
        want = {name: file[name][()] for name in ("transient", "depth", "intensity", "specular", "visibility", "spots", "intrinsics")}
    for name, expected in want.items():
        same(f"{path.name} {name}", scene[name], expected)

    row, column, height, width, first, end = 5, 3, 20, 17, 7, 40
    rows, columns = slice(row, row + height), slice(column, column + width)
    part = scenes.read(scene["scene"], crop=(row, column, height, width), bins=(first, end))
    same("crop", part["transient"], want["transient"][rows, columns, first:end])
    for name in ("depth", "intensity", "specular"):
        same(f"crop of {name}", part[name], want[name][rows, columns])
    same("crop of visibility", part["visibility"], want["visibility"][:, rows, columns])
    same("intrinsics of a crop", part["intrinsics"], want["intrinsics"] - numpy.array([0, 0, column, row], "float32"))
print(json.dumps({"scenes": len(scenes), "saturated": saturated}))
