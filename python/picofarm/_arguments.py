"""Arguments of the package: checks that name the argument, and shared types."""

from __future__ import annotations

import importlib
import operator
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

METRES_PER_NS = 0.299792458
Point = Sequence[float] | NDArray[np.floating[Any]]
Spots = int | str | Sequence[tuple[float, float]]
Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Gate:
    """The recorded interval of optical path: `bins` bins of `bin_width_m` from `start_m`."""

    start_m: float
    bin_width_m: float
    bins: int

    @property
    def paths_m(self) -> NDArray[np.float64]:
        """Optical path at the middle of each bin, metres."""
        middles = np.arange(self.bins, dtype=np.float64) + 0.5
        return np.asarray(self.start_m + middles * self.bin_width_m, np.float64)

    @property
    def times_ns(self) -> NDArray[np.float64]:
        """Time at the middle of each bin, nanoseconds."""
        return self.paths_m / METRES_PER_NS


class Percent:
    """Prints a share to standard error whenever its percentage changes."""

    def __init__(self, what: str = "rendering") -> None:
        self.what = what
        self.last = -1

    def __call__(self, share: float) -> None:
        percent = int(100 * share)
        if percent != self.last:
            self.last = percent
            print(f"\r{self.what}: {percent} %", end="", file=sys.stderr, flush=True)


def point(name: str, value: Point | None) -> tuple[float, float, float] | None:
    if value is None:
        return None
    numbers = tuple(float(x) for x in value)
    if len(numbers) != 3:
        raise ValueError(f"{name}: expected three numbers, found {len(numbers)}")
    return numbers


def whole(name: str, value: Any) -> int:
    try:
        number = operator.index(value)
    except TypeError:
        raise TypeError(f"{name}: expected a whole number, found {value!r}") from None
    if not 0 <= number < 2**32 and not (name == "seed" and 0 <= number < 2**64):
        raise ValueError(f"{name}: {number} is out of range")
    return number


def size(resolution: int | tuple[int, int], shape: tuple[int, int]) -> tuple[int, int]:
    if isinstance(resolution, Sequence):
        if len(resolution) != 2:
            raise ValueError("resolution: expected a width, or (height, width)")
        height, width = (whole("resolution", n) for n in resolution)
    else:
        width = whole("resolution", resolution)
        height = max(1, round(width * shape[0] / shape[1]))
    if not (1 <= height <= 4096 and 1 <= width <= 4096):
        raise ValueError(f"resolution: expected 1 to 4096 pixels, found {height}x{width}")
    return height, width


def floats(name: str, value: ArrayLike, dimensions: int) -> Floats:
    array = np.asarray(value)
    if array.dtype.kind not in "fiu":
        raise ValueError(f"{name}: expected numbers, found dtype {array.dtype}")
    if array.ndim != dimensions:
        raise ValueError(f"{name}: expected {dimensions} dimensions, found shape {array.shape}")
    return np.ascontiguousarray(array, dtype=np.float32)


def mesh_arrays(
    k: int, mesh: Mapping[str, Any]
) -> tuple[Floats, NDArray[np.uint32], tuple[float, float, float], float | None]:
    if not isinstance(mesh, Mapping):
        raise ValueError(f"meshes[{k}]: expected a dict with vertices and triangles")
    unknown = set(mesh) - {"vertices", "triangles", "rgb", "mirror"}
    if unknown:
        raise ValueError(f"meshes[{k}]: unknown {', '.join(map(repr, sorted(unknown)))}")
    for needed in ("vertices", "triangles"):
        if needed not in mesh:
            raise ValueError(f"meshes[{k}]: {needed} are missing")
    vertices = floats(f"meshes[{k}].vertices", mesh["vertices"], 2)
    triangles = np.asarray(mesh["triangles"])
    if triangles.dtype.kind not in "iu":
        what = f"expected whole numbers, found dtype {triangles.dtype}"
        raise ValueError(f"meshes[{k}].triangles: {what}")
    if triangles.ndim != 2:
        what = f"expected 2 dimensions, found shape {triangles.shape}"
        raise ValueError(f"meshes[{k}].triangles: {what}")
    if triangles.size and (triangles.min() < 0 or triangles.max() >= len(vertices)):
        what = f"expected indices from 0 to {len(vertices) - 1}"
        raise ValueError(f"meshes[{k}].triangles: {what}")
    rgb = point(f"meshes[{k}].rgb", mesh.get("rgb", (0.7, 0.7, 0.7)))
    mirror = mesh.get("mirror")
    corners = np.ascontiguousarray(triangles, dtype=np.uint32)
    return vertices, corners, rgb or (0.7, 0.7, 0.7), None if mirror is None else float(mirror)


