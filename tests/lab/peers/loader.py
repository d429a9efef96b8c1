"""Compares the readers of a data set: loader.py DATASET [--scenes N].

Prints CPU seconds and wall seconds per read of the Python package, zarr-python and tensorstore, for whole scenes, aligned
crops of 64x64 pixels and single bins. All read the same scenes in the same process, in turns, and the values are compared.
All compare chunks with their CRC-32C; the package also reads the manifest of each scene.
"""

import argparse
import time

import numpy
import tensorstore
import zarr

import picofarm


def decoded(stored, coding, scale):
    """The histogram that zarr-python and tensorstore users compute from the stored codes."""
    h = stored.astype("float32")
    h *= numpy.float32(coding["delta"] / 2)
    h *= h
    h /= scale
    return h


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dataset")
    parser.add_argument("--scenes", type=int, default=3)
    parser.add_argument("--rounds", type=int, default=3)
    args = parser.parse_args()
    package = picofarm.open(args.dataset, arrays=["transient"])
    group = zarr.open_group(args.dataset, mode="r")
    coding = group["transient"].attrs.asdict()
    if "delta" not in coding:
        raise SystemExit(f"{args.dataset}: expected the profile sqrt-u16")
    spec = {"driver": "zarr3", "kvstore": {"driver": "file", "path": f"{args.dataset}/transient/"}}
    tensor = tensorstore.open(spec, read=True).result()
    height, width, bins = group["transient"].shape[1:]
    parts = {
        "whole": (slice(0, height), slice(0, width), slice(0, bins)),
        "crop 64x64": (slice(64, 128), slice(64, 128), slice(0, bins)),
        "one bin": (slice(0, height), slice(0, width), slice(200, 201)),
    }
    scenes = package.scenes[: args.scenes]

    def with_package(scene, rows, columns, span):
        crop = (rows.start, columns.start, rows.stop - rows.start, columns.stop - columns.start)
        return package.read(scene, crop=crop, bins=(span.start, span.stop))["transient"]

    def with_zarr(scene, *part):
        return decoded(group["transient"][scene, *part], coding, group["scale"][scene])

    def with_tensorstore(scene, *part):
        return decoded(tensor[scene, *part].read().result(), coding, group["scale"][scene])

    readers = {"picofarm": with_package, "zarr-python": with_zarr, "tensorstore": with_tensorstore}
    for name, part in parts.items():
        spent = {reader: [] for reader in readers}
        for _ in range(args.rounds):
            for scene in scenes:
                first = None
                for reader, read in readers.items():
                    cpu, wall = time.process_time(), time.perf_counter()
                    h = read(scene, *part)
                    spent[reader].append((time.process_time() - cpu, time.perf_counter() - wall))
                    if first is None:
                        first = h
                    apart = numpy.mean(~numpy.isclose(h, first, rtol=1e-5))
                    # Others do not know the exact values of saturated bins.
                    if apart > 1e-3:
                        raise SystemExit(f"{reader}: {apart:.1%} of the values differ")
        base = numpy.median([cpu for cpu, _ in spent["picofarm"]])
        for reader, times in spent.items():
            cpu, wall = numpy.median(times, axis=0)
            print(f"{name:12} {reader:12} {1000 * cpu:8.1f} CPU ms {1000 * wall:8.1f} ms {cpu / base:6.1f}x")


if __name__ == "__main__":
    main()
