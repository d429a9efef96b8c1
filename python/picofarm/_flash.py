"""One flash: depth, shadows and a room in 3D from the light of all spots together."""

from __future__ import annotations

import json
import os
import pathlib
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import _native
from ._arguments import Floats, Gate, Point, count, floats, optional, point, watcher, whole

if TYPE_CHECKING:
    import matplotlib.figure

    from ._scene import Scene


class Capture:
    """The light of all spots together, with the calibration: a laboratory's measurement.

    The axes are the camera's: x to the right, y downwards, z along the view; the camera is at the
    origin. Paths count from the laser, via spot and surface, to the camera.

    Args:
        histogram: Photons or energy, `[row, column, bin]`. One histogram for each spot,
            `[spot, row, column, bin]`, is summed.
        gate: A `Gate`, or the first and last optical path in metres.
        laser: Position of the laser, metres.
        spots: Positions of the laser spots, metres, `[n, 3]`.
        directions: Directions of the beams from the laser, `[n, 3]`, if the spots are not known.
            Each spot's own one-bounce return then gives its distance, to half a bin.
        fov: Width of the view in degrees, of a camera whose axis is in the middle of the image.
        intrinsics: fx, fy, cx, cy in pixels, instead of `fov`. The middle of the first pixel is at
            (0.5, 0.5).

    Raises:
        ValueError: An argument has the wrong shape or contradicts another.
    """

    def __init__(
        self,
        histogram: ArrayLike,
        *,
        gate: Gate | tuple[float, float],
        laser: Point,
        spots: ArrayLike | None = None,
        directions: ArrayLike | None = None,
        fov: float | None = None,
        intrinsics: Sequence[float] | None = None,
    ) -> None:
        values = np.asarray(histogram)
        self.histogram = floats("histogram", values.sum(axis=0) if values.ndim == 4 else values, 3)
        height, width, bins = self.histogram.shape
        if not isinstance(gate, Gate):
            first, last = (float(x) for x in gate)
            gate = Gate(first, (last - first) / bins, bins)
        if gate.bins != bins:
            raise ValueError(f"gate: has {gate.bins} bins, but the histogram has {bins}")
        self.gate = gate
        if (spots is None) == (directions is None):
            raise ValueError("spots: give either spots or directions")
        if (fov is None) == (intrinsics is None):
            raise ValueError("fov: give either fov or intrinsics")
        if fov is not None:
            if not 0 < fov < 180:
                raise ValueError(f"fov: expected 0 to 180 degrees, found {fov}")
            focal = width / 2 / np.tan(np.radians(fov) / 2)
            intrinsics = (focal, focal, width / 2, height / 2)
        assert intrinsics is not None
        if len(intrinsics) != 4:
            raise ValueError(f"intrinsics: expected fx, fy, cx, cy, found {len(intrinsics)} values")
        fx, fy, cx, cy = (float(x) for x in intrinsics)
        origin = point("laser", laser)
        assert origin is not None
        self._view = _native.Viewpoint((fx, fy, cx, cy), (height, width), origin)
        self._truth: Scene | None = None
        if spots is not None:
            name, rows = "spots", floats("spots", spots, 2)
        else:
            assert directions is not None
            name, rows = "directions", floats("directions", directions, 2)
        if rows.shape[1] != 3:
            raise ValueError(f"{name}: expected rows of three, found shape {rows.shape}")
        if values.ndim == 4 and len(rows) != len(values):
            raise ValueError(
                f"{name}: has {len(rows)} rows, but there are {len(values)} histograms"
            )
        if spots is not None:
            path = np.linalg.norm(rows - np.array(origin, np.float32), axis=1)
            rows = np.ascontiguousarray(np.column_stack([rows, path]), np.float32)
        self._spots = rows

    @classmethod
    def _of_render(cls, histogram: ArrayLike, gate: Gate, scene: Scene, spots: Floats) -> Capture:
        capture = cls.__new__(cls)
        capture.histogram = floats("histogram", histogram, 3)
        capture.gate = gate
        capture._view = _native.Viewpoint.of_scene(scene._native)
        capture._truth = scene
        capture._spots = spots
        return capture

    def demultiplex(self, *, shadows: str = "learned", threads: int | None = None) -> Flash:
        """Finds depth, shadows and mirrors.

        Args:
            shadows: `learned` from rendered rooms, or `physics`.
            threads: Number of threads; all cores without it.
        """
        made = _native.demultiplex(
            self.histogram,
            self._view,
            (self.gate.start_m, self.gate.bin_width_m),
            self._spots,
            shadows,
            count("threads", threads),
        )
        return Flash(**made)

    def reconstruct(
        self,
        *,
        nodes: int | None = None,
        seed: int = 0,
        threads: int | None = None,
        progress: bool | Callable[[float], object] = False,
    ) -> Reconstruction:
        """Returns the room in 3D.

        Args:
            nodes: Nodes along the longest side of the grid, 16 to 512; 192 without it.
            seed: Seed of the random numbers.
            threads: Number of threads; all cores without it.
            progress: Prints the progress to standard error, or is called with the share done.

        Raises:
            ValueError: The histogram contradicts the calibration, or an argument is wrong.
            KeyboardInterrupt: Ctrl-C was pressed.
        """
        made = _native.reconstruct(
            self.histogram,
            self._view,
            None if self._truth is None else self._truth._native,
            (self.gate.start_m, self.gate.bin_width_m),
            self._spots,
            count("nodes", nodes),
            whole("seed", seed),
            count("threads", threads),
            watcher(progress, "reconstructing"),
        )
        if progress is True:
            print(file=sys.stderr)
        facts = json.loads(made.pop("facts"))
        return Reconstruction(scene=self._truth, facts=facts, **made)

    def __repr__(self) -> str:
        height, width, bins = self.histogram.shape
        return f"<picofarm.Capture {width}x{height} pixels, {bins} bins, {len(self._spots)} spots>"


