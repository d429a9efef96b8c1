"""Compares the readers of a data set: loader.py DATASET [--scenes N] [--workers 0,2,4].

DATASET is a folder or an s3:// URL. Prints CPU seconds and wall seconds per read of the Python package, zarr-python and
tensorstore, for whole scenes, aligned crops of 64x64 pixels, and bins at random places. All read the same scenes, in turns, and the
values are compared. All compare chunks with their CRC-32C; the package also reads the manifest of each scene. With
--workers, spawned processes of one decoding thread each read them, and scenes per second and CPU
milliseconds per scene are printed; 0 reads in this process.
"""

import argparse
import atexit
import multiprocessing
import os
import time

import numpy
import tensorstore
import zarr

import picofarm

PARTS = ("whole", "crop 64x64", "one bin", "64 bins")


def place(part, shape, draw):
    """The rows, columns and bins of a part. `draw` in [0, 1) chooses crops and bins."""
    height, width, bins = shape
    rows, columns, span = slice(0, height), slice(0, width), slice(0, bins)
    if part == "crop 64x64":
        top, left = (int(draw * ((n - 64) // 32 + 1)) * 32 for n in (height, width))
        rows, columns = slice(top, top + 64), slice(left, left + 64)
    elif part.endswith(("bin", "bins")):
        count = 1 if part == "one bin" else 64
        first = int(draw * (bins - count + 1))
        span = slice(first, first + count)
    return rows, columns, span


def zarr_store(location):
    if "://" not in location:
        return location
    import obstore

    # A moment for its threads before the interpreter ends (https://github.com/PyO3/pyo3-async-runtimes/issues/40).
    atexit.register(time.sleep, 0.2)
    return zarr.storage.ObjectStore(obstore.store.from_url(location), read_only=True)


def kvstore(location):
    if "://" not in location:
        return {"driver": "file", "path": os.path.join(os.path.abspath(location), "transient", "")}
    bucket, _, prefix = location.removeprefix("s3://").partition("/")
    found = {"driver": "s3", "bucket": bucket, "path": f"{prefix.rstrip('/')}/transient/"}
    if "AWS_ENDPOINT_URL" in os.environ:
        found |= {"endpoint": os.environ["AWS_ENDPOINT_URL"], "aws_region": os.environ.get("AWS_REGION", "us-east-1")}
    if "AWS_ACCESS_KEY_ID" in os.environ:
        found["aws_credentials"] = {"type": "environment"}
    return found


def decoded(stored, coding, scale):
    """The histogram that zarr-python and tensorstore users compute from the stored codes."""
    h = stored.astype("float32")
    h *= numpy.float32(coding["delta"] / 2)
    h *= h
    h /= scale
    return h


class Readers:
    """The three readers of one data set. `threads` bounds those that decode."""

    def __init__(self, location, threads=None):
        self.package = picofarm.open(location, arrays=["transient"], threads=threads)
        self.group = zarr.open_group(zarr_store(location), mode="r")
        if threads:
            zarr.config.set({"threading.max_workers": threads, "async.concurrency": 10})
        self.coding = self.group["transient"].attrs.asdict()
        if "delta" not in self.coding:
            raise SystemExit(f"{location}: expected the profile sqrt-u16")
        spec = {"driver": "zarr3", "kvstore": kvstore(location)}
        if threads:
            spec["context"] = {"data_copy_concurrency": {"limit": threads}}
        self.tensor = tensorstore.open(spec, read=True).result()
        self.scales = self.group["scale"][:]
        bins, height, width = self.group["transient"].shape[1:]
        self.shape = (height, width, bins)

    def read(self, reader, scene, part, draw):
        rows, columns, span = place(part, self.shape, draw)
        if reader == "picofarm":
            crop = (rows.start, columns.start, rows.stop - rows.start, columns.stop - columns.start)
            return self.package.read(scene, crop=crop, bins=(span.start, span.stop))["transient"]
        if reader == "zarr-python":
            stored = self.group["transient"][scene, span, rows, columns]
        else:
            stored = self.tensor[scene, span, rows, columns].read().result()
        # Views in picofarm's order, which copy nothing.
        return numpy.moveaxis(decoded(stored, self.coding, self.scales[scene]), 0, -1)


NAMES = ("picofarm", "zarr-python", "tensorstore")


def begin(location):
    global readers
    readers = Readers(location, threads=1)


def load(task):
    """Reads a part and returns the CPU seconds that it took."""
    cpu = time.process_time()
    readers.read(*task)
    return time.process_time() - cpu


def table(location, count, rounds):
    readers = Readers(location)
    scenes = readers.package.scenes[:count]
    random = numpy.random.default_rng(1)
    for part in PARTS:
        spent = {reader: [] for reader in NAMES}
        for _ in range(rounds):
            for scene in scenes:
                first, draw = None, random.random()
                for reader in NAMES:
                    cpu, wall = time.process_time(), time.perf_counter()
                    h = readers.read(reader, scene, part, draw)
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
            print(f"{part:12} {reader:12} {1000 * cpu:8.1f} CPU ms {1000 * wall:8.1f} ms {cpu / base:6.1f}x")


def by_workers(location, workers, count, rounds):
    scenes = picofarm.open(location).scenes[:count] * rounds
    draws = numpy.random.default_rng(1).random(len(scenes))
    for part in PARTS:
        for reader in NAMES:
            tasks = [(reader, scene, part, draw) for scene, draw in zip(scenes, draws, strict=True)]
            if workers == 0:
                begin(location)
                load(tasks[0])
                start = time.perf_counter()
                cpu = list(map(load, tasks))
                seconds = time.perf_counter() - start
            else:
                with multiprocessing.get_context("spawn").Pool(workers, begin, (location,)) as pool:
                    # Starts the processes and opens the arrays.
                    pool.map(load, tasks[:1] * workers, chunksize=1)
                    start = time.perf_counter()
                    cpu = pool.map(load, tasks, chunksize=1)
                    seconds = time.perf_counter() - start
                    # Lets the threads of the readers end.
                    pool.close()
                    pool.join()
            rate, cpu = len(tasks) / seconds, 1000 * numpy.mean(cpu)
            print(f"{workers} workers {part:12} {reader:12} {rate:8.1f} scenes/s {cpu:8.1f} CPU ms")


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dataset")
    parser.add_argument("--scenes", type=int, default=3)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--workers", help="numbers of processes, e.g. 0,2,4")
    args = parser.parse_args()
    if args.workers is None:
        return table(args.dataset, args.scenes, args.rounds)
    for workers in args.workers.split(","):
        by_workers(args.dataset, int(workers), args.scenes, args.rounds)


if __name__ == "__main__":
    main()
