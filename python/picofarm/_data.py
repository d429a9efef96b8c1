"""Data sets as sequences of scenes, for loops, notebooks and PyTorch."""

from __future__ import annotations

import json
import os
import warnings
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from . import _native
from ._arguments import Gate, to_xarray

if TYPE_CHECKING:
    import xarray

_Window = tuple[int, int, int, int]
_IMAGES = frozenset(
    "intensity depth range normal instance label specular visibility two_bounce_path rgb".split()
)
_DEFAULT = ("transient", "depth", "visibility", "specular", "intensity", "spots", "intrinsics")


class Dataset:
    """The scenes of a data set: `len(data)`, `data[i]`, and a loop over all.

    It is a map-style data set of PyTorch: a `DataLoader` with any number of workers reads it, with
    `fork` and with `spawn`. Every read checks the CRC-32C of the chunks.

    Args:
        url: Folder, or URL such as `s3://bucket/rooms`. Credentials come from the environment.
        split: `train`, `validation` or `test` of a split made by `picofarm dataset split`.
        scenes: Indices of scenes. Without it and without `split`, all published scenes.
        arrays: Names of arrays to read of each scene.
        crop: (row, column, height, width) in pixels. The intrinsics move with it.
        bins: (first, end) of the bins.
        split_name: Name of the split.
        split_version: Version of the split; the newest without it.
        threads: Threads that decode; all cores without it. Use 1 in workers of a `DataLoader`.
        cache: Local folder that keeps what was read of the arrays, for stores in a cloud. Several
            processes and data sets may share it. A scene that was replaced is read again.
        cache_bytes: Size of the cache, bytes. What was used longest ago is removed first.

    Raises:
        FileNotFoundError: There is no data set.
        ValueError: An argument does not fit the data set.
        OSError: The store cannot be read, or data are damaged.
    """

    def __init__(
        self,
        url: str | os.PathLike[str],
        *,
        split: str | None = None,
        scenes: Sequence[int] | None = None,
        arrays: Sequence[str] = _DEFAULT,
        crop: _Window | None = None,
        bins: tuple[int, int] | None = None,
        split_name: str = "default",
        split_version: int | None = None,
        threads: int | None = None,
        cache: str | os.PathLike[str] | None = None,
        cache_bytes: int = 100 * 10**9,
    ) -> None:
        if split is not None and scenes is not None:
            raise ValueError("scenes: give scenes or split, not both")
        self.url = os.fspath(url)
        self._threads = threads
        if cache_bytes < 1:
            raise ValueError(f"cache_bytes: expected at least 1, found {cache_bytes}")
        self._cache = None if cache is None else (os.fspath(cache), int(cache_bytes))
        self._native = _native.Dataset(self.url, threads, self._cache)
        facts = json.loads(self._native.facts())
        spec = facts["spec"]
        self.gate = Gate(**spec["gate"])
        """The gate of all scenes."""
        self.shape: tuple[int, int] = (spec["height"], spec["width"])
        """Height and width of the images, pixels."""
        self.spots: int = spec["spots"]
        """Number of laser spots of a scene."""
        self.available: tuple[str, ...] = tuple(facts["arrays"])
        """Names of all arrays of the data set."""
        self.arrays = tuple(arrays)
        unknown = [name for name in self.arrays if name not in self.available]
        if unknown:
            have = ", ".join(self.available)
            raise ValueError(f"arrays: the data set has no {', '.join(unknown)}, but {have}")
        self._window = self._check_window(crop)
        self._bins = self._check_bins(bins)
        if split is not None:
            self.scenes = self._split(split, split_name, split_version)
        elif scenes is not None:
            self.scenes = [int(scene) for scene in scenes]
        else:
            self.scenes = self._native.scenes()
        """Indices of the scenes, in order."""

    def __len__(self) -> int:
        return len(self.scenes)

    def __getitem__(self, index: int) -> dict[str, Any]:
        return self.read(self.scenes[index])

    def __iter__(self) -> Iterator[dict[str, Any]]:
        return (self.read(scene) for scene in self.scenes)

    def read(
        self, scene: int, *, crop: _Window | None = None, bins: tuple[int, int] | None = None
    ) -> dict[str, Any]:
        """Returns the arrays of a scene by its index in the data set, with `scene` and `scale`
        (photons per unit of the histogram).

        Args:
            scene: Index in the data set.
            crop: Replaces the window of the data set in this read.
            bins: Replaces the bins of the data set in this read.

        Raises:
            KeyError: The scene is not published.
            ValueError: The scene was imported without one of the arrays.
        """
        window = self._window if crop is None else self._check_window(crop)
        span = self._bins if bins is None else self._check_bins(bins)
        manifest = self.manifest(scene)
        missing = manifest["provenance"]["plan"].get("missing", [])
        lacking = [name for name in self.arrays if name in missing]
        if lacking:
            names = ", ".join(lacking)
            raise ValueError(f"arrays: scene {scene} was imported without {names}; leave them out")
        made: dict[str, Any] = {"scene": scene, "scale": manifest["scale"]}
        for name in self.arrays:
            made[name] = self._array(scene, name, window, span)
        if self._cache is not None and (trouble := self._native.cache_trouble()) is not None:
            warnings.warn(f"{trouble}; scenes are read from the store", stacklevel=2)
        return made

    def to_xarray(self, scene: int) -> xarray.Dataset:
        """Returns a scene, by its index in the data set, with dimensions, coordinates and units.
        Needs xarray."""
        arrays = self.read(scene)
        attributes = {name: arrays.pop(name) for name in ("scene", "scale")}
        return to_xarray(arrays, self.gate, self._bins[0], attributes)

    def stream(
        self,
        *,
        seed: int | None = 0,
        epoch: int = 0,
        rank: int = 0,
        ranks: int = 1,
        crop: int | None = None,
        ahead: int = 4,
    ) -> Stream:
        """Returns the scenes of an epoch as an iterator that reads ahead.

        Args:
            seed: Seed of the order; None keeps the order of `scenes`. The order is the same on
                every machine.
            epoch: Number of the epoch. Each has another order.
            rank: Number of this process among `ranks` that share the scenes. Every process gets
                equally many; the remainder is left out.
            ranks: Number of processes.
            crop: Side of a square that is cut out of each scene, pixels. Its corner is a random
                multiple of 32 pixels, which reads the fewest chunks.
            ahead: Number of scenes that threads read ahead.
        """
        return Stream(self, seed, epoch, rank, ranks, crop, ahead)

    def manifest(self, scene: int) -> dict[str, Any]:
        """Returns the manifest of a scene: objects, checksums, seed, versions and errors."""
        return json.loads(self._native.manifest(scene))

    def _array(self, scene: int, name: str, window: _Window, bins: tuple[int, int]) -> Any:
        top, left, height, width = window
        if name in ("transient", "transient_4", "transient_25"):
            # NumPy asks for large pages of memory, which saves most of the page faults.
            images = np.empty((bins[1] - bins[0], height, width), np.float32)
            ranges = ((top, top + height), (left, left + width), bins)
            self._native.read_bins(scene, name, ranges, images)
            return np.transpose(images, (1, 2, 0))
        array = self._native.read(scene, name)
        if name == "normal":
            array = array.astype(np.float32) / np.float32(32767)
        if name == "intrinsics":
            return array - np.array([0, 0, left, top], np.float32)
        if name in ("visibility", "two_bounce_path"):
            array = array[:, top : top + height, left : left + width]
        elif name.startswith("transient"):
            first, end = bins
            array = array[..., top : top + height, left : left + width, first:end]
        elif name in _IMAGES:
            array = array[top : top + height, left : left + width]
        return np.ascontiguousarray(array)

    def _check_window(self, crop: _Window | None) -> _Window:
        height, width = self.shape
        if crop is None:
            return (0, 0, height, width)
        top, left, h, w = (int(n) for n in crop)
        if not (0 <= top < top + h <= height and 0 <= left < left + w <= width):
            what = f"expected (row, column, height, width) within {height}x{width} pixels"
            raise ValueError(f"crop: {what}, found {crop}")
        return (top, left, h, w)

    def _check_bins(self, bins: tuple[int, int] | None) -> tuple[int, int]:
        if bins is None:
            return (0, self.gate.bins)
        first, end = (int(n) for n in bins)
        if not 0 <= first < end <= self.gate.bins:
            what = f"expected 0 <= first < end <= {self.gate.bins}"
            raise ValueError(f"bins: {what}, found {bins}")
        return (first, end)

    def _split(self, side: str, name: str, version: int | None) -> list[int]:
        sides = ("train", "validation", "test")
        if side not in sides:
            raise ValueError(f"split: expected one of {', '.join(sides)}, found {side!r}")
        _, text = self._native.split(name, version)
        # One digit per scene of the data set.
        digits = json.loads(text)["sides"]
        wanted = str(sides.index(side))
        return [scene for scene, digit in enumerate(digits) if digit == wanted]

    def __getstate__(self) -> dict[str, Any]:
        return {key: value for key, value in self.__dict__.items() if key != "_native"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._native = _native.Dataset(self.url, self._threads, self._cache)

    def __repr__(self) -> str:
        height, width = self.shape
        return (
            f"<picofarm.Dataset {self.url!r}: {len(self)} scenes, {width}x{height} pixels, "
            f"{self.gate.bins} bins, {self.spots} spots>"
        )


class Stream:
    """The scenes of an epoch in order, read ahead by threads. See `Dataset.stream`.

    A loop over it reads the rest of the epoch, and the next loop reads the next epoch. Pickle and
    `state_dict` keep the position.
    """

    def __init__(
        self,
        data: Dataset,
        seed: int | None,
        epoch: int,
        rank: int,
        ranks: int,
        crop: int | None,
        ahead: int,
    ) -> None:
        if not 0 <= rank < ranks:
            raise ValueError(f"rank: expected 0 to {ranks - 1}, found {rank}")
        if crop is not None and not 0 < crop <= min(data.shape):
            raise ValueError(f"crop: expected 1 to {min(data.shape)} pixels, found {crop}")
        if ahead < 1:
            raise ValueError(f"ahead: expected at least 1, found {ahead}")
        if seed is not None and not 0 <= seed < 2**64:
            raise ValueError(f"seed: expected 0 to 2^64 - 1, found {seed}")
        self.data = data
        self.epoch = epoch
        """Number of the epoch."""
        self._seed, self._rank, self._ranks = seed, rank, ranks
        self._crop, self._ahead = crop, ahead
        self._worker, self._workers = 0, 1
        self._position = 0

    def __len__(self) -> int:
        """Number of scenes of this process in an epoch."""
        return len(self.data) // self._ranks

    def set_epoch(self, epoch: int) -> None:
        """Starts an epoch."""
        self.epoch, self._position = epoch, 0

    def share_among_workers(self, worker: int, workers: int) -> None:
        """Divides the scenes of this process among its loading processes."""
        self._worker, self._workers = worker, workers

    def state_dict(self) -> dict[str, int]:
        """Returns the position: the epoch, and the number of scenes read in it."""
        return {"epoch": self.epoch, "position": self._position}

    def load_state_dict(self, state: Mapping[str, int]) -> None:
        """Continues at a position."""
        self.epoch, self._position = int(state["epoch"]), int(state["position"])

    def order(self) -> list[int]:
        """Returns the scenes of this process in the epoch, read ones included."""
        scenes = np.array(self.data.scenes, np.uint64)
        if self._seed is not None:
            key = _mixed(_mixed(np.array([self._seed], np.uint64)) + np.uint64(self.epoch))
            scenes = scenes[np.argsort(_mixed(scenes ^ key), kind="stable")]
        mine = scenes[self._rank :: self._ranks][: len(self)]
        return [int(scene) for scene in mine[self._worker :: self._workers]]

    def __iter__(self) -> Iterator[dict[str, Any]]:
        waiting = deque(self.order()[self._position :])
        reading: deque[Future[dict[str, Any]]] = deque()
        with ThreadPoolExecutor(self._ahead, "picofarm-read") as threads:
            try:
                while waiting or reading:
                    while waiting and len(reading) < self._ahead:
                        reading.append(threads.submit(self._read, waiting.popleft()))
                    scene = reading.popleft().result()
                    # The caller has this scene once it continues, or takes the state.
                    self._position += 1
                    yield scene
            finally:
                for future in reading:
                    future.cancel()
        self.set_epoch(self.epoch + 1)

    def _read(self, scene: int) -> dict[str, Any]:
        if self._crop is None:
            return self.data.read(scene)
        corners = np.array([2 * scene, 2 * scene + 1], np.uint64)
        key = np.array([self._seed or 0], np.uint64) + np.uint64(self.epoch)
        random = _mixed(_mixed(corners) ^ _mixed(key))
        top, left = (
            int(r % np.uint64((length - self._crop) // 32 + 1)) * 32
            for r, length in zip(random, self.data.shape, strict=True)
        )
        return self.data.read(scene, crop=(top, left, self._crop, self._crop))


def _mixed(x: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Returns SplitMix64 of each number."""
    with np.errstate(over="ignore"):
        z = x + np.uint64(0x9E3779B97F4A7C15)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        return z ^ (z >> np.uint64(31))


open = Dataset