def plain(value: Any) -> Any:
    """Returns a Mitsuba dict with lists in place of arrays and transforms."""
    if hasattr(value, "matrix"):
        rows: Any = np.asarray(value.matrix, dtype=np.float64)
        return rows.reshape(4, 4).tolist()
    if isinstance(value, Mapping):
        items = cast("Mapping[object, Any]", value).items()
        return {str(key): plain(item) for key, item in items}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in cast("Sequence[Any]", value)]
    if isinstance(value, (str, bool, int, float)) or value is None:
        return value
    if isinstance(value, os.PathLike):
        return os.fspath(cast("os.PathLike[str]", value))
    array = np.asarray(value)
    if array.dtype.kind not in "fiub":
        raise ValueError(f"the Mitsuba dict holds {type(value).__name__}, which is not plain data")
    return array.tolist()


def optional(module: str, extra: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as e:
        raise ImportError(f"{e}; pip install 'picofarm[{extra}]'") from None


IMAGE = ("row", "column")
DIMENSIONS: dict[str, tuple[tuple[str, ...], str]] = {
    "transient": ((*IMAGE, "bin"), "1/(m2 sr)"),
    "intensity": (IMAGE, "1/(m2 sr)"),
    "depth": (IMAGE, "m"),
    "range": (IMAGE, "m"),
    "normal": ((*IMAGE, "axis"), "1"),
    "instance": (IMAGE, "1"),
    "label": (IMAGE, "1"),
    "specular": (IMAGE, "1"),
    "visibility": (("spot", *IMAGE), "1"),
    "two_bounce_path": (("spot", *IMAGE), "m"),
    "rgb": ((*IMAGE, "channel"), "1"),
    "spots": (("spot", "spot_field"), "m"),
    "intrinsics": (("intrinsic",), "pixel"),
}
"""Dimensions and unit of each array of a scene."""


def to_xarray(
    arrays: Mapping[str, NDArray[Any]], gate: Gate, first_bin: int, attributes: Mapping[str, Any]
) -> Any:
    """Returns arrays of a scene as an `xarray.Dataset` with coordinates and units."""
    xarray = optional("xarray", "xarray")
    shown: dict[str, Any] = {}
    for name, array in arrays.items():
        if name in DIMENSIONS:
            axes, units = DIMENSIONS[name]
            shown[name] = (axes, array, {"units": units})
    coordinates: dict[str, Any] = {}
    if "transient" in shown:
        end = first_bin + arrays["transient"].shape[-1]
        path, time = gate.paths_m[first_bin:end], gate.times_ns[first_bin:end]
        coordinates = {
            "path": ("bin", path, {"units": "m"}),
            "time": ("bin", time, {"units": "ns"}),
        }
    return xarray.Dataset(shown, coords=coordinates, attrs=dict(attributes))


def watcher(
    progress: bool | Callable[[float], object], what: str
) -> Callable[[float], object] | None:
    """Returns the function that gets the share done; True stands for a line on standard error."""
    return Percent(what) if progress is True else (progress or None)


def count(name: str, value: Any) -> int | None:
    """Returns a whole number, or None."""
    return None if value is None else whole(name, value)
