"""Compares a packed export with the data set it was made from, by zarr-python and xarray alone.

usage: read_export.py DATASET EXPORT SCENE,SCENE,…

The scenes are those that the export must hold, in that order. Exits non-zero at the first difference.
"""

import json
import pathlib
import sys
import warnings

import numpy as np
import xarray as xr
import zarr

warnings.simplefilter("error")


def main(dataset, export, scenes):
    scenes = [int(s) for s in scenes.split(",")]
    source, packed = zarr.open_group(dataset, mode="r"), zarr.open_group(export, mode="r")
    assert packed["source_scene"][:].tolist() == scenes
    names = sorted(source.array_keys())
    assert sorted(packed.array_keys()) == sorted(names + ["source_scene"])
    for name in names:
        found, expected = packed[name], source[name]
        assert found.shape == (len(scenes),) + expected.shape[1:], (name, found.shape)
        for k, scene in enumerate(scenes):
            a, b = np.asarray(found[k]), np.asarray(expected[scene])
            assert a.dtype == b.dtype and a.tobytes() == b.tobytes(), f"{name}[{k}] differs from scene {scene}"
        print(f"{name}: {len(scenes)} scenes equal")
    for k, scene in enumerate(scenes):
        stored = json.loads((pathlib.Path(export) / "manifests" / f"{k // 16}.json").read_text())[k % 16]
        assert stored == json.loads((pathlib.Path(dataset) / "manifests" / f"{scene}.json").read_text())
    for i in range(len(scenes)):
        values = {"xarray": xr, "numpy": np, "location": export, "i": i}
        exec("\n".join(packed.attrs["decode"]), values)
    print("decodes")


if __name__ == "__main__":
    main(*sys.argv[1:])
