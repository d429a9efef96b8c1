"""Opens a picofarm data set with zarr, xarray and tensorstore and compares what they give.

    python readers.py DATASET [SCENE]
"""

import atexit
import os
import sys
import time

import numpy
import tensorstore
import xarray
import zarr


def zarr_store(location):
    """What zarr and xarray open: a folder's name, or a store for an s3:// URL (credentials from AWS_... variables)."""
    if "://" not in location:
        return location
    import obstore

    # A moment for its threads before the interpreter ends (https://github.com/PyO3/pyo3-async-runtimes/issues/40).
    atexit.register(time.sleep, 0.2)

    return zarr.storage.ObjectStore(obstore.store.from_url(location), read_only=True)


def with_zarr(location, i):
    group = zarr.open_group(zarr_store(location), mode="r", zarr_format=3)
    return group["transient"][i], group["scale"][i]


def with_xarray(location, i):
    ds = xarray.open_zarr(zarr_store(location))
    gate = ds.attrs["gate"]
    # Coordinates that follow from the attributes are not stored: optical path in metres at the middle of each bin.
    path = gate["start_m"] + (numpy.arange(ds.sizes["bin"]) + 0.5) * gate["bin_width_m"]
    ds = ds.assign_coords(path=("bin", path), time=("bin", path / ds.attrs["speed_of_light_m_s"]))
    print("xarray:", dict(ds.sizes), f"paths of {path[0]:.3f} to {path[-1]:.3f} m")
    scene = ds.isel(scene=i)
    return scene["transient"].values, scene["scale"].values


def kvstore(location, array):
    """Where tensorstore finds an array. It has S3 built in, but does not read every AWS_... variable by itself."""
    if "://" not in location:
        return {"driver": "file", "path": os.path.join(os.path.abspath(location), array, "")}
    bucket, _, prefix = location.removeprefix("s3://").partition("/")
    found = {"driver": "s3", "bucket": bucket, "path": f"{prefix.rstrip('/')}/{array}/"}
    if "AWS_ENDPOINT_URL" in os.environ:
        found |= {"endpoint": os.environ["AWS_ENDPOINT_URL"], "aws_region": os.environ.get("AWS_REGION", "us-east-1")}
    if "AWS_ACCESS_KEY_ID" in os.environ:
        found["aws_credentials"] = {"type": "environment"}
    return found


def with_tensorstore(location, i):
    opened = [tensorstore.open({"driver": "zarr3", "kvstore": kvstore(location, a)}, read=True) for a in ("transient", "scale")]
    return [array.result()[i].read().result() for array in opened]


def main():
    location, i = sys.argv[1].removeprefix("file://"), int(sys.argv[2]) if len(sys.argv) > 2 else 0
    q, scale = with_zarr(location, i)
    print("zarr:", q.shape, q.dtype, f"{scale:g} photons a unit")
    for reader in (with_xarray, with_tensorstore):
        other, other_scale = reader(location, i)
        if not (numpy.array_equal(q, other) and scale == other_scale):
            raise SystemExit(f"{reader.__name__}: other values than zarr's")
    print("all three agree")


if __name__ == "__main__":
    main()