@dataclass(frozen=True, repr=False)
class Flash:
    """What the light of all spots together reveals. Spots are those that hit something, in order."""

    beams: list[int]
    """Index of each spot's beam."""
    depth: Floats
    """z-depth, metres, `[row, column]`."""
    confidence: Floats
    """0 to 1: how well the histogram supports the depth, `[row, column]`."""
    albedo: Floats
    """Relative to the median pixel, `[row, column]`."""
    mirror: Floats
    """Probability that the pixel sees a mirror, `[row, column]`."""
    lit: Floats
    """Probability that the spot lights what the pixel sees, `[spot, row, column]`."""
    ground: NDArray[np.uint8]
    """What `lit` rests on: 0 = light, 1 = geometry alone, 2 = light of other spots arrives at the
    same time; `[spot, row, column]`."""

    def plot(self, spot: int = 0) -> matplotlib.figure.Figure:
        """Draws depth, confidence, mirrors, and what a spot lights. Needs matplotlib.

        Args:
            spot: Index in `beams`.
        """
        plt = optional("matplotlib.pyplot", "plot")
        if not 0 <= spot < len(self.beams):
            raise ValueError(f"spot: expected 0 to {len(self.beams) - 1}, found {spot}")
        images = {
            "depth, m": self.depth,
            "confidence": self.confidence,
            "mirror": self.mirror,
            f"lit by spot {self.beams[spot]}": self.lit[spot],
        }
        figure, axes = plt.subplots(1, 4, figsize=(14, 3.2), layout="constrained")
        for panel, (title, image) in zip(axes, images.items(), strict=True):
            most = None if title.startswith("depth") else 1
            figure.colorbar(panel.imshow(image, vmin=0, vmax=most), ax=panel)
            panel.set_title(title)
            panel.set_axis_off()
        return figure

    def __repr__(self) -> str:
        height, width = self.depth.shape
        return f"<picofarm.Flash {width}x{height} pixels, {len(self.beams)} spots>"


@dataclass(frozen=True, repr=False)
class Reconstruction:
    """A room in 3D."""

    scene: Scene | None
    """The scene that was rendered; None for a `Capture`."""
    vertices: Floats
    """World axes, metres, `[n, 3]`."""
    triangles: NDArray[np.uint32]
    """Indices of vertices, counter-clockwise seen from empty space, `[m, 3]`."""
    glb: bytes = field(repr=False)
    """A glTF file with the surface, the camera and the laser."""
    facts: dict[str, Any] = field(repr=False)
    """Errors against the scene, planes, spots that were left out, and a verdict."""

    @property
    def error(self) -> float:
        """Mean error of depth in 24 views from other places in the room, metres; NaN for a
        `Capture`, whose truth is not known."""
        return self.facts["novel_views"]["all"]["l1_m"] if self.scene else float("nan")

    def save(self, file: str | os.PathLike[str]) -> pathlib.Path:
        """Writes the surface as `.glb` and returns its path."""
        path = pathlib.Path(file)
        path.write_bytes(self.glb)
        return path

    def plot(
        self, *, look_from: Point | None = None, look_at: Point | None = None, fov: float = 90.0
    ) -> matplotlib.figure.Figure:
        """Draws the surface and the true scene from another place. Needs matplotlib.

        Args:
            look_from: Where to stand, metres; without it, across the room, above the middle.
            look_at: Point in the middle of the picture; without it, the middle of the room.
            fov: Width of the view, degrees.
        """
        plt = optional("matplotlib.pyplot", "plot")
        from ._scene import Scene

        if self.scene is None:
            eye, ahead, up = np.eye(4, 3)[[3, 2, 1]] * [[1], [1], [-1]]
        else:
            camera = self.scene.camera
            eye, ahead = np.array(camera["origin"]), np.array(camera["forward"])
            up = -np.array(camera["down"])
        middle = (self.vertices.min(axis=0) + self.vertices.max(axis=0)) / 2
        target = middle if look_at is None else np.asarray(look_at, float)
        if look_from is None:
            farthest = float(((self.vertices - eye) @ ahead).max())
            place = eye + 0.8 * farthest * ahead + 0.3 * up
        else:
            place = np.asarray(look_from, float)
        mesh = {"vertices": self.vertices, "triangles": self.triangles}
        shown = {
            "one flash": Scene([mesh], look_from=place, look_at=target, fov=fov, up=up, spots=1)
        }
        if self.scene is not None:
            shown["truth"] = self.scene.seen_from(place, target, fov=fov)
        size = (5 * len(shown), 4.6)
        figure, axes = plt.subplots(
            1, len(shown), figsize=size, layout="constrained", squeeze=False
        )
        for panel, (title, scene) in zip(axes[0], shown.items(), strict=True):
            seen = scene.render((256, 256), samples=2, bins=16)
            shade = np.where(seen.depth > 0, 0.15 + 0.85 * np.abs(seen.normal[..., 2]), 0)
            panel.imshow(shade, cmap="bone", vmin=0, vmax=1)
            panel.set_title(title)
            panel.set_xticks([])
            panel.set_yticks([])
        return figure

    def __repr__(self) -> str:
        name = repr(self.scene.name) + ": " if self.scene else ""
        error = f", error {self.error:.3f} m" if self.scene else ""
        return f"<picofarm.Reconstruction {name}{len(self.triangles)} triangles{error}>"
