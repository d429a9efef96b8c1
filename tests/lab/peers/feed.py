"""Measures how fast processes feed a training: feed.py DATASET [--workers 1,2,4] [--cache DIR].

DATASET is a folder or an s3:// URL. Each process reads its share of an epoch with the stream of the
Python package (one decoding thread, whole scenes or crops of 64x64 pixels, with their depth), as
the workers of a PyTorch DataLoader do. Prints scenes per second of all processes and CPU milliseconds
per scene. --scenes repeats the scenes of the data set to as many. With --cache, the folder is
emptied before the first epoch.
"""

import argparse
import multiprocessing
import shutil
import time

import picofarm

PARTS = {"whole": None, "crop 64x64": 64}


def feed(location, scenes, rank, ranks, cache, crop, barrier, told):
    options = {"cache": cache} if cache else {}
    data = picofarm.open(
        location, scenes=scenes, arrays=["transient", "depth"], threads=1, **options
    )
    stream = data.stream(seed=1, rank=rank, ranks=ranks, crop=crop, ahead=2)
    for epoch in range(2):
        # Crops are equal in both epochs, so that a cache can have them.
        stream.set_epoch(0)
        barrier.wait()
        cpu, begin, count = time.process_time(), time.perf_counter(), 0
        for scene in stream:
            count += scene["transient"].shape[0] > 0
        told.put((epoch, count, time.process_time() - cpu, begin, time.perf_counter()))
        barrier.wait()


def measure(location, scenes, ranks, cache, crop):
    if cache:
        shutil.rmtree(cache, ignore_errors=True)
    context = multiprocessing.get_context("spawn")
    barrier, told = context.Barrier(ranks), context.Queue()
    fixed = (ranks, cache, crop, barrier, told)
    processes = [
        context.Process(target=feed, args=(location, scenes, rank, *fixed)) for rank in range(ranks)
    ]
    for process in processes:
        process.start()
    parts = [told.get() for _ in range(2 * ranks)]
    for process in processes:
        process.join()
    for epoch in range(2):
        of_epoch = [part for part in parts if part[0] == epoch]
        count = sum(part[1] for part in of_epoch)
        seconds = max(part[4] for part in of_epoch) - min(part[3] for part in of_epoch)
        cpu = 1000 * sum(part[2] for part in of_epoch) / count
        yield count / seconds, cpu


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dataset")
    parser.add_argument("--workers", default="1,2,4", help="numbers of processes")
    parser.add_argument("--scenes", type=int, default=48)
    parser.add_argument("--cache", help="a folder on a local disk, which is emptied")
    args = parser.parse_args()
    known = picofarm.open(args.dataset).scenes
    scenes = (known * (args.scenes // len(known) + 1))[: args.scenes]
    for part, crop in PARTS.items():
        for ranks in map(int, args.workers.split(",")):
            rates = measure(args.dataset, scenes, ranks, args.cache, crop)
            for epoch, (rate, cpu) in enumerate(rates, 1):
                shown = f"{part:12} {ranks} processes, epoch {epoch}"
                print(f"{shown} {rate:8.1f} scenes/s {cpu:8.1f} CPU ms", flush=True)


if __name__ == "__main__":
    main()
