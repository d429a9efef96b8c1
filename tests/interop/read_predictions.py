"""Reads predictions with zarr-python and xarray and compares them with raw values: GROUP SCENE EXPECTED_FOLDER."""

import json
import pathlib
import sys

import numpy as np
import xarray as xr
import zarr

group, scene, expected = sys.argv[1], int(sys.argv[2]), pathlib.Path(sys.argv[3])
shapes = json.loads((expected / "shapes.json").read_text())
root = zarr.open_group(group, mode="r")
assert sorted(name for name, _ in root.arrays()) == sorted(shapes), (list(root.arrays()), shapes)
for name, (dtype, shape) in shapes.items():
    wanted = np.fromfile(expected / f"{name}.bin", dtype).reshape(shape)
    array = root[name]
    assert array.dtype == np.dtype(dtype) and array.shape[1:] == tuple(shape), (name, array)
    assert array.chunks == (1, *shape), (name, array.chunks)
    np.testing.assert_array_equal(array[scene], wanted, err_msg=name)
    other = array[(scene + 1) % array.shape[0]]
    assert np.all(np.isnan(other) if name == "depth" else other == 0), f"{name}: a missing scene is not fill"
data = xr.open_zarr(group, consolidated=True)
assert data["depth"].dims == ("scene", "row", "column"), data["depth"]
assert data["lit"].dims == ("scene", "spot", "row", "column"), data["lit"]
lit = np.fromfile(expected / "lit.bin", "|u1").reshape(shapes["lit"][1])
np.testing.assert_allclose(data["lit"][scene].values, lit / 255.0, rtol=1e-6)  # xarray applies scale_factor
assert list(root["lit"].attrs["spots"]) == [3, 5], dict(root["lit"].attrs)
print(f"{sorted(shapes)} of scene {scene} read the same")
