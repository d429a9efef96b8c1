"""Reads a picofarm data set and a render group with zarr-python and xarray alone, and compares exact values.

usage: read_dataset.py DATASET SCENE EXPECTED RENDER

EXPECTED is a folder with `shapes.json` (name -> [dtype, shape]) and one raw little-endian file `<name>.bin` for each
array as picofarm's own reader returns it. Scene SCENE + 1 must be missing. RENDER is a render group whose array
`transient` equals the expected `h`. Exits non-zero at the first difference.
"""

import json
import pathlib
import sys
import warnings

import numpy as np
import xarray as xr
import zarr

warnings.simplefilter("error")  # a data set must open without complaints


def same(name, found, expected):
    assert found.dtype == expected.dtype, f"{name}: {found.dtype}, expected {expected.dtype}"
    assert found.shape == expected.shape, f"{name}: {found.shape}, expected {expected.shape}"
    if not np.array_equal(found, expected, equal_nan=found.dtype.kind == "f"):
        at = np.argwhere(found != expected)[0]
        raise AssertionError(f"{name} differs at {at}: {found[tuple(at)]}, expected {expected[tuple(at)]}")
    print(f"{name}: {found.dtype} {found.shape} equal")


def main(dataset, scene, folder, render):
    scene = int(scene)
    folder = pathlib.Path(folder)
    expected = {
        name: np.fromfile(folder / f"{name}.bin", dtype=dtype).reshape(shape)
        for name, (dtype, shape) in json.loads((folder / "shapes.json").read_text()).items()
    }

    group = zarr.open_group(dataset, mode="r")
    assert group.metadata.consolidated_metadata is not None, "the root has no consolidated metadata"
    attributes = dict(group.attrs)
    assert attributes["visibility_polarity"] == "1 = lit"
    spec = attributes["picofarm"]["spec"]
    for name in sorted(group.array_keys()):
        if name in expected:
            same(f"zarr {name}", np.asarray(group[name][scene]), expected[name])

    # The five lines of `decode`, as stored, give what picofarm's reader gives.
    xarray, numpy = xr, np
    names = {"xarray": xarray, "numpy": numpy, "location": dataset, "i": scene}
    exec("\n".join(attributes["decode"]), names)
    h = names["h"]
    manifest = json.loads((pathlib.Path(dataset) / "manifests" / f"{scene}.json").read_text())
    h = np.array(h)
    if spec["profile"]["name"] != "plain-f32":
        saturated = np.flatnonzero(group["transient"][scene].ravel() == 65535)
        same("saturated bins", saturated, np.array([at for at, _ in manifest["overflow"]], dtype=saturated.dtype))
    for at, value in manifest["overflow"]:
        h.ravel()[at] = np.float32(value)
    same("decoded h", h, expected["h"])
    same("decoded visibility", names["lit"], expected["lit"])

    # The five lines of the array itself, with zarr-python alone, give the saturated bins too.
    lines = group["transient"].attrs["decode_zarr_python"]
    assert len(lines) <= 5, lines
    names = {"zarr": zarr, "numpy": np, "json": json, "pathlib": pathlib, "location": dataset, "i": scene}
    exec("\n".join(lines), names)
    same("decoded by the array's attributes", names["h"], expected["h"])
    assert manifest["error"]["overflowed"] == len(manifest["overflow"])
    assert manifest["error"]["rms_sigma"] <= manifest["error"]["max_sigma"] < 0.6

    ds = xr.open_zarr(dataset)
    assert dict(ds.sizes)["scene"] == spec["scenes"], ds.sizes
    assert ds["transient"].dims == ("scene", "bin", "row", "column")
    assert ds["visibility"].dims == ("scene", "spot_byte", "row", "column")
    same("xarray depth", ds["depth"][scene].values, expected["depth"])
    same("xarray crop", ds["transient"][scene, :, 3:34, 30:].values, expected["transient"][:, 3:34, 30:])
    normal = ds["normal"][scene].values
    assert normal.dtype.kind == "f" and np.abs(normal - expected["n"]).max() < 1e-6, "xarray's normals"

    missing = scene + 1
    assert (group["transient"][missing] == 0).all()
    assert np.isnan(group["scale"][missing]) and np.isnan(group["spots"][missing]).all()
    print("missing scene reads as fill")

    single = xr.open_zarr(render)
    same("render group", single["transient"].values, np.moveaxis(expected["h"], 0, -1))
    assert single["transient"].dims == ("row", "column", "bin")
    assert single.attrs["note"] == "made by a test"


main(*sys.argv[1:])
