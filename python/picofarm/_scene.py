"""Scenes, renders and flashes that were taken apart."""

from __future__ import annotations

import json
import operator
import os
import pathlib
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _native

if TYPE_CHECKING:
    import matplotlib.figure
    import xarray

_METRES_PER_NS = 0.299792458
_Point = Sequence[float]
_Spots = int | str | Sequence[tuple[float, float]]
_Floats = NDArray[np.float32]


class Scene:
    """Objects, a camera and a laser. A scene never changes.

    `source` is one of:

    - the path of a glTF, Mitsuba (XML, or its dict as JSON), OBJ, PLY or STL file,
    - a Mitsuba dict,
    - a list of meshes. Each is a dict with `vertices` (float, `[n, 3]`, metres), `triangles`
      (integer, `[m, 3]`), and optionally `rgb` (three numbers from 0 to 1) and `mirror` (the
      roughness of a mirror).

    Camera, laser and unit that the source does not have are chosen; `notes` says how.

    Args:
        camera: Name or number of the file's camera.
        look_from: Position of the camera, metres.
        look_at: Point in the middle of the image, metres.
        fov: Width of the view, degrees.
        up: Direction that is upwards in the image.
        spots: Laser spots in the camera's view: a grid of 1, 4, 16, 25 or 100, `"random:16"`, or
            a list of (x, y) from 0 to 1, right and down.
        unit: Unit of length of the file: m, cm, mm, in or ft.
        root: Folder that holds every file that the scene names.

    Raises:
        ValueError: An argument or the content of the source is unusable.
        OSError: A file cannot be read.
    """

    def __init__(
        self,
        source: str | os.PathLike[str] | Mapping[str, Any] | Sequence[Mapping[str, Any]],
        *,
        camera: str | int | None = None,
        look_from: _Point | None = None,
        look_at: _Point | None = None,
        fov: float | None = None,
        up: _Point | None = None,
        spots: _Spots | None = None,
        unit: str | None = None,
        root: str | os.PathLike[str] | None = None,
    ) -> None:
        view = (
            _point("look_from", look_from),
            _point("look_at", look_at),
            None if fov is None else float(fov),
            _point("up", up),
        )
        name = None if camera is None else str(camera)
        if isinstance(source, (str, os.PathLike)):
            self._native = _native.Scene.open(source, name, view, spots, unit, root)
        elif isinstance(source, Mapping):
            with tempfile.TemporaryDirectory() as folder:
                path = pathlib.Path(folder, "scene.json")
                path.write_text(json.dumps(_plain(source)))
                self._native = _native.Scene.open(path, name, view, spots, unit, root)
        else:
            for argument, value in {"camera": camera, "unit": unit, "root": root}.items():
                if value is not None:
                    raise ValueError(f"{argument}: only scene files have one; meshes are in metres")
            meshes = [_mesh(k, mesh) for k, mesh in enumerate(source)]
            self._native = _native.Scene.from_meshes(meshes, view, 25 if spots is None else spots)

    @classmethod
    def _of(cls, native: _native.Scene) -> Scene:
        scene = cls.__new__(cls)
        scene._native = native
        return scene

    @property
    def name(self) -> str:
        """Name of the scene."""
        return self._native.name

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width of the image, pixels."""
        return self._native.shape

    @property
    def spots(self) -> int:
        """Number of laser beams."""
        return self._native.beams

    @property
    def triangles(self) -> int:
        """Number of triangles."""
        return self._native.triangles

    @property
    def objects(self) -> list[str]:
        """Names of the objects; `Render.instance` is the index plus one."""
        return self._native.objects

    @property
    def labels(self) -> list[str]:
        """Names of the categories; `Render.label` is the index plus one."""
        return self._native.labels

    @property
    def camera(self) -> dict[str, Any]:
        """Intrinsics (pixels) and pose (world axes, metres)."""
        return json.loads(self._native.facts())["camera"]

    @property
    def notes(self) -> dict[str, str]:
        """What was chosen for the scene and what was left out of its file."""
        return json.loads(self._native.facts())["provenance"]["notes"]

    def render(
        self,
        resolution: int | tuple[int, int] | None = None,
        *,
        error: float | None = None,
        samples: int = 64,
        bins: int = 637,
        gate: tuple[float, float] | None = None,
        seed: int = 0,
        max_bounces: int | None = None,
        split: bool = False,
        threads: int | None = None,
        progress: bool | Callable[[float], object] = False,
    ) -> Render:
        """Renders the scene. The same arguments give the same bits on any number of threads.

        Args:
            resolution: Width of the image in pixels, or (height, width); the scene's own without it.
            error: Render until the median error of a pixel is this share, such as 0.1.
            samples: Camera paths per pixel, if `error` is not given.
            bins: Number of time bins.
            gate: First and last optical path in metres. Without it, 38.4 mm bins from 1 m, or a
                gate that fits the scene if that would miss much of it.
            seed: Seed of the random numbers.
            max_bounces: Longest path in bounces; without it, until the gate ends.
            split: Also returns the light of two bounces and of more, with standard errors.
            threads: Number of threads; all cores without it.
            progress: Prints the progress to standard error, or is called with the share done.

        Raises:
            ValueError: An argument or the scene is unusable.
            MemoryError: The histograms do not fit into memory.
            KeyboardInterrupt: Ctrl-C was pressed. The render stops within 0.1 s.
        """
        native = self._native
        if resolution is not None:
            native = native.resized(*_size(resolution, native.shape))
        limits = None
        if gate is not None:
            first, last = (float(x) for x in gate)
            if not 0 <= first < last:
                raise ValueError(f"gate: expected 0 <= first < last in metres, found {gate}")
            limits = (first, (last - first) / bins)
        made = _native.render(
            native,
            _whole("samples", samples),
            None if error is None else float(error),
            _whole("bins", bins),
            limits,
            _whole("seed", seed),
            None if max_bounces is None else _whole("max_bounces", max_bounces),
            split,
            None if threads is None else _whole("threads", threads),
            _Percent() if progress is True else (progress or None),
        )
        if progress is True:
            print(file=sys.stderr)
        facts = json.loads(made.pop("facts"))
        return Render(scene=Scene._of(native), gate=Gate(**facts.pop("gate")), facts=facts, **made)

    def __repr__(self) -> str:
        height, width = self.shape
        return (
            f"<picofarm.Scene {self.name!r}: {self.triangles} triangles, {self.spots} spots, "
            f"{width}x{height} pixels>"
        )


def furnished(
    seed: int,
    *,
    resolution: int = 256,
    spots: _Spots = 25,
    fov: float = 90.0,
    mirrors: int = 0,
    assets: str = "parametric",
) -> Scene:
    """Returns the furnished room of a seed: the same room on every machine.

    Args:
        resolution: Width and height of the image, pixels.
        spots: See `Scene`.
        fov: Width of the view, degrees.
        mirrors: Least number of mirrors in view, 0 to 4.
        assets: Library of furniture: `parametric` or `sweethome3d`.
    """
    side = _whole("resolution", resolution)
    least = _whole("mirrors", mirrors)
    seed = _whole("seed", seed)
    return Scene._of(_native.Scene.furnished(seed, side, spots, float(fov), least, assets))


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
        return self.paths_m / _METRES_PER_NS


@dataclass(frozen=True, repr=False)
class Render:
    """Histograms of one scene and its ground truth. Rows count downwards."""

    scene: Scene
    gate: Gate
    transient: _Floats
    """All light, radiance per pulse energy, 1/(m² sr), `[row, column, bin]`."""
    depth: _Floats
    """z-depth, metres, 0 = nothing, `[row, column]`."""
    range: _Floats
    """Distance along the ray, metres, 0 = nothing, `[row, column]`."""
    normal: _Floats
    """Unit normals in the camera frame (x right, y down, z forward), `[row, column, 3]`."""
    instance: NDArray[np.uint32]
    """Object index + 1, 0 = nothing, `[row, column]`."""
    label: NDArray[np.uint16]
    """Category index + 1, 0 = nothing, `[row, column]`."""
    specular: NDArray[np.uint8]
    """1 = mirror, `[row, column]`."""
    visibility: NDArray[np.uint8]
    """1 = the spot lights what the pixel sees, `[spot, row, column]`."""
    rgb: _Floats
    """Companion image, linear, 0 to 1, `[row, column, 3]`."""
    spots: _Floats
    """x, y, z, nx, ny, nz (world frame) and the path from the laser, metres, `[spot, 7]`; NaN if
    the beam hits nothing."""
    intrinsics: _Floats
    """fx, fy, cx, cy, pixels."""
    facts: dict[str, Any] = field(repr=False)
    """Error estimates, the renderer's plan, energy outside the gate, rays and warnings."""
    two: _Floats | None = None
    """Light of exactly two bounces, with `split=True`."""
    two_se: _Floats | None = None
    """Standard error of `two`."""
    two_noise: _Floats | None = None
    """A draw of the error of `two`."""
    multi: _Floats | None = None
    """Light of three bounces and more, with `split=True`."""
    multi_se: _Floats | None = None
    """Standard error of `multi`."""
    multi_noise: _Floats | None = None
    """A draw of the error of `multi`."""

    @property
    def error(self) -> float:
        """Median over the pixels of the relative error of the histogram."""
        return self.facts["error"]["median_relative"]

    @property
    def plan(self) -> dict[str, list[str]]:
        """Techniques and approximations that the renderer chose."""
        return self.facts["plan"]

    @property
    def warnings(self) -> list[str]:
        """Beams that hit nothing, an image without light."""
        return self.facts["warnings"]

    def demultiplex(
        self,
        *,
        histogram: ArrayLike | None = None,
        shadows: str = "physics",
        threads: int | None = None,
    ) -> Flash:
        """Finds depth, shadows and mirrors in the light of all spots, without the ground truth.

        Args:
            histogram: Replaces `transient`, for example with photon counts.
            shadows: `physics`, or `learned` from rendered rooms.
            threads: Number of threads; all cores without it.
        """
        values = self.transient if histogram is None else histogram
        light = _floats("histogram", values, 3)
        made = _native.demultiplex(
            light,
            self.scene._native,
            (self.gate.start_m, self.gate.bin_width_m),
            self.spots,
            shadows,
            None if threads is None else _whole("threads", threads),
        )
        return Flash(**made)

    def to_xarray(self) -> xarray.Dataset:
        """Returns the arrays with dimensions, coordinates and units. Needs xarray."""
        xarray = _optional("xarray", "xarray")
        image = ("row", "column")
        dims: dict[str, tuple[tuple[str, ...], str]] = {
            "transient": ((*image, "bin"), "1/(m2 sr)"),
            "depth": (image, "m"),
            "range": (image, "m"),
            "normal": ((*image, "axis"), "1"),
            "instance": (image, "1"),
            "label": (image, "1"),
            "specular": (image, "1"),
            "visibility": (("spot", *image), "1"),
            "rgb": ((*image, "channel"), "1"),
        }
        arrays = {
            name: (axes, getattr(self, name), {"units": units})
            for name, (axes, units) in dims.items()
        }
        coordinates = {
            "path": ("bin", self.gate.paths_m, {"units": "m"}),
            "time": ("bin", self.gate.times_ns, {"units": "ns"}),
        }
        return xarray.Dataset(arrays, coords=coordinates, attrs={"scene": self.scene.name})

    def plot(self, pixel: tuple[int, int] | None = None) -> matplotlib.figure.Figure:
        """Draws the light summed over time, the depth and the histogram of a pixel. Needs
        matplotlib.

        Args:
            pixel: Row and column; the middle of the image without it.
        """
        plt = _optional("matplotlib.pyplot", "plot")
        height, width = self.depth.shape
        row, column = pixel or (height // 2, width // 2)
        if not (0 <= row < height and 0 <= column < width):
            raise ValueError(f"pixel: {(row, column)} is outside of {height} rows, {width} columns")
        figure, axes = plt.subplots(1, 3, figsize=(12, 3.6), layout="constrained")
        light = self.transient.sum(axis=2)
        white = float(np.quantile(light, 0.99)) or 1.0
        axes[0].imshow(np.sqrt(np.minimum(light / white, 1.0)), cmap="inferno")
        axes[0].set_title("all light")
        seen = np.where(self.depth > 0, self.depth, np.nan)
        figure.colorbar(axes[1].imshow(seen, cmap="viridis"), ax=axes[1], label="depth, m")
        for panel in axes[:2]:
            panel.plot(column, row, "o", mfc="none", mec="white")
            panel.set_xticks([])
            panel.set_yticks([])
        axes[2].plot(self.gate.times_ns, self.transient[row, column], lw=0.8)
        axes[2].set_xlabel("time, ns")
        axes[2].set_ylabel("radiance, 1/(m² sr)")
        axes[2].set_title(f"pixel ({row}, {column})")
        return figure

    def __repr__(self) -> str:
        height, width, bins = self.transient.shape
        return f"<picofarm.Render {width}x{height} pixels, {bins} bins, error {self.error:.1%}>"


@dataclass(frozen=True, repr=False)
class Flash:
    """What the light of all spots together reveals. Spots are those that hit something, in order."""

    beams: list[int]
    """Index of each spot's beam."""
    depth: _Floats
    """z-depth, metres, `[row, column]`."""
    confidence: _Floats
    """0 to 1: how well the histogram supports the depth, `[row, column]`."""
    albedo: _Floats
    """Relative to the median pixel, `[row, column]`."""
    mirror: _Floats
    """Probability that the pixel sees a mirror, `[row, column]`."""
    lit: _Floats
    """Probability that the spot lights what the pixel sees, `[spot, row, column]`."""
    ground: NDArray[np.uint8]
    """What `lit` rests on: 0 = light, 1 = geometry alone, 2 = light of other spots arrives at the
    same time; `[spot, row, column]`."""

    def __repr__(self) -> str:
        height, width = self.depth.shape
        return f"<picofarm.Flash {width}x{height} pixels, {len(self.beams)} spots>"


class _Percent:
    """Prints a share to standard error whenever its percentage changes."""

    def __init__(self) -> None:
        self.last = -1

    def __call__(self, share: float) -> None:
        percent = int(100 * share)
        if percent != self.last:
            self.last = percent
            print(f"\rrendering: {percent} %", end="", file=sys.stderr, flush=True)


def _point(name: str, value: _Point | None) -> tuple[float, float, float] | None:
    if value is None:
        return None
    numbers = tuple(float(x) for x in value)
    if len(numbers) != 3:
        raise ValueError(f"{name}: expected three numbers, found {len(numbers)}")
    return numbers


def _whole(name: str, value: Any) -> int:
    try:
        number = operator.index(value)
    except TypeError:
        raise TypeError(f"{name}: expected a whole number, found {value!r}") from None
    if not 0 <= number < 2**32 and not (name == "seed" and 0 <= number < 2**64):
        raise ValueError(f"{name}: {number} is out of range")
    return number


def _size(resolution: int | tuple[int, int], shape: tuple[int, int]) -> tuple[int, int]:
    if isinstance(resolution, Sequence):
        if len(resolution) != 2:
            raise ValueError("resolution: expected a width, or (height, width)")
        height, width = (_whole("resolution", n) for n in resolution)
    else:
        width = _whole("resolution", resolution)
        height = max(1, round(width * shape[0] / shape[1]))
    if not (1 <= height <= 4096 and 1 <= width <= 4096):
        raise ValueError(f"resolution: expected 1 to 4096 pixels, found {height}x{width}")
    return height, width


def _floats(name: str, value: ArrayLike, dimensions: int) -> _Floats:
    array = np.asarray(value)
    if array.dtype.kind not in "fiu":
        raise ValueError(f"{name}: expected numbers, found dtype {array.dtype}")
    if array.ndim != dimensions:
        raise ValueError(f"{name}: expected {dimensions} dimensions, found shape {array.shape}")
    return np.ascontiguousarray(array, dtype=np.float32)


def _mesh(
    k: int, mesh: Mapping[str, Any]
) -> tuple[_Floats, NDArray[np.uint32], tuple[float, float, float], float | None]:
    if not isinstance(mesh, Mapping):
        raise ValueError(f"meshes[{k}]: expected a dict with vertices and triangles")
    unknown = set(mesh) - {"vertices", "triangles", "rgb", "mirror"}
    if unknown:
        raise ValueError(f"meshes[{k}]: unknown {', '.join(map(repr, sorted(unknown)))}")
    for needed in ("vertices", "triangles"):
        if needed not in mesh:
            raise ValueError(f"meshes[{k}]: {needed} are missing")
    vertices = _floats(f"meshes[{k}].vertices", mesh["vertices"], 2)
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
    rgb = _point(f"meshes[{k}].rgb", mesh.get("rgb", (0.7, 0.7, 0.7)))
    mirror = mesh.get("mirror")
    corners = np.ascontiguousarray(triangles, dtype=np.uint32)
    return vertices, corners, rgb or (0.7, 0.7, 0.7), None if mirror is None else float(mirror)


def _plain(value: Any) -> Any:
    """Returns a Mitsuba dict with lists in place of arrays and transforms."""
    if hasattr(value, "matrix"):
        rows: Any = np.asarray(value.matrix, dtype=np.float64)
        return rows.reshape(4, 4).tolist()
    if isinstance(value, Mapping):
        items = cast("Mapping[object, Any]", value).items()
        return {str(key): _plain(item) for key, item in items}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in cast("Sequence[Any]", value)]
    if isinstance(value, (str, bool, int, float)) or value is None:
        return value
    if isinstance(value, os.PathLike):
        return os.fspath(cast("os.PathLike[str]", value))
    array = np.asarray(value)
    if array.dtype.kind not in "fiub":
        raise ValueError(f"the Mitsuba dict holds {type(value).__name__}, which is not plain data")
    return array.tolist()


def _optional(module: str, extra: str) -> Any:
    import importlib

    try:
        return importlib.import_module(module)
    except ImportError as e:
        raise ImportError(f"{e}; pip install 'picofarm[{extra}]'") from None
